"""The guard process: ``python -m controller.guard --profile FILE --bus crane0=ADDRESS [--bus mach0=ADDRESS]``.

Every 5 ms: receive from both buses, check, send.  A lost bus is reopened when it is back.  Exit codes: 0 ended by
SIGTERM, 3 configuration, 4 no bus at the start, 130 SIGINT.
"""

from __future__ import annotations

from runtime.compiled import stay_interpreted

if __name__ == "__main__":  # before the buses are imported: no fault of the compiler may be in guard and controller
    stay_interpreted()

import argparse
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import PYTHON_CAN, default_address, open_bus
from can_dbc.frame import EXTENDED, Frame, RawFrame
from can_dbc.messages.operator_link import default_path as operator_path
from can_dbc.messages.operator_link import guard_path
from can_dbc.messages.tick_record import BusReading
from controller.guard import carrier
from controller.guard.can_socket import GuardSocket
from controller.guard.envelope import RATES_HZ, SHIPPED, read_envelope
from controller.guard.guard import MESSAGES, Guard
from controller.guard.latch_file import LatchFile, default_path
from controller.guard.layout import GuardConfigError, read_layouts
from controller.guard.operator import OperatorActions
from controller.process.bus_link import BusLink
from controller.process.realtime import prepare, sleep_until, stop_garbage_collection
from runtime.errors import LinkError
from runtime.memory import keep_memory
from runtime.notifier import Notifier

PERIOD_NS: Final = 5_000_000
PRIORITY: Final = 85
DATABASES: Final = Path(__file__).parents[2] / "can_dbc"
BUSES: Final = ("crane0", "mach0")


def build(profile: Path, databases: Path = DATABASES, rate_hz: int = 0, latched: bool = False) -> Guard:
    """Build a guard for a profile file and commands at ``rate_hz`` (0: the profile's); raises GuardConfigError."""
    envelope = read_envelope(profile)
    if rate_hz and not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise GuardConfigError("guard.rate", f"A control rate of {rate_hz} Hz is not possible; choose 50 to 1000 Hz.")
    if rate_hz:
        envelope = envelope._replace(period_ns=1_000_000_000 // rate_hz)
    encoders = [axis.message for axis in envelope.axes if axis.message]
    layouts = read_layouts(databases / "crane.dbc", [*MESSAGES, *encoders])
    if envelope.carrier is not None:
        layouts |= read_layouts(databases / "machine.dbc", list(carrier.MESSAGES))
    return Guard(envelope, layouts, latched)


def profile_path(name: str) -> Path:
    """Return the path of a shipped profile by its name, else ``name`` as a path."""
    shipped = SHIPPED / f"{name}.toml"
    return shipped if shipped.is_file() else Path(name)


def open_link(address: str, keys: Iterable[int]) -> Bus:
    """Open the bus at an address: a kernel's interface by the guard's own socket, the wire by that of its emulation.

    Also where the other processes use python-can's socket: guard and controller must not share a fault.
    """
    backend, _, interface = address.removeprefix(PYTHON_CAN).partition(":")
    return GuardSocket(interface, keys) if backend == "socketcan" and interface else open_bus(address, filters=keys)


def split(frames: list[RawFrame]) -> tuple[list[RawFrame], list[RawFrame]]:
    """Split the guard's frames into those for crane0 (11-bit identifiers) and for mach0 (29 bits)."""
    return [f for f in frames if not f[0] & EXTENDED], [f for f in frames if f[0] & EXTENDED]


def run(
    guard: Guard, buses: list[Bus], ended: list[int], notifier: Notifier, latch: LatchFile, operator: OperatorActions
) -> None:
    """Run until a signal number is in ``ended``; ``buses`` are crane0, and mach0 where the machine has one."""
    frames: list[Frame] = []
    received: list[Frame] = []
    links = [(BusLink(bus), BusReading()) for bus in buses]
    deadline_ns = time.monotonic_ns() + PERIOD_NS
    while not ended:
        sleep_until(deadline_ns)
        late_ns = time.monotonic_ns() - deadline_ns
        if late_ns >= PERIOD_NS:
            deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
        frames.clear()
        for link, reading in links:
            link.receive(received, reading)
            frames += received
        for action in operator.receive(deadline_ns + late_ns % PERIOD_NS):
            guard.hear(action, deadline_ns)
        for (link, _), out in zip(links, split(guard.step(deadline_ns, frames)), strict=False):
            link.send(out)
            link.watch(deadline_ns)
        latch.keep(guard.latched)
        notifier.tick_done(deadline_ns, late_ns < PERIOD_NS)
        deadline_ns += PERIOD_NS
    notifier.stopping()


def _status_text(guard: Guard, buses: list[Bus]) -> str:
    states = " and ".join(bus.stats.state.name for bus in buses)
    return f"Valves {'' if guard.enabled else 'not '}enabled: {guard.verdict.name}. The bus is {states}."


def main(arguments: list[str] | None = None) -> int:
    """Run the guard; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m controller.guard", description="Checks the traffic on the buses and enables the machine."
    )
    parser.add_argument("--profile", required=True, help="shipped profile name or TOML file")
    parser.add_argument("--bus", action="append", default=[], metavar="NAME=ADDRESS", help="address of crane0 or mach0")
    parser.add_argument("--rate", type=int, default=0, metavar="HZ", help="the controller's, if not the profile's")
    parser.add_argument("--operator", type=Path, metavar="FILE", help="the controller's; the guard's is beside it")
    parser.add_argument("--state", type=Path, metavar="FILE", help="there while it is latched, also over a restart")
    parser.add_argument("--no-realtime", action="store_true", help="do not request FIFO scheduling and locked memory")
    options = parser.parse_args(arguments)
    addresses = {name: address for name, _, address in (text.partition("=") for text in options.bus)}
    if not addresses.keys() <= set(BUSES) or not all(addresses.values()):
        parser.error(f"--bus {' '.join(options.bus)}: write crane0=ADDRESS, as in crane0=socketcan:can0, or mach0=...")
    if options.rate < 0:
        parser.error(f"--rate {options.rate}: write the controller's rate in Hz, as in 200")
    keep_memory()
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    try:
        latch = LatchFile(options.state or default_path())
        guard = build(profile_path(options.profile), rate_hz=options.rate, latched=latch.latched)
        with ExitStack() as opened:
            path = guard_path(options.operator or operator_path())
            operator = opened.enter_context(closing(OperatorActions(path, guard.profile_check)))
            needed = [(name, keys) for name, keys in zip(BUSES, guard.keys_of_buses, strict=True) if keys]
            links = [open_link(addresses.get(name) or default_address(name), keys) for name, keys in needed]
            buses = [opened.enter_context(link) for link in links]
            if not options.no_realtime:
                sys.stderr.writelines(f"guard: not granted: {refusal}\n" for refusal in prepare(PRIORITY))
            stop_garbage_collection()
            run(guard, buses, ended, Notifier(lambda: _status_text(guard, buses)), latch, operator)
    except (GuardConfigError, LinkError) as error:
        sys.stderr.write(f"guard: {error}\n")
        return 3 if isinstance(error, GuardConfigError) else 4
    return 130 if signal.SIGINT in ended else 0


if __name__ == "__main__":
    sys.exit(main())
