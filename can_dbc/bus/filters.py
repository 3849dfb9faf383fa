"""Which frames a participant receives: exact keys, and pairs of key and mask for messages matched by PGN.

A pair ``(key, mask)`` matches a frame whose key equals ``key`` in the bits of ``mask``.  The kind bits (extended,
remote) always count, so no mask lets a remote frame or an 11-bit identifier pass for another.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from can_dbc.frame import EXTENDED, EXTENDED_MASK, REMOTE

Wanted = int | tuple[int, int]
_KIND: Final = EXTENDED | REMOTE


class Filter:
    """``key in filter`` is True for a wanted frame; ``pairs`` says the same as (key, mask), kind bits included."""

    __slots__ = ("_keys", "_masked", "pairs")

    def __init__(self, wanted: Iterable[int | Sequence[int]]) -> None:
        """Raises TypeError or ValueError for what is neither a key nor a pair."""
        pairs: set[tuple[int, int]] = set()
        for item in wanted:
            key, mask = (item, EXTENDED_MASK) if isinstance(item, int) else item
            mask = (mask & EXTENDED_MASK) | _KIND
            pairs.add((key & mask, mask))
        self.pairs = tuple(sorted(pairs))
        self._keys = frozenset(key for key, mask in self.pairs if mask == EXTENDED_MASK | _KIND)
        self._masked = tuple((key, mask) for key, mask in self.pairs if mask != EXTENDED_MASK | _KIND)

    def __contains__(self, key: object) -> bool:
        return key in self._keys or (
            isinstance(key, int) and any(key & mask == wanted for wanted, mask in self._masked)
        )


def filter_of(wanted: Iterable[Wanted] | None) -> Filter | None:
    """The filter for what a participant asks for; None, which lets everything pass, for None."""
    return None if wanted is None else Filter(wanted)
