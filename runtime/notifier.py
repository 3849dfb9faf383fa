"""What a process tells systemd: that it is ready, alive, how it is, and that it ends."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable
from typing import Final


class Notifier:
    """Notifies systemd of the process's state (sd_notify(3)); does nothing without a socket to notify.

    The first good tick sends ``READY=1``.  From then on good ticks send ``WATCHDOG=1`` ten times a second and the
    result of ``status_text`` (one line) once a second as ``STATUS=``.  A bad tick sends nothing, so the watchdog ends a
    process whose ticks are all bad.  Never blocks, never raises; only the tick that sends the status builds a text.
    """

    __slots__ = ("_address", "_alive_ns", "_ready", "_socket", "_status_ns", "_status_text")
    ALIVE_NS: Final = 100_000_000
    STATUS_NS: Final = 1_000_000_000

    def __init__(self, status_text: Callable[[], str], address: str | None = None) -> None:
        """Notify at ``address``, by default NOTIFY_SOCKET; an empty address disables it."""
        if address is None:
            address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self._status_text = status_text
        self._ready = False
        self._alive_ns = self._status_ns = 0

    def tick_done(self, now_ns: int, good: bool) -> None:
        """Send the signs of life that are due; called at the end of every tick."""
        if self._socket is None or not good or now_ns < self._alive_ns:
            return
        self._alive_ns = now_ns + self.ALIVE_NS
        if now_ns < self._status_ns:
            self._send(b"WATCHDOG=1")
            return
        self._status_ns = now_ns + self.STATUS_NS
        begin = "WATCHDOG=1" if self._ready else "READY=1\nWATCHDOG=1"
        self._ready = self._send(f"{begin}\nSTATUS={self._status_text()}".encode()) or self._ready
        if not self._ready:
            self._alive_ns = self._status_ns = 0

    def stopping(self) -> None:
        """Announce the end on the way out, after the last frames."""
        self._send(b"STOPPING=1\nSTATUS=Ending.")

    def _send(self, what: bytes) -> bool:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                return self._socket.sendto(what, self._address) == len(what)
        return False
