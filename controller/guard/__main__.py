"""The guard process: ``python -m controller.guard --profile FILE --bus crane0=ADDRESS``.

Every 5 ms: receive, check, send.  A lost bus is reopened when it is back.  Exit codes: 0 ended by SIGTERM, 3
configuration, 4 no bus at the start, 130 SIGINT.
"""

from __future__ import annotations

from runtime.compiled import stay_interpreted

if __name__ == "__main__":  # before the buses are imported: no fault of the compiler may be in guard and controller
    stay_interpreted()

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus, BusError
from can_dbc.bus.factory import default_address, open_bus
from can_dbc.frame import Frame
from can_dbc.messages.tick_record import BusReading
from controller.guard.envelope import read_envelope
from controller.guard.guard import MESSAGES, Guard
from controller.guard.layout import GuardConfigError, read_layouts
from controller.process.bus_link import BusLink
from controller.process.realtime import Notifier, prepare, sleep_until, stop_garbage_collection
from runtime.allocator import keep_memory

PERIOD_NS: Final = 5_000_000
PRIORITY: Final = 85
ROOT: Final = Path(__file__).parents[2]


def build(profile: Path, dbc: Path = ROOT / "can_dbc" / "crane.dbc", rate_hz: int = 0) -> Guard:
    """Build a guard for a profile file and commands at ``rate_hz`` (0: the profile's); raises GuardConfigError."""
    axes, period_ns = read_envelope(profile)
    if rate_hz:
        period_ns = 1_000_000_000 // rate_hz
    return Guard(axes, read_layouts(dbc, [*MESSAGES, *(axis.message for axis in axes if axis.message)]), period_ns)


def profile_path(name: str) -> Path:
    """Path of a shipped profile by its name, else ``name`` as a path."""
    shipped = ROOT / "machine" / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


def run(guard: Guard, bus: Bus, ended: list[int], notifier: Notifier) -> None:
    """Run until a signal number is in ``ended``."""
    frames: list[Frame] = []
    link, reading = BusLink(bus), BusReading()
    deadline_ns = time.monotonic_ns() + PERIOD_NS
    while not ended:
        sleep_until(deadline_ns)
        late_ns = time.monotonic_ns() - deadline_ns
        if late_ns >= PERIOD_NS:
            deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
        link.receive(frames, reading)
        link.send(guard.step(deadline_ns, frames))
        link.watch(deadline_ns)
        notifier.tick_done(deadline_ns, late_ns < PERIOD_NS)
        deadline_ns += PERIOD_NS
    notifier.stopping()


def _status_text(guard: Guard, bus: Bus) -> str:
    return f"Valves {'' if guard.enabled else 'not '}enabled: {guard.verdict.name}. The bus is {bus.stats.state.name}."


def main(arguments: list[str] | None = None) -> int:
    """Run the guard; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m controller.guard", description="Checks the traffic on the crane bus and enables the valves."
    )
    parser.add_argument("--profile", required=True, help="shipped profile name or TOML file")
    parser.add_argument("--bus", default="", metavar="crane0=ADDRESS", help="address of the crane bus")
    parser.add_argument("--rate", type=int, default=0, metavar="HZ", help="the controller's, if not the profile's")
    parser.add_argument("--no-realtime", action="store_true", help="do not request FIFO scheduling and locked memory")
    options = parser.parse_args(arguments)
    name, _, address = options.bus.partition("=")
    if options.bus and (name != "crane0" or not address):
        parser.error(f"--bus {options.bus}: write crane0=ADDRESS, as in crane0=socketcan:can0")
    if options.rate < 0:
        parser.error(f"--rate {options.rate}: write the controller's rate in Hz, as in 200")
    keep_memory()
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    try:
        guard = build(profile_path(options.profile), rate_hz=options.rate)
        with open_bus(address or default_address("crane0"), filters=guard.keys) as bus:
            if not options.no_realtime:
                sys.stderr.writelines(f"guard: not granted: {refusal}\n" for refusal in prepare(PRIORITY))
            stop_garbage_collection()
            run(guard, bus, ended, Notifier(lambda: _status_text(guard, bus)))
    except (GuardConfigError, BusError) as error:
        sys.stderr.write(f"guard: {error}\n")
        return 3 if isinstance(error, GuardConfigError) else 4
    return 130 if signal.SIGINT in ended else 0


if __name__ == "__main__":
    sys.exit(main())
