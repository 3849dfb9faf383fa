"""The frames that a participant receives: exact keys, and (key, mask) pairs for messages matched by PGN.

A pair ``(key, mask)`` matches a frame whose key equals ``key`` in the bits of ``mask``.  The kind bits (extended,
remote) always count: no mask matches a remote frame or an 11-bit identifier by accident.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from can_dbc.frame import EXTENDED, EXTENDED_MASK, REMOTE

FilterItem = int | tuple[int, int]
_KIND: Final = EXTENDED | REMOTE


class Filter:
    """``key in filter`` is True for a frame to receive; ``pairs`` is the same as (key, mask), with kind bits."""

    __slots__ = ("_keys", "_masked", "pairs")

    def __init__(self, wanted: Iterable[int | Sequence[int]]) -> None:
        """Raises TypeError or ValueError for an item that is neither a key nor a pair."""
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


def filter_of(wanted: Iterable[FilterItem] | None) -> Filter | None:
    """The filter of a participant's items; None, which passes everything, for None."""
    return None if wanted is None else Filter(wanted)
