"""What a Linux process needs to wake on time: absolute sleep, FIFO, locked memory, no garbage collection.

`prepare` returns in words what the system refused; the caller shows it and goes on, because a demonstration
on a desktop must run too.  No second thread may live in the process (realtime.md section 2).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import socket
from collections.abc import Callable
from typing import Final

_libc: Final = ctypes.CDLL(None, use_errno=True)
_CLOCK_MONOTONIC: Final = 1
_TIMER_ABSTIME: Final = 1
_MCL_CURRENT_AND_FUTURE: Final = 3


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


_deadline: Final = _Timespec()
_deadline_pointer: Final = ctypes.byref(_deadline)
_nanosleep: Final = _libc.clock_nanosleep
_nanosleep.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]


def sleep_until(deadline_ns: int) -> None:
    """Sleeps to an absolute CLOCK_MONOTONIC time; a signal only interrupts, it does not shorten."""
    _deadline.seconds, _deadline.nanoseconds = divmod(deadline_ns, 1_000_000_000)
    while _nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, _deadline_pointer, None) == errno.EINTR:
        pass


def prepare(priority: int, cpu: int | None = None) -> list[str]:
    """FIFO at ``priority``, locked memory, one processor if given, no garbage passes; returns refusals."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        refused.append(f"SCHED_FIFO {priority}: {error.strerror}")
    if _libc.mlockall(_MCL_CURRENT_AND_FUTURE):
        refused.append(f"mlockall: {os.strerror(ctypes.get_errno())}")
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except (OSError, ValueError) as error:  # ValueError: a negative number
            refused.append(f"processor {cpu}: {error}")
    freeze()
    return refused


def freeze() -> None:
    """Collects garbage once, keeps what is left out of every later pass, and switches the passes off."""
    gc.collect()
    gc.freeze()
    gc.disable()


class Notifier:
    """Tells systemd how the process is (sd_notify(3)); does nothing where nobody asked for it.

    Nothing is said before the first good tick: that is ``READY=1``.  From then on a good tick passes ``WATCHDOG=1``
    on, ten times a second, and once a second what ``words`` answers (one line) as ``STATUS=``.  A tick that is not
    good says nothing, so a process whose ticks are all bad is ended by the watchdog.  Never blocks, never raises; only
    the tick that tells the status builds a text.
    """

    __slots__ = ("_address", "_alive_ns", "_ready", "_socket", "_status_ns", "_words")
    ALIVE_NS: Final = 100_000_000
    STATUS_NS: Final = 1_000_000_000

    def __init__(self, words: Callable[[], str]) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self._words = words
        self._ready = False
        self._alive_ns = self._status_ns = 0

    def ticked(self, now_ns: int, good: bool) -> None:
        """Called at the end of every tick."""
        if self._socket is None or not good or now_ns < self._alive_ns:
            return
        self._alive_ns = now_ns + self.ALIVE_NS
        if now_ns < self._status_ns:
            self._tell(b"WATCHDOG=1")
            return
        self._status_ns = now_ns + self.STATUS_NS
        begin = "WATCHDOG=1" if self._ready else "READY=1\nWATCHDOG=1"
        self._ready = self._tell(f"{begin}\nSTATUS={self._words()}".encode()) or self._ready
        if not self._ready:
            self._alive_ns = self._status_ns = 0

    def stopping(self) -> None:
        """Called on the way out, after the last frames."""
        self._tell(b"STOPPING=1\nSTATUS=Ending.")

    def _tell(self, what: bytes) -> bool:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                return self._socket.sendto(what, self._address) == len(what)
        return False
