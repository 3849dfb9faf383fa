"""Many waiting datagrams in one system call: recvmmsg(2) into buffers that are made once.

A drain of a busy socket costs one call instead of one per frame, which counts in a 200 Hz tick and even more inside
user-mode Linux, where a call costs a hundred times as much.  Standard library alone; Linux with glibc or musl.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
from typing import Final

_SO_RCVBUFFORCE: Final = 33
_libc: Final = ctypes.CDLL(None, use_errno=True)
_IOVEC: Final = struct.Struct("@PN")
_HEADER: Final = struct.Struct("@PI4xPNPNi4xI4x")  # struct mmsghdr: name, its length, iovec, control, flags, length
_CONTROL_AT: Final = struct.calcsize("@PI4xPNP")
_LENGTH_AT: Final = struct.calcsize("@PI4xPNPNi4x")
_SIZE_T: Final = struct.Struct("@N")
_UNSIGNED: Final = struct.Struct("@I")


class Batch:
    """Buffers for ``count`` datagrams of at most ``size`` bytes with ``ancillary`` bytes of control data each.

    After `receive` datagram i lies at ``data[i * size]``, its control messages at ``control[i * ancillary]``.
    """

    __slots__ = ("_at", "_fresh", "_headers", "_keep", "ancillary", "control", "count", "data", "size")

    def __init__(self, size: int, ancillary: int = 0, count: int = 64) -> None:
        self.size, self.ancillary, self.count = size, ancillary, count
        self.data = bytearray(size * count)
        self.control = bytearray(max(ancillary * count, 1))
        iovecs, self._headers = bytearray(_IOVEC.size * count), bytearray(_HEADER.size * count)
        buffers = (self.data, self.control, iovecs, self._headers)
        self._keep = [ctypes.c_char.from_buffer(buffer) for buffer in buffers], iovecs
        data_at, control_at, iovecs_at, self._at = (ctypes.addressof(view) for view in self._keep[0])
        for i in range(count):
            _IOVEC.pack_into(iovecs, i * _IOVEC.size, data_at + i * size, size)
            where = control_at + i * ancillary if ancillary else 0
            _HEADER.pack_into(
                self._headers, i * _HEADER.size, 0, 0, iovecs_at + i * _IOVEC.size, 1, where, ancillary, 0, 0
            )
        self._fresh = bytes(self._headers)

    def receive(self, descriptor: int) -> int:
        """Takes what waits, at most ``count``, without blocking; 0 when nothing does.  Raises OSError otherwise."""
        self._headers[:] = self._fresh  # the kernel writes the sizes it found over the sizes it is offered
        taken = _libc.recvmmsg(descriptor, ctypes.c_void_p(self._at), self.count, socket.MSG_DONTWAIT, None)
        if taken >= 0:
            return int(taken)
        code = ctypes.get_errno()
        if code in (errno.EAGAIN, errno.EINTR):
            return 0
        raise OSError(code, os.strerror(code))

    def length(self, i: int) -> int:
        """Bytes of datagram i."""
        return int(_UNSIGNED.unpack_from(self._headers, i * _HEADER.size + _LENGTH_AT)[0])

    def control_length(self, i: int) -> int:
        """Bytes of control data of datagram i."""
        return int(_SIZE_T.unpack_from(self._headers, i * _HEADER.size + _CONTROL_AT)[0])


def widen(sock: socket.socket, size: int) -> None:
    """Give a socket a receive buffer of ``size`` bytes; beyond the system's limit only root can."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
