"""A CAN bus of the Linux kernel over a raw socket: the fast path, standard library only.

Receive stamps are the kernel's own (taken in the receive interrupt), turned from CLOCK_REALTIME into
CLOCK_MONOTONIC with the offset at each drain; they never lie in the future.  Frames lost in the socket
buffer are counted (SO_RXQ_OVFL).  A link that goes down makes the state DOWN; the first frame that passes
again makes it ACTIVE.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from typing import Final

from can_dbc.batch import Batch, widen
from can_dbc.bus import DRAIN_LIMIT, BaseBus, BusError, BusState
from can_dbc.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK, Frame

CAN_FRAME: Final = struct.Struct("=IB3x8s")  # struct can_frame, linux/can.h
_CONTROL: Final = struct.Struct("@NiillNiiI4x")
"""Control data of a frame: struct cmsghdr and timespec of SO_TIMESTAMPNS, then, once frames were lost, SO_RXQ_OVFL."""
_CONTROL_DROPPED: Final = 52
"""Control data that holds the second message is at least this long."""
# Options that Python does not name everywhere: asm-generic/socket.h and linux/can/raw.h.
_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40
_CAN_RAW_ERR_FILTER: Final = 2
_ERR_MASK: Final = 0x1FFF_FFFF
_RECEIVE_BUFFER_BYTES: Final = 4 << 20
_LINK_LOST: Final = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)


class SocketCanBus(BaseBus):
    """One raw socket on one interface (contract: `can_dbc.bus.Bus`)."""

    def __init__(self, interface: str, keys: frozenset[int] | None = None, receive_own: bool = False) -> None:
        super().__init__(interface)
        try:
            self._sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise BusError(
                f"This kernel has no raw CAN sockets ({error.strerror}), so socketcan:{interface} cannot be "
                "opened; load the modules can and can_raw, or use the wire: wire:crane0."
            ) from error
        raw, general = socket.SOL_CAN_RAW, socket.SOL_SOCKET
        try:
            self._sock.setblocking(False)
            widen(self._sock, _RECEIVE_BUFFER_BYTES)
            self._sock.setsockopt(general, _SO_TIMESTAMPNS, 1)
            self._sock.setsockopt(general, _SO_RXQ_OVFL, 1)
            self._sock.setsockopt(raw, _CAN_RAW_ERR_FILTER, _ERR_MASK)
            self._sock.setsockopt(raw, socket.CAN_RAW_RECV_OWN_MSGS, int(receive_own))
            if keys is not None:
                self._sock.setsockopt(raw, socket.CAN_RAW_FILTER, b"".join(map(_kernel_filter, sorted(keys))))
            self._sock.bind((interface,))
        except OSError as error:
            self._sock.close()
            raise BusError(
                f"CAN interface {interface} cannot be opened ({error.strerror}); see `ip link`, and bring it "
                f"up with `ip link set {interface} up`."
            ) from error
        self._batch = Batch(CAN_FRAME.size, _CONTROL.size)
        self._dropped = 0

    def fileno(self) -> int:
        return self._sock.fileno()

    def drain(self, frames: list[Frame]) -> int:
        batch, before = self._batch, len(frames)
        for _ in range(DRAIN_LIMIT // batch.count):
            try:
                waiting = batch.receive(self._sock.fileno())
            except OSError:  # the link went down; a later call may find it up again
                self.stats.state = BusState.DOWN
                break
            if waiting:
                self._take(waiting, frames)
            if waiting < batch.count:
                break
        taken = len(frames) - before
        self.stats.received += taken
        return taken

    def _take(self, waiting: int, frames: list[Frame]) -> None:
        stats, batch = self.stats, self._batch
        now_ns = time.monotonic_ns()
        offset_ns = now_ns - time.time_ns()
        for i in range(waiting):
            _, _, kind, seconds, nanoseconds, _, _, _, dropped = _CONTROL.unpack_from(batch.control, i * _CONTROL.size)
            stamp_ns = now_ns
            if kind == _SO_TIMESTAMPNS:
                # A clock set back between arrival and drain must not make a frame look fresher.
                stamp_ns = min(seconds * 1_000_000_000 + nanoseconds + offset_ns, now_ns)
            if batch.control_length(i) >= _CONTROL_DROPPED:
                self._count_dropped(dropped)
            if batch.length(i) != CAN_FRAME.size:
                continue  # a CAN FD frame: not ours
            key, length, data = CAN_FRAME.unpack_from(batch.data, i * CAN_FRAME.size)
            if key & ERROR:
                stats.note_error(key, data)
                continue
            if stats.state is BusState.DOWN:
                stats.state = BusState.ACTIVE
            frames.append(Frame(stamp_ns, key, data[:length]))

    def send(self, key: int, data: bytes) -> bool:
        stats = self.stats
        # While bus-off the kernel would take the frame and lose it in silence.
        if stats.state is not BusState.OFF:
            try:
                self._sock.send(CAN_FRAME.pack(key, len(data), data))
            except OSError as error:
                if error.errno in _LINK_LOST:
                    stats.state = BusState.DOWN
            else:
                if stats.state is BusState.DOWN:
                    stats.state = BusState.ACTIVE
                stats.sent += 1
                return True
        stats.refused += 1
        return False

    def close(self) -> None:
        self._sock.close()
        self.stats.state = BusState.DOWN

    def _count_dropped(self, kernel_count: int) -> None:
        """The kernel's counter is 32 bits wide and wraps."""
        self.stats.dropped += (kernel_count - self._dropped) & 0xFFFF_FFFF
        self._dropped = kernel_count


def _kernel_filter(key: int) -> bytes:
    mask = EXTENDED | REMOTE | (EXTENDED_MASK if key & EXTENDED else STANDARD_MASK)
    return struct.pack("=II", key, mask)
