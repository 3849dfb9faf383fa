"""Client of the wire, our user-space CAN bus: a `Bus` over a Unix socket, standard library only.

Protocol (SOCK_SEQPACKET, one socket file per bus in `wire_directory`): a packet is one `RECORD` (from the
daemon: up to `BATCH` of them), or one with flag `CONTROL` followed by a JSON object.  A participant opens
with the control packet ``{"hello": {...}}``.  Every record to a client carries how many of its frames have
left the queue (modulo 2**16) and how many received ones were lost, so the client knows without a round trip
when its transmit queue is full, as a SocketCAN sender does from ENOBUFS.  Frames in the queue of a client
that closes still go out, as long as somebody acknowledges.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from can_dbc.bus import DRAIN_LIMIT, BaseBus, BusError, BusState
from can_dbc.frame import ERROR, Frame

RECORD: Final = struct.Struct("=IB3x8sQHHI")
"""key, length, data: struct can_frame; end-of-frame time [ns, CLOCK_MONOTONIC]; flags; done; dropped."""
CONTROL: Final = 1
STATUS: Final = 2
"""Flag of a record that carries no frame, only the counters."""
BATCH: Final = 64
"""Most records in one packet."""
PACKET_BYTES: Final = 1 << 16
_OPEN_TIMEOUT_S: Final = 2.0
_BACKLOG: Final = 4096


def wire_directory() -> Path:
    """Where the socket files lie: ``TIMBERHAND_WIRE_DIR``, else the user's runtime directory, else a
    directory in the temporary one that belongs to this user."""
    if explicit := os.environ.get("TIMBERHAND_WIRE_DIR"):
        return Path(explicit)
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "timberhand"
    return Path(tempfile.gettempdir()) / f"timberhand-{os.getuid()}"


class WireClient(BaseBus):
    """One participant on a wire bus (contract: `can_dbc.bus.Bus`)."""

    def __init__(
        self,
        name: str,
        keys: frozenset[int] | None = None,
        receive_own: bool = False,
        tx_queue: int = 10,
        participant: str | None = None,
    ) -> None:
        super().__init__(name)
        hello = {
            "name": participant or _program(),
            "keys": None if keys is None else sorted(keys),
            "receive_own": receive_own,
            "tx_queue": tx_queue,
        }
        self._sock, reply = _connect(name, {"hello": hello})
        self._sock.setblocking(False)
        self.bitrate: int = reply["bitrate"]
        self._buffer = bytearray(PACKET_BYTES)
        self._view = memoryview(self._buffer)
        self._backlog: list[Frame] = []  # read while looking for room in the transmit queue
        self._tx_queue = tx_queue
        self._accepted = self._done = self._dropped = 0

    def fileno(self) -> int:
        return self._sock.fileno()

    def drain(self, frames: list[Frame]) -> int:
        fresh: list[Frame] = []
        self.receive(fresh)
        stats, before = self.stats, len(frames)
        frames.extend(frame for frame in fresh if not frame.key & ERROR)
        taken = len(frames) - before
        stats.received += taken
        return taken

    def send(self, key: int, data: bytes) -> bool:
        stats = self.stats
        if self.pending >= self._tx_queue:
            self._read(self._backlog)
            if len(self._backlog) > _BACKLOG:  # somebody who only sends must not grow without bound
                stats.dropped += len(self._backlog) - _BACKLOG
                del self._backlog[:-_BACKLOG]
        if stats.state < BusState.OFF and self.pending < self._tx_queue and len(data) <= 8:
            try:
                self._sock.send(RECORD.pack(key, len(data), data, 0, 0, 0, 0))
            except BlockingIOError:
                pass  # the daemon is behind: refused below
            except OSError:
                stats.state = BusState.DOWN
            else:
                self._accepted += 1
                stats.sent += 1
                return True
        stats.refused += 1
        return False

    def close(self) -> None:
        self._sock.close()
        self.stats.state = BusState.DOWN

    @property
    def pending(self) -> int:
        """Own frames taken but not yet known to have been on the bus."""
        return (self._accepted - self._done) & 0xFFFF

    def receive(self, frames: list[Frame]) -> None:
        """As `drain`, with error frames among the frames."""
        if self._backlog:
            frames.extend(self._backlog)
            self._backlog.clear()
        self._read(frames)

    def _read(self, frames: list[Frame]) -> None:
        stats, view = self.stats, self._view
        if stats.state is BusState.DOWN:
            return
        for _ in range(DRAIN_LIMIT):
            try:
                size = self._sock.recv_into(self._buffer)
            except BlockingIOError:
                return
            except OSError:
                size = 0
            if size == 0:
                stats.state = BusState.DOWN
                return
            for key, length, data, stamp_ns, flags, done, dropped in RECORD.iter_unpack(view[:size]):
                self._done = done
                stats.dropped += (dropped - self._dropped) & 0xFFFF_FFFF
                self._dropped = dropped
                if not flags & STATUS:
                    if key & ERROR:
                        stats.note_error(key, data)
                    frames.append(Frame(stamp_ns, key, data[:length]))


def control(name: str, message: dict[str, Any]) -> dict[str, Any]:
    """Asks the daemon of bus `name` (requests: `hil.wire.daemon`) without taking part in the bus.

    Raises `BusError` when there is no daemon, when it does not answer, or with the reason of its refusal.
    """
    sock, reply = _connect(name, message)
    sock.close()
    return reply


def _connect(name: str, message: dict[str, Any]) -> tuple[socket.socket, dict[str, Any]]:
    """A connection to the daemon and its answer to the first message, a control packet."""
    path = wire_directory() / name
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.settimeout(_OPEN_TIMEOUT_S)
        sock.connect(str(path))
        sock.send(RECORD.pack(0, 0, b"", 0, CONTROL, 0, 0) + json.dumps(message).encode())
        reply: dict[str, Any] = json.loads(sock.recv(PACKET_BYTES)[RECORD.size :])
        if "error" in reply:
            raise BusError(f"The wire daemon of {name} refuses: {reply['error']}.")
    except (OSError, ValueError) as error:
        sock.close()
        raise BusError(
            f"No wire bus {name} answers at {path} ({getattr(error, 'strerror', None) or error}); start one "
            f"with `python -m hil.wire.daemon --bus {name}:1000000`."
        ) from error
    except BusError:
        sock.close()
        raise
    return sock, reply


def _program() -> str:
    """The running program's name; that of the package under ``python -m package``."""
    path = Path(sys.argv[0])
    return path.parent.name if path.stem == "__main__" else path.stem or "python"
