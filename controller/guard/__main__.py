"""The guard process: ``python -m controller.guard --profile FILE --bus crane0=ADDRESS``.

Every 5 ms: drain, judge, send.  Exit codes: 0 ended by SIGTERM, 3 configuration, 4 bus lost, 130 SIGINT.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Final

from can_dbc.bus import Bus, BusError, BusState, default_address, open_bus
from can_dbc.frame import Frame
from controller.guard.envelope import read_envelope
from controller.guard.judge import MESSAGES, Guard
from controller.guard.layout import GuardConfigError, read_layouts
from controller.realtime import Notifier, prepare, sleep_until

PERIOD_NS: Final = 5_000_000
PRIORITY: Final = 85
ROOT: Final = Path(__file__).parents[2]
BUS_GONE_NS: Final = 200_000_000


def build(profile: Path, dbc: Path = ROOT / "can_dbc" / "crane.dbc") -> Guard:
    """A guard for a profile file; raises GuardConfigError."""
    axes = read_envelope(profile)
    return Guard(axes, read_layouts(dbc, [*MESSAGES, *(axis.message for axis in axes if axis.message)]))


def profile_path(name: str) -> Path:
    """A profile file, or the shipped one of that name."""
    shipped = ROOT / "machine" / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


def run(guard: Guard, bus: Bus, ended: list[int], notifier: Notifier) -> bool:
    """Judges until a signal is in ``ended``; False when the bus is gone."""
    frames: list[Frame] = []
    deadline_ns = time.monotonic_ns() + PERIOD_NS
    down_ns = 0
    while not ended:
        sleep_until(deadline_ns)
        late_ns = time.monotonic_ns() - deadline_ns
        if late_ns >= PERIOD_NS:
            deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
        frames.clear()
        bus.drain(frames)
        for key, data in guard.step(deadline_ns, frames):
            bus.send(key, data)
        down_ns = down_ns + PERIOD_NS if bus.stats.state is BusState.DOWN else 0
        notifier.ticked(deadline_ns, late_ns < PERIOD_NS and not down_ns)
        if down_ns >= BUS_GONE_NS:
            return False
        deadline_ns += PERIOD_NS
    notifier.stopping()
    return True


def main(arguments: list[str] | None = None) -> int:
    """Starts the guard; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m controller.guard",
        description="Judges the traffic on the crane bus and enables the valves.",
    )
    parser.add_argument("--profile", required=True, help="shipped profile name or TOML file")
    parser.add_argument("--bus", default="", metavar="crane0=ADDRESS", help="where the crane bus is")
    parser.add_argument("--no-realtime", action="store_true", help="do not ask for FIFO and locked memory")
    options = parser.parse_args(arguments)
    name, _, address = options.bus.partition("=")
    if options.bus and (name != "crane0" or not address):
        parser.error(f"--bus {options.bus}: write crane0=ADDRESS, as in crane0=socketcan:can0")
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    try:
        guard = build(profile_path(options.profile))
        with open_bus(address or default_address("crane0"), filters=guard.keys) as bus:
            if not options.no_realtime:
                for refusal in prepare(PRIORITY):
                    sys.stderr.write(f"guard: not granted: {refusal}\n")
            notifier = Notifier(lambda: f"Valves {'' if guard.enabled else 'not '}enabled: {guard.verdict.name}.")
            if not run(guard, bus, ended, notifier):
                sys.stderr.write("guard: the crane bus is gone; bring it up and start the guard again.\n")
                return 4
    except GuardConfigError as error:
        sys.stderr.write(f"guard: {error}\n")
        return 3
    except BusError as error:
        sys.stderr.write(f"guard: {error}\n")
        return 4
    return 130 if signal.SIGINT in ended else 0


if __name__ == "__main__":
    sys.exit(main())
