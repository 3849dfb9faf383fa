"""The controller process: ``python -m controller --profile palms_471 --bus crane0=wire:crane0 --setpoint-port
5005``.

Prints where it listens and what the system refused on stderr, and one JSON line with its timing on stdout at
the end. Exit codes: 0 ended by SIGTERM, 2 usage, 3 configuration, 4 bus or port, 5 ended in a latched fault,
130 SIGINT.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import sys
from pathlib import Path
from typing import Final

from can_dbc.bus import BusError, default_address, open_bus
from can_dbc.setpoint import udp_address
from controller.config import ConfigError, Settings, load
from controller.loop import Address, Loop
from controller.realtime import freeze, prepare
from controller.step import Controller
from machine.faults import describe
from machine.modes import Mode

PRIORITY: Final = 80


def address(text: str) -> Address:
    """HOST:PORT of a command line; raises ArgumentTypeError."""
    try:
        return udp_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="python -m controller",
        description="Closes the joint and grapple loops of the crane over CAN.",
        epilog="example: python -m controller --profile palms_471 --bus crane0=socketcan:can0 "
        "--setpoint-port 5005 --report 127.0.0.1:5006",
    )
    made.add_argument("--profile", required=True, help="shipped profile name or TOML file")
    made.add_argument("--bus", default="", metavar="crane0=ADDRESS", help="where the crane bus is")
    made.add_argument("--setpoint-port", type=int, required=True, help="UDP port on 127.0.0.1; 0 takes a free one")
    made.add_argument("--report", type=address, action="append", default=[], metavar="HOST:PORT",
                      help="where state reports go; may be given more than once")  # fmt: skip
    made.add_argument("--record", type=address, metavar="HOST:PORT", help="where every tick's record goes")
    made.add_argument("--rate", type=int, default=0, metavar="HZ", help="control rate; default: the profile's")
    made.add_argument("--key-file", type=Path, help="file with the key that authenticates datagrams")
    made.add_argument("--cpu", type=int, help="processor to run on; only one that is kept free for it")
    made.add_argument("--no-realtime", action="store_true", help="do not ask for FIFO and locked memory")
    return made


def listen(port: int) -> socket.socket:
    """The setpoint socket, on loopback only; raises BusError."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        made.close()
        raise BusError(f"UDP port {port} cannot be used ({error}); end its user or choose another port.") from error
    made.setblocking(False)
    return made


def settings_of(options: argparse.Namespace) -> Settings:
    """The validated configuration of a command line; raises ConfigError."""
    key = None
    if options.key_file is not None:
        try:
            key = options.key_file.read_bytes().strip()
        except OSError as error:
            raise ConfigError(f"{options.key_file}: the key cannot be read: {error.strerror}.") from error
        if len(key) < 16:
            raise ConfigError(f"{options.key_file}: a key of {len(key)} bytes is too short; use at least 16.")
    return load(options.profile, options.rate, key)


def summary(loop: Loop) -> str:
    """One JSON line on how the loop ran."""
    supervisor = loop.controller.supervisor
    return json.dumps(
        {
            "ticks": loop.work.count, "missed": loop.missed, "late": loop.lateness.summary(),
            "tick": loop.work.summary(), "unsent": loop.unsent, "unrecorded": loop.unrecorded,
            "mode": supervisor.mode.name, "reason": supervisor.reason.name,
        }
    )  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Starts the controller; returns the exit code."""
    made = parser()
    options = made.parse_args(arguments)
    name, _, where = options.bus.partition("=")
    if options.bus and (name != "crane0" or not where):
        made.error(f"--bus {options.bus}: write crane0=ADDRESS, as in crane0=socketcan:can0")
    where = where or default_address("crane0")
    try:
        settings = settings_of(options)
        controller = Controller(settings)
        bus = open_bus(where, tx_queue=32)
        setpoints = listen(options.setpoint_port)
    except ConfigError as error:
        sys.stderr.write(f"controller: {error}\n")
        return 3
    except BusError as error:
        sys.stderr.write(f"controller: {error}\n")
        return 4
    loop = Loop(controller, bus, setpoints, options.report, options.record, settings.period_ns)
    ended: list[int] = []

    def end(number: int, _frame: object) -> None:
        ended.append(number)
        loop.stop()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    sys.stderr.write(
        f"controller: {settings.profile.name} at {settings.rate_hz} Hz on {where}, "
        f"setpoints on 127.0.0.1:{setpoints.getsockname()[1]}\n"
    )
    if options.no_realtime:
        freeze()
    else:
        for refusal in prepare(PRIORITY, options.cpu):
            sys.stderr.write(f"controller: not granted: {refusal}\n")
    try:
        loop.run()
    finally:
        loop.close()
    sys.stdout.write(summary(loop) + "\n")
    supervisor = controller.supervisor
    if loop.bus_lost:
        sys.stderr.write(f"controller: the bus {where} is gone; bring it up and start the controller again.\n")
        return 4
    if supervisor.mode is Mode.FAULT:
        sys.stderr.write(f"controller: {describe(supervisor.reason, supervisor.detail)}\n")
        return 5
    return 130 if signal.SIGINT in ended else 0


if __name__ == "__main__":
    sys.exit(main())
