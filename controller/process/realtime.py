"""Real-time set-up of a Linux process: absolute sleep, FIFO scheduling, locked memory, no garbage collection.

Call `runtime.allocator.keep_memory` before anything is built, `prepare` when everything is, and
`stop_garbage_collection` last.  `prepare` returns what the system refused as text; the caller prints it and continues,
because a demonstration on a desktop must run too.  The process must not have a second thread
(docs/reference/real-time.md section 2).
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
DMA_LATENCY: Final = "/dev/cpu_dma_latency"


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


_deadline: Final = _Timespec()
_deadline_pointer: Final = ctypes.byref(_deadline)
_nanosleep: Final = _libc.clock_nanosleep
_nanosleep.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]


def sleep_until(deadline_ns: int) -> None:
    """Sleep until an absolute CLOCK_MONOTONIC time; a signal interrupts the sleep but does not shorten it."""
    _deadline.seconds, _deadline.nanoseconds = divmod(deadline_ns, 1_000_000_000)
    while _nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, _deadline_pointer, None) == errno.EINTR:
        pass


def make_sleep(spin_ns: int) -> Callable[[int], None]:
    """`sleep_until`, or the same with a spin on the clock for the last ``spin_ns``.

    Spinning wakes a few microseconds late instead of tens and costs ``spin_ns`` per wake-up on a processor that should
    be its own (docs/reference/real-time.md section 2).
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
    """Set FIFO scheduling at ``priority`` and lock memory; returns what the system refused as text.

    ``cpu``: run on this processor only; ``dma_latency``: keep all processors out of deep sleep states.
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


def stop_garbage_collection() -> None:
    """Collect garbage once, exclude what is left from every later collection, and switch collections off."""
    gc.collect()
    _fill_tuple_lists()
    gc.freeze()
    gc.disable()


def _fill_tuple_lists() -> None:
    """Fill CPython's free lists of tuples: 2000 of each length up to 20 (3.11, tupleobject.c).

    Some freed tuples are kept and never used again: those of length 20 and those built from a generator.  Without this
    the heap would grow by them for half an hour, with page faults.  A garbage collection would empty the lists.
    """
    for length in range(1, 21):
        kept = [tuple(range(length)) for _ in range(2000)]
        del kept


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
        """Called at the end of every tick."""
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
        """Called on the way out, after the last frames."""
        self._send(b"STOPPING=1\nSTATUS=Ending.")

    def _send(self, what: bytes) -> bool:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                return self._socket.sendto(what, self._address) == len(what)
        return False
