"""The guard's own way to a CAN interface of the kernel: a raw socket, one frame per system call, standard library only.

It shares no code with the controller's fast path (`can_dbc.bus.socketcan`): neither its buffers nor its clocks nor its
reading of error frames, so that one fault in them cannot blind both channels.  A frame's time is the kernel's, moved to
the monotonic clock and kept between the last two looks at the socket: setting the wall clock shifts it by no more than
the time between them.

Contract: `can_dbc.bus.base.Bus`, as far as a guard needs it.  Source: linux/can/raw.h, linux/can/error.h, socket(7).
"""

from __future__ import annotations

import errno
import fcntl
import socket
import struct
import time
from collections.abc import Iterable, Sequence
from typing import Final, Self

from can_dbc.bus.base import BusState, BusStats
from can_dbc.frame import EXTENDED, EXTENDED_MASK, REMOTE, Frame
from runtime.errors import LinkError

MOST_FRAMES: Final = 512
"""Frames read at one look: a flooded bus must not delay the guard."""
_FRAME: Final = struct.Struct("=IB3x8s")
_TIME: Final = struct.Struct("@qq")
_SO_TIMESTAMPNS: Final = 35
_SECOND_NS: Final = 1_000_000_000
_PAUSE_NS: Final = 100_000
_BUFFER_BYTES: Final = 1 << 20
_ERROR_FRAME: Final = 0x2000_0000
_BUS_OFF, _RESTARTED, _CONTROLLER = 0x40, 0x100, 0x04
_PASSIVE, _WARNING = 0x30, 0x0C
_CAN_RAW_ERR_FILTER: Final = 2
_GET_FLAGS: Final = 0x8913
_UP, _RUNNING = 0x1, 0x40


def _clocks() -> tuple[int, int]:
    """Read the monotonic time, and what must be added to the wall clock to get it, without a pause between."""
    for _ in range(3):
        before_ns, wall_ns, now_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if now_ns - before_ns < _PAUSE_NS:
            break
    return now_ns, now_ns - wall_ns


class GuardSocket:
    """One raw socket on one interface; ``keys``: the identifiers with kind bits, or (key, mask) pairs, to receive."""

    def __init__(self, interface: str, keys: Iterable[int | tuple[int, int]]) -> None:
        self.name = interface
        self.stats = BusStats()
        pairs = [key if isinstance(key, tuple) else (key, EXTENDED_MASK) for key in keys]
        kind = EXTENDED | REMOTE
        masked = [(key & (mask | kind), mask & EXTENDED_MASK | kind) for key, mask in pairs]
        self._filters = b"".join(struct.pack("=II", *pair) for pair in masked)
        self._looked_ns = time.monotonic_ns()
        try:
            self._socket: socket.socket | None = self._open(_UP)
        except OSError as error:
            raise LinkError(
                "bus.interface",
                f"CAN interface {interface} cannot be opened ({error.strerror}); see `ip link`, and bring it up with "
                f"`ip link set {interface} up`.",
            ) from error

    def fileno(self) -> int:
        """Return the socket's descriptor, -1 while the link is lost."""
        return -1 if self._socket is None else self._socket.fileno()

    def drain(self, frames: list[Frame]) -> int:
        """Append the waiting frames, at most `MOST_FRAMES`; returns how many."""
        link, first = self._socket, len(frames)
        if link is None:
            return 0
        since_ns, (now_ns, offset_ns) = self._looked_ns, _clocks()
        self._looked_ns = now_ns
        try:
            for _ in range(MOST_FRAMES):
                datagram, control, _, _ = link.recvmsg(_FRAME.size, 64)
                key, length, data = _FRAME.unpack(datagram)
                if key & _ERROR_FRAME:
                    if self._note(key, data):
                        del frames[first:]  # they are from before the node recovered
                    continue
                stamp_ns = now_ns
                for level, kind, content in control:
                    if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                        seconds, nanoseconds = _TIME.unpack(content[: _TIME.size])
                        stamp_ns = seconds * _SECOND_NS + nanoseconds + offset_ns
                frames.append(Frame(min(max(stamp_ns, since_ns), time.monotonic_ns()), key, data[:length]))
        except BlockingIOError:
            pass
        except OSError:
            self._lose()
        self.stats.received += len(frames) - first
        return len(frames) - first

    def send(self, key: int, data: bytes) -> bool:
        """Send one frame; False if the kernel did not accept it."""
        return self.send_all(((key, data),)) == 1

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        """Send frames in order up to the first that the kernel does not accept; returns how many it accepted.

        Nothing is sent while the node is bus-off: the kernel would accept and silently drop it.
        """
        sent = 0
        if self._socket is not None and self.stats.state < BusState.OFF:
            try:
                for key, data in frames:
                    self._socket.send(_FRAME.pack(key, len(data), data))
                    sent += 1
            except OSError as error:
                if error.errno in (errno.ENETDOWN, errno.ENODEV, errno.ENXIO):
                    self._lose()
        self.stats.sent += sent
        self.stats.refused += len(frames) - sent
        return sent

    def discard(self) -> int:
        """Cancel nothing: the queue of an interface cannot be emptied from outside."""
        return 0

    def flush(self) -> None:
        """Discard the frames received so far."""
        while self.drain([]) == MOST_FRAMES:
            pass

    def reopen(self) -> bool:
        """Make one attempt to open a lost link again; True if the bus is usable."""
        if self._socket is None and self.stats.state is BusState.DOWN:
            try:
                self._socket = self._open(_UP | _RUNNING)
            except OSError:
                return False
            self._looked_ns = time.monotonic_ns()
            self.stats.enter(BusState.ACTIVE)
        return self.stats.state < BusState.OFF

    def close(self) -> None:
        """Leave the bus."""
        self._lose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, needed: int) -> socket.socket:
        """Open a bound socket; OSError unless the interface is there with the flags ``needed``."""
        link = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            flags = struct.unpack("16sH14x", fcntl.ioctl(link, _GET_FLAGS, struct.pack("16s16x", self.name.encode())))[
                1
            ]
            if flags & needed != needed:
                raise OSError(errno.ENETDOWN, "it is down")
            link.setblocking(False)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            link.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            link.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, EXTENDED_MASK)
            link.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, self._filters)
            link.bind((self.name,))
        except OSError:
            link.close()
            raise
        return link

    def _lose(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self.stats.enter(BusState.DOWN)

    def _note(self, key: int, data: bytes) -> bool:
        """Change the state by an error frame; True if the node has recovered from bus-off."""
        stats = self.stats
        stats.error_frames += 1
        if key & _BUS_OFF:
            return stats.enter(BusState.OFF)
        if key & _RESTARTED:
            return stats.enter(BusState.ACTIVE)
        if key & _CONTROLLER and stats.state is not BusState.OFF:
            flags = data[1]
            state = BusState.PASSIVE if flags & _PASSIVE else BusState.WARNING if flags & _WARNING else BusState.ACTIVE
            return stats.enter(state)
        return False
