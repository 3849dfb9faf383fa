"""A CAN bus of the Linux kernel over a raw socket: the fast path (`can_dbc.bus.frame_socket`), standard library only.

When the link goes down or is deleted, the state becomes DOWN.  `SocketCanBus.reopen` looks for an interface of the same
name, with any index, that is up and has a carrier, and binds a new socket to it.  Own frames in the queue of an
interface cannot be cancelled; the kernel empties the queue when the link goes down or bus-off.  While bus-off nothing
is sent, because the kernel would accept and silently drop it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import socket
import struct
from collections.abc import Sequence
from typing import Final

from can_dbc.bus.base import DRAIN_LIMIT, BaseBus, BusState, Filter
from can_dbc.bus.frame_socket import FrameSocket
from can_dbc.frame import Frame
from runtime.errors import LinkError

# Options that Python does not name everywhere: linux/can/raw.h, linux/sockios.h, linux/if.h.
_CAN_RAW_ERR_FILTER: Final = 2
_ERR_MASK: Final = 0x1FFF_FFFF
_MAX_FILTERS: Final = 512
_SIOCGIFFLAGS: Final = 0x8913
_FLAGS: Final = struct.Struct("@16sH14x")  # struct ifreq; cut after the flags
_IFF_UP: Final = 0x1
_IFF_RUNNING: Final = 0x40
_LINK_LOST: Final = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF)


class SocketCanBus(BaseBus):
    """One raw socket on one interface (contract: `can_dbc.bus.base.Bus`)."""

    def __init__(self, interface: str, wanted: Filter | None = None, receive_own: bool = False) -> None:
        super().__init__(interface)
        if wanted is not None and len(wanted.pairs) > _MAX_FILTERS:
            raise LinkError(
                "bus.too-many-filters",
                f"{len(wanted.pairs)} filters are more than the {_MAX_FILTERS} that the kernel accepts for "
                f"{interface}; give pairs of key and mask.",
            )
        self._wanted, self._receive_own = wanted, receive_own
        try:
            self._link = self._open(_IFF_UP)
        except OSError as error:
            if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
                raise LinkError(
                    "bus.no-can",
                    f"This kernel has no raw CAN sockets ({error.strerror}), so socketcan:{interface} cannot be "
                    "opened; load the modules can and can_raw, or use the wire: wire:crane0.",
                ) from error
            raise LinkError(
                "bus.interface",
                f"CAN interface {interface} cannot be opened ({error.strerror}); see `ip link`, and bring it "
                f"up with `ip link set {interface} up`.",
            ) from error

    def fileno(self) -> int:
        return self._link.sock.fileno()

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        stats, sent = self.stats, 0
        if stats.state < BusState.OFF:
            try:
                sent = self._link.send(frames)
            except OSError as error:  # ENOBUFS and EAGAIN: no room
                if error.errno in _LINK_LOST:
                    stats.enter(BusState.DOWN)
        stats.sent += sent
        stats.refused += len(frames) - sent
        return sent

    def _receive(self, frames: list[Frame]) -> None:
        link, stats = self._link, self.stats
        before = link.dropped
        try:
            link.receive(frames, DRAIN_LIMIT, stats.note_error)
        except OSError:
            stats.enter(BusState.DOWN)
        stats.dropped += link.dropped - before

    def _reopen_link(self) -> bool:
        try:
            link = self._open(_IFF_UP | _IFF_RUNNING)
        except OSError:
            return False
        self._link.close()
        self._link = link
        return True

    def _release(self) -> None:
        self._link.close()

    def _open(self, needed: int) -> FrameSocket:
        """Bind a socket to the interface; OSError if the interface is missing or lacks one of the flags ``needed``.

        An interface that is bus-off is up but not running.  The kernel needs up to a second to mark a new interface as
        running, so only a link that was lost has to be running.
        """
        raw = socket.SOL_CAN_RAW
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        with contextlib.ExitStack() as on_error:
            on_error.callback(sock.close)
            flags = fcntl.ioctl(sock, _SIOCGIFFLAGS, _FLAGS.pack(self.name.encode(), 0))
            if _FLAGS.unpack(flags)[1] & needed != needed:
                raise OSError(errno.ENETDOWN, "it is down")
            link = FrameSocket(sock)
            sock.setsockopt(raw, _CAN_RAW_ERR_FILTER, _ERR_MASK)
            sock.setsockopt(raw, socket.CAN_RAW_RECV_OWN_MSGS, int(self._receive_own))
            if self._wanted is not None:
                pairs = b"".join(struct.pack("=II", *pair) for pair in self._wanted.pairs)
                sock.setsockopt(raw, socket.CAN_RAW_FILTER, pairs)
            sock.bind((self.name,))
            on_error.pop_all()
        return link
