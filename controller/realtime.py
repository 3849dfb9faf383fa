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
    """Tells systemd that the process is ready and alive (sd_notify); does nothing elsewhere."""

    __slots__ = ("_address", "_next_ns", "_socket")
    PERIOD_NS: Final = 100_000_000

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        self._next_ns = 0
        if self._socket is not None:
            self._socket.setblocking(False)
        self._tell(b"READY=1")

    def alive(self, now_ns: int) -> None:
        """Called at the end of a good tick; ten times a second it is passed on."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + self.PERIOD_NS
            self._tell(b"WATCHDOG=1")

    def _tell(self, what: bytes) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(what, self._address)
