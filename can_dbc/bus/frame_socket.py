"""Frames in and out of any datagram socket that carries struct can_frame, many in one system call.

`can_dbc.bus.socketcan` uses it on raw CAN sockets, `timberhand bench bus` on an AF_UNIX pair if the kernel has no CAN:
the same buffers, the same control data, the same loop.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from can_dbc.bus.batch import Batch, Outbox, enlarge_receive_buffer
from can_dbc.bus.receive_clock import HardwareClock, ReceiveClock
from can_dbc.frame import ERROR, Frame

CAN_FRAME: Final = struct.Struct("=IB3x8s")
"""struct can_frame of linux/can.h: key, length, data."""
RECEIVE_BUFFER_BYTES: Final = 4 << 20

# Control data of one frame, each a struct cmsghdr of 16 bytes and its content: the timespec of SO_TIMESTAMPNS; three
# timespecs of SO_TIMESTAMPING if the adapter stamps, the last one by the adapter; the counter of SO_RXQ_OVFL once
# frames have been lost.
_CONTROL_BYTES: Final = 32 + 64 + 24
_SOFTWARE: Final = struct.Struct("@16xqq88x")
_HARDWARE: Final = struct.Struct("@16xqq12xi32xqq24x")
"""Software stamp, kind of the second message, hardware stamp."""
_KIND: Final = struct.Struct("@12xi")
_COUNT: Final = struct.Struct("@16xI")
# Options that Python does not name everywhere: asm-generic/socket.h, linux/net_tstamp.h.
_SO_TIMESTAMPNS: Final = 35
_SO_TIMESTAMPING: Final = 37
_SO_RXQ_OVFL: Final = 40
_HARDWARE_STAMPS: Final = 1 << 2 | 1 << 6  # generate them, and report them unconverted
_SECOND_NS: Final = 1_000_000_000


class FrameSocket:
    """The fast path of one non-blocking socket, which it owns.

    Stamps are the kernel's (taken in the receive interrupt), converted from CLOCK_REALTIME to CLOCK_MONOTONIC so that
    setting the former does no harm (`can_dbc.bus.receive_clock`); they are never in the future.  Stamps of an adapter
    are preferred (`can_dbc.bus.receive_clock`).  `dropped` counts the frames for which the socket's receive buffer had
    no room.
    """

    __slots__ = ("_adapter_clock", "_batch", "_clock", "_counted", "_outbox", "dropped", "sock")

    def __init__(self, sock: socket.socket, buffer_bytes: int = RECEIVE_BUFFER_BYTES) -> None:
        sock.setblocking(False)
        enlarge_receive_buffer(sock, buffer_bytes)
        for option, value in ((_SO_TIMESTAMPNS, 1), (_SO_TIMESTAMPING, _HARDWARE_STAMPS), (_SO_RXQ_OVFL, 1)):
            sock.setsockopt(socket.SOL_SOCKET, option, value)
        self.sock = sock
        self.dropped = 0
        self._counted = 0
        self._batch = Batch(CAN_FRAME.size, _CONTROL_BYTES)
        self._outbox = Outbox(CAN_FRAME.size)
        self._clock = ReceiveClock(time.monotonic_ns())
        self._adapter_clock = HardwareClock()

    def receive(self, frames: list[Frame], limit: int, note_error: Callable[[int, bytes], bool]) -> None:
        """Append the waiting frames, at most `limit`; one system call unless more than a full batch waits.

        Error frames go to `note_error`; if it reports a recovery of the node, the frames appended before are removed.
        Raises OSError if the link is lost.
        """
        batch, clock, first = self._batch, self._clock, len(frames)
        new, append = tuple.__new__, frames.append  # Frame(...) costs half as much again
        for _ in range(max(1, limit // batch.count)):
            waiting = batch.receive(self.sock.fileno())
            if not waiting:
                return
            clock.begin(time.monotonic_ns(), time.time_ns())
            datagrams = CAN_FRAME.iter_unpack(batch.data[: waiting * CAN_FRAME.size])
            for stamp_ns, (key, length, data) in zip(self._stamps(waiting), datagrams, strict=True):
                if key & ERROR:
                    if note_error(key, data):
                        del frames[first:]
                    continue
                append(new(Frame, (stamp_ns, key, data if length == 8 else data[:length])))
            self._count_dropped(waiting)
            if waiting < batch.count:
                clock.emptied()
                return

    def send(self, frames: Sequence[tuple[int, bytes]]) -> int:
        """Send frames in order without blocking, up to the first that is invalid (more than 8 bytes) or finds no room.

        Returns how many the kernel accepted.  Raises OSError with the reason if it accepted none of a batch.
        """
        outbox, sent = self._outbox, 0
        while sent < len(frames):
            count = 0
            for key, data in frames[sent : sent + outbox.count]:
                if len(data) > 8:
                    break
                CAN_FRAME.pack_into(outbox.data, count * CAN_FRAME.size, key, len(data), data)
                count += 1
            accepted = outbox.send(self.sock.fileno(), count) if count else 0
            sent += accepted
            if accepted < outbox.count:
                break
        return sent

    def close(self) -> None:
        self.sock.close()

    def _stamps(self, waiting: int) -> Iterator[int]:
        """Receive time [ns] of each frame."""
        control, clock = self._batch.control[: waiting * _CONTROL_BYTES], self._clock
        if _KIND.unpack_from(control, 32)[0] == _SO_TIMESTAMPING:
            yield from self._adapter_stamps(control)
            return
        since_ns, now_ns, offset_ns = clock.since_ns, clock.now_ns, clock.offset_ns
        for seconds, nanoseconds in _SOFTWARE.iter_unpack(control):
            wall_ns = seconds * _SECOND_NS + nanoseconds
            stamp_ns = wall_ns + offset_ns
            yield stamp_ns if since_ns <= stamp_ns <= now_ns else clock.doubtful_ns(wall_ns)

    def _adapter_stamps(self, control: memoryview) -> Iterator[int]:
        clock = self._clock
        for seconds, nanoseconds, kind, own_seconds, own_nanoseconds in _HARDWARE.iter_unpack(control):
            wall_ns = seconds * _SECOND_NS + nanoseconds
            stamp_ns = wall_ns + clock.offset_ns
            if not clock.since_ns <= stamp_ns <= clock.now_ns:
                stamp_ns = clock.doubtful_ns(wall_ns)
            if kind == _SO_TIMESTAMPING and own_seconds + own_nanoseconds:
                stamp_ns = self._adapter_clock.stamp_ns(own_seconds * _SECOND_NS + own_nanoseconds, stamp_ns)
            yield stamp_ns

    def _count_dropped(self, waiting: int) -> None:
        """Read from the last frame the count of all frames lost before it; it is 32 bits wide and wraps."""
        at = (waiting - 1) * _CONTROL_BYTES + 32
        control = self._batch.control
        if _KIND.unpack_from(control, at)[0] == _SO_TIMESTAMPING:
            at += 64
        if _KIND.unpack_from(control, at)[0] == _SO_RXQ_OVFL:
            (counted,) = _COUNT.unpack_from(control, at)
            self.dropped += (counted - self._counted) & 0xFFFF_FFFF
            self._counted = counted
