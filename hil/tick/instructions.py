"""Counts the instructions of this thread by perf_event_open(2), where processor and kernel let us.

A count hardly depends on the clock, the caches and other load, so it shows a regression that a noisy host hides.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from typing import Final

_SYSCALL: Final = {"x86_64": 298, "aarch64": 241}
_HARDWARE, _INSTRUCTIONS = 0, 1
_SIZE: Final = 64
_EXCLUDE_KERNEL: Final = 1 << 5 | 1 << 6
"""exclude_kernel and exclude_hv."""


class Counter:
    """A running counter of events of this thread, in user space; raises OSError where the host has none."""

    def __init__(self, kind: int = _HARDWARE, config: int = _INSTRUCTIONS) -> None:
        number = _SYSCALL.get(platform.machine())
        if number is None:
            raise OSError(f"no perf_event_open known for {platform.machine()}")
        attributes = struct.pack("<IIQQQQQ", kind, _SIZE, config, 0, 0, 0, _EXCLUDE_KERNEL).ljust(_SIZE, b"\0")
        libc = ctypes.CDLL(None, use_errno=True)
        self._file: int = libc.syscall(number, attributes, 0, -1, -1, 0)
        if self._file < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def read(self) -> int:
        """Events since the counter was opened."""
        return int.from_bytes(os.read(self._file, 8), "little")

    def close(self) -> None:
        """Close the counter."""
        os.close(self._file)


def open_counter() -> Counter | None:
    """A counter of instructions; None where the host has none."""
    try:
        return Counter()
    except OSError:
        return None
