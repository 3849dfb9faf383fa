"""Counts what a running thread executes: perf_event_open(2), where the host lets us.

Most virtual machines offer no hardware counter; then `open_counter` returns None, and the caller says so.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from typing import Final

_SYSCALL: Final = {"x86_64": 298, "aarch64": 241}
_ATTR_BYTES: Final = 112  # PERF_ATTR_SIZE_VER5
_HARDWARE, _SOFTWARE = 0, 1
INSTRUCTIONS: Final = (_HARDWARE, 1)
TASK_CLOCK: Final = (_SOFTWARE, 1)
"""Processor time [ns] from the kernel; offered everywhere."""


def open_counter(thread: int, kind: tuple[int, int]) -> int | None:
    """Open a descriptor that counts ``kind`` in a thread (its id) from now on; None if the host does not offer it."""
    number = _SYSCALL.get(platform.machine())
    if number is None:
        return None
    attributes = struct.pack("<IIQ", kind[0], _ATTR_BYTES, kind[1]).ljust(_ATTR_BYTES, b"\0")
    libc = ctypes.CDLL(None, use_errno=True)
    descriptor: int = libc.syscall(ctypes.c_long(number), attributes, ctypes.c_int(thread), -1, -1, ctypes.c_ulong(8))
    return descriptor if descriptor >= 0 else None


def count(descriptor: int) -> int:
    """Return the count so far."""
    (value,) = struct.unpack("<Q", os.read(descriptor, 8))
    return int(value)
