"""Memory that stays with a process that looks: pictures come and go many times in a look, and to be given fresh pages
for each costs a tenth of its time.

The controller's processes have their own (``controller.realtime``), for another reason: the floors' neighbours do not
know each other.
"""

from __future__ import annotations

import contextlib
import ctypes
from typing import Final

_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_MAX: Final = -4
"""As in glibc's malloc.h."""


def keep_memory() -> None:
    """Keep glibc from giving memory back to the system and asking for it anew; does nothing with another library."""
    libc = ctypes.CDLL(None)
    with contextlib.suppress(AttributeError):  # musl has no mallopt
        libc.mallopt(_M_TRIM_THRESHOLD, -1)
        libc.mallopt(_M_MMAP_MAX, 0)
