"""How glibc's allocator behaves in a long-lived process.

A process that is given fresh pages for every large block pays for it with page faults: a real-time loop in some tick,
perception with a tenth of the time of every detection.
"""

from __future__ import annotations

import contextlib
import ctypes
from typing import Final

# As in glibc's malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_MAX: Final = -4


def keep_memory() -> None:
    """Keeps glibc from returning memory to the system and requesting it again; no effect with another C library."""
    libc = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):  # musl has no mallopt
        libc.mallopt(_M_TRIM_THRESHOLD, -1)
        libc.mallopt(_M_MMAP_MAX, 0)
