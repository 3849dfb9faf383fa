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
import errno
import json
import os
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any, Final

from can_dbc.bus.base import BusState
from can_dbc.bus.socketcan import SocketCanBus
from can_dbc.bus.wire_client import CONTROL, DISCARD, MAX_BATCH_RECORDS, MAX_CONTROL_BYTES, wire_directory
from can_dbc.bus.wire_records import RECORD, STATUS
from can_dbc.frame import Frame
from hil.wire.core import WireCore
from hil.wire.faults import Fault
from hil.wire.node import Node
from runtime.errors import LinkError

# -- The participants of a real-time wire bus and the loop that serves them.
#
# A bus is a listening Unix socket and a `WireCore` on CLOCK_MONOTONIC.  Deliveries are batched `GRAIN_NS` apart;
# the stamps keep the exact end of each frame.  A slow client loses frames of its own receive queue, counted, and
# never delays the others.  A SocketCAN interface that goes down is unplugged and tried again until it is back.

GRAIN_NS: Final = 250_000
_SEND_BUFFER_BYTES: Final = 1 << 16
_RX_LIMIT: Final = 4096
_RETRY_NS: Final = 100_000_000
"""Interval at which a lost interface is tried again."""
_SOCKET_PATH_BYTES: Final = 107
"""Length of sun_path (unix(7)) without the terminating zero."""


class Client:
    """One connection; it becomes a node of the core with its hello request."""

    def __init__(self, sock: socket.socket, core: WireCore) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self.sock = sock
        self._core = core
        self._node: Node | None = None
        self._reported_done = 0
        self.blocked = False
        """The socket is full; frames wait in the node's receive queue."""

    def read(self) -> bool:
        """Read everything that the client has sent; False when it is gone or violates the protocol."""
        while True:
            try:
                packet = self.sock.recv(MAX_CONTROL_BYTES)
            except BlockingIOError:
                return True
            except ConnectionResetError:
                continue  # it closed with unread data; what it sent before can still be read
            except OSError:
                return False
            if len(packet) < RECORD.size:
                return False
            if RECORD.unpack_from(packet)[4] & CONTROL:
                self._answer(packet[RECORD.size :])
            elif self._node is None or len(packet) % RECORD.size:
                return False
            else:
                self._queue(self._node, packet)

    def _queue(self, node: Node, packet: bytes) -> None:
        for key, length, data, _, flags, _, _ in RECORD.iter_unpack(packet):
            if flags & DISCARD:
                node.discard()
            elif not self._core.submit(node, key, data[:length]):
                node.done += 1  # it has left the client's queue, but never reaches the bus

    def write(self) -> None:
        """Send what the node has received.  `read` detects that a client is gone, after its last frames."""
        node = self._node
        while node is not None and (node.rx or node.done != self._reported_done):
            done, dropped = node.done & 0xFFFF, node.dropped & 0xFFFF_FFFF
            batch = node.rx[:MAX_BATCH_RECORDS]
            packet = b"".join(
                RECORD.pack(key, len(data), data, stamp_ns, 0, done, dropped) for stamp_ns, key, data in batch
            )
            try:
                self.sock.send(packet or RECORD.pack(0, 0, b"", 0, STATUS, done, dropped))
            except OSError as error:
                self.blocked = error.errno == errno.EAGAIN
                return
            del node.rx[:MAX_BATCH_RECORDS]
            self._reported_done = node.done
        self.blocked = False

    def close(self) -> None:
        self.sock.close()
        if self._node is not None:
            self._core.retire(self._node)

    def _answer(self, body: bytes) -> None:
        try:
            reply = self._execute(json.loads(body))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            reply = {"error": str(error)}
        try:
            self.sock.send(RECORD.pack(0, 0, b"", 0, CONTROL, 0, 0) + json.dumps(reply).encode())
        except OSError:
            return  # the next read or write detects it

    def _execute(self, request: dict[str, Any]) -> dict[str, Any]:
        match request:
            case {"hello": hello} if self._node is None:
                self._node = self._core.attach(
                    str(hello["name"]),
                    filters=hello["filters"],
                    receive_own=bool(hello["receive_own"]),
                    queue_limit=int(hello["tx_queue"]),
                    rx_limit=_RX_LIMIT,
                )
                return {"bus": self._core.name, "bitrate": self._core.bitrate}
            case {"inject": fields}:
                self._core.inject(Fault.from_json(fields))
                return {}
            case {"heal": True}:
                self._core.heal()
                return {}
            case {"restart": str(name)}:
                for node in self._core.nodes:
                    if node.name == name:
                        self._core.restart(node)
                return {}
            case {"stats": True}:
                return _statistics(self._core)
        raise ValueError("unknown request; known are inject, heal, restart and stats")


class Joined:
    """A SocketCAN interface as a participant of a wire bus."""

    blocked = False

    def __init__(self, bus: SocketCanBus, core: WireCore) -> None:
        self.interface = bus.name
        self._bus = bus
        self._core = core
        self._node = core.attach(bus.name, queue_limit=100)
        self._frames: list[Frame] = []

    def read(self) -> bool:
        """Read every frame that the interface has received; False when it is lost."""
        self._bus.drain(self._frames)
        for _, key, data in self._frames:
            self._core.submit(self._node, key, data)
        self._frames.clear()
        return self._bus.stats.state is not BusState.DOWN

    def write(self) -> None:
        for _, key, data in self._node.take():
            self._bus.send(key, data)

    def close(self) -> None:
        self._bus.close()
        self._core.retire(self._node)


class Server:
    """One bus: its listening socket, its core and its participants."""

    def __init__(self, name: str, bitrate: int, directory: Path) -> None:
        self.core = WireCore(bitrate, name)
        self.path = directory / name
        self.core.advance(time.monotonic_ns())
        self.sock = _listen(self.path)
        self.members: dict[int, Client | Joined] = {}
        self.unplugged: dict[str, int] = {}
        """Lost interfaces, and when to try them again [ns]."""

    def accept(self) -> None:
        client = Client(self.sock.accept()[0], self.core)
        self.members[client.sock.fileno()] = client

    def join(self, interface: str) -> None:
        bus = SocketCanBus(interface)
        self.members[bus.fileno()] = Joined(bus, self.core)

    def drop(self, descriptor: int) -> None:
        member = self.members.pop(descriptor)
        member.close()
        if isinstance(member, Joined):
            self.unplugged[member.interface] = 0

    def plug_in(self, now_ns: int) -> None:
        """Try to join the lost interfaces again."""
        for interface, due_ns in list(self.unplugged.items()):
            if now_ns < due_ns:
                continue
            try:
                self.join(interface)
            except LinkError:
                self.unplugged[interface] = now_ns + _RETRY_NS
            else:
                del self.unplugged[interface]

    def close(self) -> None:
        for descriptor in list(self.members):
            self.drop(descriptor)
        self.sock.close()
        self.path.unlink(missing_ok=True)


def serve(servers: list[Server], stop: socket.socket) -> None:
    """Run the buses until `stop` becomes readable."""
    last_ns = 0
    while True:
        listening = {server.sock.fileno(): server for server in servers}
        owner = {descriptor: server for server in servers for descriptor in server.members}
        due_ns = [at_ns for server in servers if (at_ns := server.core.next_ns()) is not None]
        due_ns += [at_ns for server in servers for at_ns in server.unplugged.values()]
        timeout_s = None
        if due_ns:
            timeout_s = max(0, max(min(due_ns), last_ns + GRAIN_NS) - time.monotonic_ns()) * 1e-9
        blocked = [d for d, server in owner.items() if server.members[d].blocked]
        readable, _, _ = select.select([stop.fileno(), *listening, *owner], blocked, [], timeout_s)
        last_ns = time.monotonic_ns()
        if stop.fileno() in readable:
            return
        for server in servers:
            server.plug_in(last_ns)
            server.core.advance(last_ns)
        for descriptor in readable:
            if descriptor in listening:
                listening[descriptor].accept()
            elif not owner[descriptor].members[descriptor].read():
                owner[descriptor].drop(descriptor)
        for server in servers:
            server.core.advance(time.monotonic_ns())
            for member in server.members.values():
                member.write()


def _listen(path: Path) -> socket.socket:
    """Open a listening socket at `path`; the file of a dead daemon is replaced, a running daemon is an error."""
    if (length := len(os.fsencode(path))) > _SOCKET_PATH_BYTES:
        raise LinkError(
            "wire.path-too-long",
            f"The wire bus {path.name} cannot listen at {path}: a socket path has at most {_SOCKET_PATH_BYTES} "
            f"bytes, this one has {length}; choose a shorter directory with --dir or TIMBERHAND_WIRE_DIR.",
        )
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        try:
            sock.bind(str(path))
        except OSError as error:
            if error.errno != errno.EADDRINUSE or not path.is_socket() or _answers(path):
                raise
            path.unlink()
            sock.bind(str(path))
        path.chmod(0o660)
        sock.listen(32)
    except OSError as error:
        sock.close()
        raise LinkError(
            "wire.cannot-listen",
            f"The wire bus {path.name} cannot listen at {path} ({error.strerror or error}); is another wire "
            "daemon running? Stop it, or choose another directory with --dir.",
        ) from error
    return sock


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return False
    return True


def _statistics(core: WireCore) -> dict[str, Any]:
    return {
        "bus": core.name,
        "bitrate": core.bitrate,
        "now_ns": core.now_ns,
        "busy_ns": core.busy_ns,
        "errors": core.errors,
        "nodes": [
            {
                "name": node.name,
                "state": node.state.name,
                "tec": node.tec,
                "rec": node.rec,
                "done": node.done,
                "refused": node.refused,
                "dropped": node.dropped,
            }
            for node in core.nodes
        ],
    }


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
