"""Real-time set-up of a Linux process: absolute sleep, FIFO scheduling, locked memory, no garbage collection.

Call `runtime.memory.keep_memory` before anything is built, `prepare` when everything is, and
`stop_garbage_collection` last.  `prepare` returns what the system refused as text; the caller prints it and continues,
because a demonstration on a desktop must run too.  The process must not have a second thread
(docs/reference/real-time.md section 2).
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
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
    """Return `sleep_until`, or the same with a spin on the clock for the last ``spin_ns``.

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
        tuples = [tuple(range(length)) for _ in range(2000)]
        del tuples
