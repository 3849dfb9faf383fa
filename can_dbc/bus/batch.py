"""Many datagrams in one system call: recvmmsg(2) and sendmmsg(2) on preallocated buffers.

A drain of a busy socket costs one call instead of one per frame, and so does sending the frames of a tick.  This
matters at 200 Hz, and more so in user-mode Linux, where a call costs a hundred times as much.  Standard library only;
Linux with glibc or musl.
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
_recvmmsg, _sendmmsg = _libc.recvmmsg, _libc.sendmmsg
_IOVEC: Final = struct.Struct("@PN")
_HEADER: Final = struct.Struct("@PI4xPNPNi4xI4x")  # struct mmsghdr: name, its length, iovec, control, flags, length
_HEADER_WORDS: Final = _HEADER.size // 4
_LENGTH_WORD: Final = 14
"""Place of the datagram's length in the header as 32-bit words."""
_NAME: Final = struct.Struct("!2xH4s8x")  # struct sockaddr_in


class _Buffers:
    """``count`` message headers that point at ``size`` bytes of data and ``ancillary`` bytes of control data each, and
    at an IPv4 address if ``named``."""

    __slots__ = ("_address", "_headers", "_keep", "_names", "_words", "ancillary", "control", "count", "data", "size")

    def __init__(self, size: int, ancillary: int, count: int, named: bool = False) -> None:
        self.size, self.ancillary, self.count = size, ancillary, count
        self.data = memoryview(bytearray(size * count))
        self.control = memoryview(bytearray(max(ancillary * count, 1)))
        self._names = bytearray(_NAME.size * count)
        iovecs, self._headers = bytearray(_IOVEC.size * count), memoryview(bytearray(_HEADER.size * count))
        self._words = self._headers.cast("I")
        buffers = (self.data, self.control, self._names, iovecs, self._headers)
        views = [ctypes.c_char.from_buffer(buffer) for buffer in buffers]
        self._keep = views, iovecs
        data_at, control_at, names_at, iovecs_at, headers_at = (ctypes.addressof(view) for view in views)
        name_bytes = _NAME.size if named else 0
        self._address = ctypes.c_void_p(headers_at)
        for i in range(count):
            _IOVEC.pack_into(iovecs, i * _IOVEC.size, data_at + i * size, size)
            where = control_at + i * ancillary if ancillary else 0
            name_at = names_at + i * name_bytes if named else 0
            iovec_at = iovecs_at + i * _IOVEC.size
            _HEADER.pack_into(self._headers, i * _HEADER.size, name_at, name_bytes, iovec_at, 1, where, ancillary, 0, 0)


class Batch(_Buffers):
    """Room for ``count`` datagrams of at most ``size`` bytes with ``ancillary`` bytes of control data each.

    After `receive` datagram i is at ``data[i * size]``, its control messages at ``control[i * ancillary]``; missing
    control data reads as zeros.  ``named``: the socket is one of IPv4, and `sender` tells who sent.
    """

    __slots__ = ("_fresh", "_used", "_zeros")

    def __init__(self, size: int, ancillary: int = 0, count: int = 64, named: bool = False) -> None:
        super().__init__(size, ancillary, count, named)
        self._fresh, self._zeros = bytes(self._headers), bytes(ancillary * count)
        self._used = 0

    def receive(self, descriptor: int) -> int:
        """Receive at most ``count`` waiting datagrams without blocking; 0 if none waits.  Raises OSError otherwise."""
        used = self._used
        if used and self.ancillary:  # the kernel overwrites the offered sizes of control data with the received ones
            self._headers[: used * _HEADER.size] = self._fresh[: used * _HEADER.size]
            self.control[: used * self.ancillary] = self._zeros[: used * self.ancillary]
        self._used = 0
        received: int = _recvmmsg(descriptor, self._address, self.count, socket.MSG_DONTWAIT, None)
        if received >= 0:
            self._used = received
            return received
        code = ctypes.get_errno()
        if code in (errno.EAGAIN, errno.EINTR):
            return 0
        raise OSError(code, os.strerror(code))

    def length(self, i: int) -> int:
        """Return the size in bytes of datagram i of the last `receive`."""
        length_bytes: int = self._words[i * _HEADER_WORDS + _LENGTH_WORD]
        return length_bytes

    def sender(self, i: int) -> tuple[str, int]:
        """Return the address and port that datagram i of the last `receive` came from."""
        port, host = _NAME.unpack_from(self._names, i * _NAME.size)
        return socket.inet_ntoa(host), port

    def lengths(self) -> list[int]:
        """Return the size in bytes of each datagram of the last `receive`."""
        return [self.length(i) for i in range(self._used)]


class Outbox(_Buffers):
    """Room for ``count`` datagrams of exactly ``size`` bytes; datagram i is written to ``data[i * size]``."""

    __slots__ = ()

    def __init__(self, size: int, count: int = 64) -> None:
        super().__init__(size, 0, count)

    def send(self, descriptor: int, count: int) -> int:
        """Send the first ``count`` datagrams without blocking; returns how many of them the kernel accepted.

        Raises OSError with the reason if it accepted none.
        """
        sent: int = _sendmmsg(descriptor, self._address, count, socket.MSG_DONTWAIT)
        if sent >= 0:
            return sent
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def enlarge_receive_buffer(sock: socket.socket, size: int) -> None:
    """Give a socket a receive buffer of ``size`` bytes; only root can exceed the system's limit."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
