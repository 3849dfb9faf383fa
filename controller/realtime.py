"""What a Linux process needs to wake on time: absolute sleep, FIFO, locked memory, no garbage collection.

`keep_heap` before anything is built, `prepare` when everything is, `freeze` last.  `prepare` returns in words what the
system refused; the caller shows it and goes on, because a demonstration on a desktop must run too.  No second thread
may live in the process (realtime.md section 2).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import socket
import time
from collections.abc import Callable
from typing import Final

_libc: Final = ctypes.CDLL(None, use_errno=True)
_CLOCK_MONOTONIC: Final = 1
_TIMER_ABSTIME: Final = 1
_MCL_CURRENT_AND_FUTURE: Final = 3
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h
DMA_LATENCY: Final = "/dev/cpu_dma_latency"


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


def sleeper(spin_ns: int) -> Callable[[int], None]:
    """`sleep_until`, or the same with the last ``spin_ns`` spent looking at the clock: it wakes a few microseconds
    late instead of tens, for ``spin_ns`` per wake-up of a processor that should be its own (realtime.md section 2).
    """
    if spin_ns <= 0:
        return sleep_until
    clock_ns = time.monotonic_ns

    def sleep_and_spin(deadline_ns: int) -> None:
        sleep_until(deadline_ns - spin_ns)
        while clock_ns() < deadline_ns:
            pass

    return sleep_and_spin


def prepare(priority: int, cpu: int | None = None, dma_latency: bool = False) -> list[str]:
    """FIFO at ``priority``, locked memory, one processor if given, processors kept awake if asked for
    (``dma_latency``); returns what was refused, in words.
    """
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
    if dma_latency:
        try:
            # The request holds for as long as the file is open: until the process ends (kernel, pm_qos_interface.rst).
            os.write(os.open(DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC), bytes(4))
        except OSError as error:
            refused.append(f"{DMA_LATENCY}: {error.strerror}")
    return refused


def keep_heap() -> None:
    """Keeps glibc from giving memory back and asking for it anew, which would be a page fault in some tick."""
    with contextlib.suppress(AttributeError):  # musl has no mallopt
        _libc.mallopt(_M_TRIM_THRESHOLD, -1)
        _libc.mallopt(_M_MMAP_MAX, 0)


def freeze() -> None:
    """Collects garbage once, keeps what is left out of every later pass, and switches the passes off."""
    gc.collect()
    _fill_tuple_lists()
    gc.freeze()
    gc.disable()


def _fill_tuple_lists() -> None:
    """Lets CPython keep as many freed tuples as it ever will: 2000 of each length up to 20 (3.11, tupleobject.c).

    Some it keeps and never uses again, those of length 20 and those built from a generator; without this the heap
    would grow by them for half an hour, and fault.  A garbage collection would empty the lists.
    """
    for length in range(1, 21):
        kept = [tuple(range(length)) for _ in range(2000)]
        del kept


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

    def __init__(self, words: Callable[[], str], address: str | None = None) -> None:
        """Tells it at ``address``, by default where systemd asks for it; nowhere if that is empty."""
        if address is None:
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
