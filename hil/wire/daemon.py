"""The wire as a process: real-time CAN buses in user space that any program of this user can join.

    python -m hil.wire.daemon --bus crane0:1000000 --bus mach0:250000

Each bus is a Unix socket in `wire_directory` (protocol: `can_dbc.bus.wire_client`).  ``--join crane0=can0`` makes
a SocketCAN interface a participant: with two of them the wire is a cable between the two, on which faults can be
injected.

Control requests (`can_dbc.bus.wire_client.control`): ``{"inject": Fault.to_json()}``, ``{"heal": true}``,
``{"restart": "participant"}``, ``{"stats": true}``.  Prints ``ready`` when every bus accepts clients.
Exit codes: 0 stopped by SIGINT or SIGTERM, 2 usage, 4 bus busy or not available.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
from pathlib import Path

from can_dbc.bus.wire_client import wire_directory
from hil.wire.server import Server, serve
from runtime.errors import LinkError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m hil.wire.daemon", description="User-space CAN buses.")
    parser.add_argument("--bus", action="append", required=True, type=_bus, metavar="NAME:BITRATE")
    parser.add_argument(
        "--join",
        action="append",
        default=[],
        type=_join,
        metavar="NAME=INTERFACE",
        help="let a SocketCAN interface take part",
    )
    parser.add_argument(
        "--dir",
        type=Path,
        help="directory of the sockets (default: TIMBERHAND_WIRE_DIR or the user's runtime directory)",
    )
    parser.add_argument("--ready-fd", type=int, help="also write 'ready' to this descriptor and close it")
    options = parser.parse_args(arguments)
    stop, wakeup = socket.socketpair()
    wakeup.setblocking(False)
    signal.set_wakeup_fd(wakeup.fileno())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    servers: list[Server] = []
    try:
        directory = options.dir or wire_directory()
        _prepare(directory)
        for name, bitrate in options.bus:
            servers.append(Server(name, bitrate, directory))
        for name, interface in options.join:
            server = next((server for server in servers if server.core.name == name), None)
            if server is None:
                parser.error(f"--join {name}={interface}: there is no --bus {name}")
            server.join(interface)
        print("ready", flush=True)
        if options.ready_fd is not None:
            os.write(options.ready_fd, b"ready\n")
            os.close(options.ready_fd)
        serve(servers, stop)
    except LinkError as error:
        print(f"{error} [{error.code}]", file=sys.stderr)
        return 4
    finally:
        for server in servers:
            server.close()
    return 0


def _prepare(directory: Path) -> None:
    """Make the directory for this user only; a directory of another user is not trusted."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        owner = directory.stat().st_uid
    except OSError as error:
        sentence = f"The wire directory {directory} cannot be created ({error.strerror})."
        raise LinkError("wire.directory", sentence) from error
    if owner not in (os.getuid(), 0):
        sentence = f"The wire directory {directory} belongs to another user; choose another with --dir."
        raise LinkError("wire.directory-owner", sentence)


def _bus(text: str) -> tuple[str, int]:
    name, _, bitrate = text.partition(":")
    if not name or "/" in name or not bitrate.isdigit() or not int(bitrate) or 1_000_000_000 % int(bitrate):
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME:BITRATE, as in crane0:1000000")
    return name, int(bitrate)


def _join(text: str) -> tuple[str, str]:
    name, _, interface = text.partition("=")
    if not name or not interface:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=INTERFACE, as in crane0=can0")
    return name, interface


if __name__ == "__main__":
    sys.exit(main())
