"""How a long-lived process uses memory: glibc's allocator, and huge pages."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

# -- How glibc's allocator behaves in a long-lived process.
#
# A process that is given fresh pages for every large block pays for it with page faults: a real-time loop in some
# tick, perception with a tenth of the time of every detection.

# As in glibc's malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_MAX: Final = -4


def keep_memory() -> None:
    """Keep glibc from returning memory to the system and requesting it again; no effect with another C library."""
    libc = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):  # musl has no mallopt
        libc.mallopt(_M_TRIM_THRESHOLD, -1)
        libc.mallopt(_M_MMAP_MAX, 0)


# -- Puts the memory of a finished process on huge pages.
#
# A tick that wakes after 5 ms of other work finds neither its data nor their addresses in the processor: each page
# of 4 KiB that it touches costs a walk through the page tables, on a virtual machine through two of them.  On pages
# of 2 MiB a few walks serve the whole heap.

_MADV_COLLAPSE: Final = 25
"""linux/mman.h, from Linux 6.1; Python's mmap module does not name it."""
_HUGE_PAGE_BYTES: Final = Path("/sys/kernel/mm/transparent_hugepage/hpage_pmd_size")
_MAPS: Final = Path("/proc/self/maps")


def collapse_heap() -> int:
    """Copy the heap onto huge pages once; returns how many bytes lie on them, 0 where the kernel has none.

    Call it when everything is allocated: it takes tens of milliseconds, and what is allocated later may lie on small
    pages.  Contents and addresses stay.  Source: madvise(2), MADV_COLLAPSE.
    """
    try:
        size = int(_HUGE_PAGE_BYTES.read_text())
        page_addresses = list(huge_places(_MAPS.read_text().splitlines(), size))
    except (OSError, ValueError):
        return 0
    libc = ctypes.CDLL(None)
    libc.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    # One call for each page: where the kernel finds none free, the others are still worth it.
    return sum(size for page_address in page_addresses if libc.madvise(page_address, size, _MADV_COLLAPSE) == 0)


def huge_places(maps: Iterable[str], size: int) -> Iterator[int]:
    """Yield the addresses of the huge pages of ``size`` bytes that fit into the process's own writable memory.

    ``maps``: lines of /proc/PID/maps (proc_pid_maps(5)).  Left out are files, stacks and what cannot be written.
    """
    for line in maps:
        addresses, flags, _, _, inode, *name = line.split(maxsplit=5)
        if flags[1:] != "w-p" or inode != "0" or (name and name[0] != "[heap]"):
            continue
        first, last = (int(part, 16) for part in addresses.split("-"))
        yield from range(-(-first // size) * size, last // size * size - size + 1, size)
