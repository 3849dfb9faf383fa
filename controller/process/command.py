"""The command line of the controller process, and the process from its configuration to its exit code.

Prints its addresses and what the system refused on stderr, and one JSON line with its timing on stdout at the end;
while it runs, its timing is in shared memory (`can_dbc.timing.page`).  Exit codes: 0 ended by SIGTERM, 2 usage, 3
configuration, 4 no bus or port at the start, 5 ended in a latched fault, 130 SIGINT.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus, FilterItem
from can_dbc.bus.factory import default_address, open_bus
from can_dbc.dbc.codec import load as read_dbc
from can_dbc.messages.envelope import read_key
from can_dbc.messages.operator_link import default_path as operator_path
from can_dbc.messages.record_ring import RecordRing
from can_dbc.messages.record_ring import default_path as ring_path
from can_dbc.messages.udp_address import address_argument
from can_dbc.timing.page import METRIC_KEYS, STAGES, TimingWriter, default_path
from controller.config import Settings, load
from controller.process.loop import Loop
from controller.process.operator_socket import OperatorSocket
from controller.process.realtime import make_sleep, prepare, stop_garbage_collection
from controller.process.setpoint_port import listen
from controller.process.timing import LoopTiming
from controller.process.warm_up import warm_up
from controller.step import Controller
from machine.status.explanation import describe
from machine.status.modes import Mode
from runtime.compiled import running
from runtime.errors import ConfigError, LinkError
from runtime.memory import collapse_heap, keep_memory

PRIORITY: Final = 80


def parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="python -m controller",
        description="Closes the joint and grapple loops of the machine over CAN.",
        epilog="example: python -m controller --profile palms_471 --bus crane0=socketcan:can0 "
        "--setpoint-port 5005 --report 127.0.0.1:5006 --key-file key",
    )
    made.add_argument("--profile", required=True, help="shipped profile name or TOML file")
    made.add_argument(
        "--bus",
        type=bus_address,
        action="append",
        default=[],
        metavar="NAME=ADDRESS",
        help="address of crane0 and, on a machine with a carrier, of mach0",
    )
    made.add_argument("--setpoint-port", type=int, required=True, help="UDP port on 127.0.0.1; 0 chooses a free one")
    made.add_argument(
        "--operator",
        type=Path,
        metavar="FILE",
        help="Unix socket for the operator's commands; default: beside the timing page",
    )
    made.add_argument(
        "--report",
        type=address_argument,
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="receiver of state reports; may be given more than once",
    )
    made.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="ring of tick records in shared memory; default: beside the timing page",
    )
    made.add_argument("--rate", type=int, default=0, metavar="HZ", help="control rate; default: the profile's")
    made.add_argument(
        "--key-file",
        type=Path,
        required=True,
        metavar="FILE",
        help="file with the key of setpoints and reports, 16 bytes or more",
    )
    made.add_argument("--cpu", type=int, help="processor to run on; use only an isolated one")
    made.add_argument(
        "--spin-us",
        type=int,
        default=0,
        metavar="US",
        help="poll the clock for the last US before a wake-up; on a processor of its own",
    )
    made.add_argument("--dma-latency", action="store_true", help="keep the processors out of deep sleep states")
    made.add_argument("--sync-lead-us", type=int, metavar="US", help="SYNC before the tick; default: 0.6 periods")
    made.add_argument("--timing", type=Path, metavar="FILE", help="file of the timing page; default: in shared memory")
    made.add_argument("--no-realtime", action="store_true", help="do not request FIFO scheduling and locked memory")
    made.add_argument("--interpreter", action="store_true", help="do not use the compiled tick")
    return made


def bus_address(text: str) -> tuple[str, str]:
    """Parse NAME=ADDRESS; raises ArgumentTypeError."""
    name, _, where = text.partition("=")
    if name not in ("crane0", "mach0") or not where:
        raise argparse.ArgumentTypeError(f"{text}: write NAME=ADDRESS, as in crane0=socketcan:can0")
    return name, where


def operator_socket(path: Path) -> OperatorSocket:
    """Open the operators' socket; raises LinkError."""
    try:
        return OperatorSocket(path)
    except OSError as error:
        sentence = f"The operator's socket {path} cannot be made ({error.strerror}); choose another with --operator."
        raise LinkError("operator.socket", sentence) from error


def addresses(settings: Settings, given: dict[str, str]) -> dict[str, str]:
    """Map each name to the address of the machine's buses in the loop's order; raises ConfigError."""
    profile = settings.profile
    buses = [name for name in (profile.crane_bus, profile.machine_bus) if name]
    for name in given:
        if name not in buses:
            raise ConfigError(
                "config.no-such-bus",
                f"{profile.name} has no bus {name}, only {' and '.join(buses)}; leave --bus {name} out.",
            )
    return {name: given.get(name) or default_address(name) for name in buses}


def open_buses(where: dict[str, str], controller: Controller, settings: Settings) -> list[Bus]:
    """Open all buses or none, each with the filter of the controller's inputs; raises LinkError."""
    filters: list[list[FilterItem]] = [[*controller.crane_inputs.filters()]]
    if controller.carrier_bus is not None:
        filters.append(controller.carrier_bus.inputs.filters())
    opened: list[Bus] = []
    try:
        for address, keys, queue in zip(where.values(), filters, settings.tx_queue_frames, strict=False):
            opened.append(open_bus(address, filters=keys, tx_queue=queue))
    except LinkError:
        for bus in opened:
            bus.close()
        raise
    return opened


def timing_writer(path: Path | None) -> TimingWriter | None:
    """Open the timing page; without one the controller runs as well, and reports that on stderr."""
    path = path or default_path()
    try:
        return TimingWriter(path)
    except OSError as error:
        sys.stderr.write(f"controller: not granted: timing page {path}: {error.strerror}\n")
        return None


def record_ring(path: Path | None) -> RecordRing | None:
    """Open the ring of tick records; without one the controller runs as well, and reports that on stderr."""
    path = path or ring_path()
    try:
        return RecordRing(path)
    except OSError as error:
        sys.stderr.write(f"controller: not granted: tick records {path}: {error.strerror}\n")
        return None


def summary(loop: Loop) -> str:
    """Return the statistics of the loop as one JSON line."""
    supervisor = loop.controller.supervisor
    return json.dumps(
        {
            "ticks": loop.ticks,
            "missed": loop.missed,
            "late": supervisor.late,
            "timing": {METRIC_KEYS[name]: loop.timing.durations[name].summary() for name in STAGES},
            "unsent": loop.unsent,
            "unrecorded": loop.unrecorded,
            "mode": supervisor.mode.name,
            "reason": supervisor.reason.name,
            "tick": str(running()),
        }
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the controller; returns the exit code."""
    made = parser()
    options = made.parse_args(arguments)
    keep_memory()
    try:
        settings, key = load(options.profile, options.rate), read_key(options.key_file)
        database = read_dbc("crane")
        warm_up(settings, Controller(settings, database), key)
        controller = Controller(settings, database)
        lead_ns = settings.sync_lead_ns if options.sync_lead_us is None else options.sync_lead_us * 1000
        if not 0 <= lead_ns < settings.period_ns:
            raise ConfigError(
                "config.sync-lead", f"--sync-lead-us {options.sync_lead_us}: the lead must be shorter than the period."
            )
        where = addresses(settings, dict(options.bus))
        buses = open_buses(where, controller, settings)
        setpoints = listen(options.setpoint_port)
        operator = operator_socket(options.operator or operator_path())
        timing = LoopTiming(controller, timing_writer(options.timing))
        loop = Loop(
            controller,
            buses,
            setpoints,
            operator,
            options.report,
            record_ring(options.record),
            timing,
            settings.period_ns,
            lead_ns,
            sleep=make_sleep(options.spin_us * 1000),
            key=key,
        )
    except ConfigError as error:
        sys.stderr.write(f"controller: {error}\n")
        return 3
    except LinkError as error:
        sys.stderr.write(f"controller: {error}\n")
        return 4
    ended: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended.append(number)
        loop.stop()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    shown = " and ".join(f"{name}={address}" for name, address in where.items())
    sys.stderr.write(
        f"controller: {settings.profile.name} at {settings.rate_hz} Hz on {shown}, "
        f"setpoints on 127.0.0.1:{setpoints.getsockname()[1]}; tick: {running()}\n"
    )
    if not options.no_realtime:
        for refusal in prepare(PRIORITY, options.cpu, options.dma_latency):
            sys.stderr.write(f"controller: not granted: {refusal}\n")
        sys.stderr.write(f"controller: {collapse_heap() >> 20} MiB of memory on huge pages\n")
    stop_garbage_collection()
    try:
        loop.run()
    finally:
        loop.close()
    sys.stdout.write(summary(loop) + "\n")
    supervisor = controller.supervisor
    if supervisor.mode is Mode.FAULT:
        why = describe(supervisor.reason, supervisor.detail, controller.evidence.numbers)
        sys.stderr.write(f"controller: {why}\n")
        return 5
    return 130 if signal.SIGINT in ended else 0
