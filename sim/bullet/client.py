"""The only importer of pybullet: opens clients without the banners that its C code prints on the terminal."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what C code writes to descriptors 1 and 2; its buffer is flushed inside."""
    flush = ctypes.CDLL(None).fflush
    sys.stdout.flush()
    sys.stderr.flush()
    flush(None)
    saved, null = (os.dup(1), os.dup(2)), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        yield
    finally:
        flush(None)
        for descriptor, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(null)


with _silent():
    import pybullet
    from pybullet_utils import bullet_client

__all__ = ["GRAVITY_M_S2", "BulletClient", "new_client"]


class BulletClient(bullet_client.BulletClient):  # type: ignore[misc]
    """A client that caches the functions bound to it: binding one anew takes as long as a short call."""

    def __getattr__(self, name: str) -> Any:
        attribute = super().__getattr__(name)
        if name == "disconnect":  # cached functions must not reach a later client with the same number
            self.__dict__ = {k: v for k, v in self.__dict__.items() if not isinstance(v, partial)}
        else:
            self.__dict__[name] = attribute
        return attribute


GRAVITY_M_S2: Final = 9.81


def new_client() -> BulletClient:
    """Make a new physics client without a window."""
    with _silent():
        return BulletClient(pybullet.DIRECT)
