"""Client of the wire, the user-space CAN bus: a `Bus` over a Unix socket, standard library only.

Protocol (SOCK_SEQPACKET, one socket file per bus in `wire_directory`): a packet is up to `MAX_BATCH_RECORDS`
`RECORD`s, or one with flag `CONTROL` followed by a JSON object.  A participant starts with the control packet
``{"hello": {...}}``.  Every record to a client carries the number of its frames that have left the queue (modulo 2**16)
and the number of received frames that were lost, so the client knows without a round trip when its transmit queue is
full, as a SocketCAN sender does from ENOBUFS.  A record with flag `DISCARD` empties the transmit queue of its sender.
Frames in the queue of a client that closes are still sent as long as another node acknowledges.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from can_dbc.bus.base import BaseBus, BusState, Filter
from can_dbc.bus.batch import Batch
from can_dbc.bus.wire_records import RECORD, RECORD_BYTES, pack, read
from can_dbc.frame import Frame
from runtime.errors import LinkError

CONTROL: Final = 1
DISCARD: Final = 4
MAX_BATCH_RECORDS: Final = 64
"""Most records in one packet."""
MAX_CONTROL_BYTES: Final = 1 << 16
"""Most bytes of a control packet."""
_MAX_PACKETS: Final = 16
"""Most packets received by one system call."""
_OPEN_TIMEOUT_S: Final = 2.0
_REOPEN_TIMEOUT_S: Final = 0.002
_MAX_BACKLOG_FRAMES: Final = 4096
_OFF: Final = BusState.OFF
_DOWN: Final = BusState.DOWN


def wire_directory() -> Path:
    """Return the directory of the socket files: ``TIMBERHAND_WIRE_DIR``, else the user's runtime directory, else a
    directory of this user in the temporary one.
    """
    if explicit := os.environ.get("TIMBERHAND_WIRE_DIR"):
        return Path(explicit)
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "timberhand"
    return Path(tempfile.gettempdir()) / f"timberhand-{os.getuid()}"


class WireClient(BaseBus):
    """One participant on a wire bus (contract: `can_dbc.bus.base.Bus`).

    With `error_frames`, `drain` also returns error frames and keeps the frames from before a recovery, as python-can's
    programs expect.
    """

    def __init__(
        self,
        name: str,
        wanted: Filter | None = None,
        receive_own: bool = False,
        tx_queue: int = 10,
        participant: str | None = None,
        error_frames: bool = False,
    ) -> None:
        super().__init__(name)
        hello = {
            "name": participant or _program(),
            "filters": None if wanted is None else wanted.pairs,
            "receive_own": receive_own,
            "tx_queue": tx_queue,
        }
        self._hello = {"hello": hello}
        self._tx_queue = tx_queue
        self._error_frames = error_frames
        self._batch = Batch(RECORD.size * MAX_BATCH_RECORDS, count=_MAX_PACKETS)
        self._backlog: list[Frame] = []  # received while waiting for room in the transmit queue
        self._opening: socket.socket | None = None  # a new connection whose hello is not answered yet
        self._accepted = self._done = self._dropped = self._cancelled = 0
        self._sock, reply = _connect(name, self._hello)
        self._sock.setblocking(False)
        self.bitrate: int = reply["bitrate"]

    def fileno(self) -> int:
        return self._sock.fileno()

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        stats, sent = self.stats, 0
        while sent < len(frames):
            if self.pending + len(frames) - sent > self._tx_queue and stats.state is not _DOWN:
                self._read(self._backlog, 0)
                self._bound_backlog()
            room = self._tx_queue - self.pending if stats.state < _OFF else 0
            packet = pack(frames, sent, max(0, min(room, MAX_BATCH_RECORDS)))
            if not packet or not self._post(packet):
                break
            count = len(packet) // RECORD_BYTES
            self._accepted += count
            sent += count
        stats.sent += sent
        stats.refused += len(frames) - sent
        return sent

    def flush(self) -> None:
        self.discard()
        super().flush()

    def discard(self) -> int:
        waiting = min(self.pending, self._accepted - self._cancelled)
        if not waiting or self.stats.state is _DOWN or not self._post(RECORD.pack(0, 0, b"", 0, DISCARD, 0, 0)):
            return 0
        self._cancelled = self._accepted
        self.stats.refused += waiting
        return waiting

    @property
    def pending(self) -> int:
        """Own frames accepted but not yet known to have been on the bus."""
        return (self._accepted - self._done) & 0xFFFF

    def _receive(self, frames: list[Frame]) -> None:
        first = len(frames)
        if self._backlog:
            frames.extend(self._backlog)
            self._backlog.clear()
        self._read(frames, first)

    def _read(self, frames: list[Frame], first: int) -> None:
        """Append the frames waiting in the socket; at a recovery remove all from `first` on."""
        stats = self.stats
        counters = read(self._batch, self._sock.fileno(), frames, first, stats, self._error_frames)
        if counters is None:
            stats.enter(BusState.DOWN)
            return
        done, dropped = counters
        if done >= 0:
            self._done = done
            stats.dropped += (dropped - self._dropped) & 0xFFFF_FFFF
            self._dropped = dropped

    def _bound_backlog(self) -> None:
        """Bound the backlog of a client that only sends."""
        surplus = len(self._backlog) - _MAX_BACKLOG_FRAMES
        if surplus > 0:
            self.stats.dropped += surplus
            del self._backlog[:surplus]

    def _post(self, packet: bytes) -> bool:
        try:
            self._sock.send(packet)
        except BlockingIOError:  # the daemon is too slow
            return False
        except OSError:
            self.stats.enter(BusState.DOWN)
            return False
        return True

    def _reopen_link(self) -> bool:
        """Send one hello to a slow daemon; later calls only check for its answer."""
        timeout_s = 0.0
        try:
            if self._opening is None:
                timeout_s = _REOPEN_TIMEOUT_S
                self._opening = _connect_and_send(self.name, self._hello, 0.0)
            if not select.select([self._opening], [], [], timeout_s)[0]:
                return False
            reply = _receive_answer(self.name, self._opening)
        except (LinkError, OSError, ValueError):
            self._close_opening()
            return False
        self._sock.close()
        self._sock, self._opening = self._opening, None
        self._backlog.clear()
        self._accepted = self._done = self._dropped = self._cancelled = 0
        self.bitrate = reply["bitrate"]
        return True

    def _close_opening(self) -> None:
        if self._opening is not None:
            self._opening.close()
            self._opening = None

    def _release(self) -> None:
        self._close_opening()
        self._sock.close()


def control(name: str, message: dict[str, Any]) -> dict[str, Any]:
    """Send a request to the daemon of bus `name` (see `hil.wire.daemon`) without joining the bus; returns its answer.

    Raises:
        LinkError: There is no daemon, it does not answer, or it refuses; the sentence has its reason.
    """
    sock, reply = _connect(name, message)
    sock.close()
    return reply


def _connect(name: str, message: dict[str, Any]) -> tuple[socket.socket, dict[str, Any]]:
    """Connect to the daemon; returns the socket and the answer to the first message; raises `LinkError`."""
    sock = None
    try:
        sock = _connect_and_send(name, message, _OPEN_TIMEOUT_S)
        return sock, _receive_answer(name, sock)
    except (LinkError, OSError, ValueError) as error:
        if sock is not None:
            sock.close()
        if isinstance(error, LinkError):
            raise
        raise LinkError(
            "wire.no-daemon",
            f"No wire bus {name} answers at {wire_directory() / name} ({getattr(error, 'strerror', None) or error}); "
            f"start one with `python -m hil.wire.daemon --bus {name}:1000000`.",
        ) from error


def _connect_and_send(name: str, message: dict[str, Any], timeout_s: float) -> socket.socket:
    """Connect to the daemon and send the first control packet; raises OSError."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.settimeout(timeout_s)
        sock.connect(str(wire_directory() / name))
        sock.send(RECORD.pack(0, 0, b"", 0, CONTROL, 0, 0) + json.dumps(message).encode())
    except OSError:
        sock.close()
        raise
    return sock


def _receive_answer(name: str, sock: socket.socket) -> dict[str, Any]:
    """Receive the daemon's answer to a control packet; raises OSError if none comes, LinkError for a refusal."""
    reply: dict[str, Any] = json.loads(sock.recv(MAX_CONTROL_BYTES)[RECORD.size :])
    if "error" in reply:
        raise LinkError("wire.refused", f"The wire daemon of {name} refuses: {reply['error']}.")
    return reply


def _program() -> str:
    """Return the name of the running program; for ``python -m package`` that of the package."""
    path = Path(sys.argv[0])
    return path.parent.name if path.stem == "__main__" else path.stem or "python"
