"""Detects lost frames: the counters of protected frames must be consecutive; pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from can_dbc.dbc.codec import Database, load
from can_dbc.protocols.e2e import frame_crc
from machine.profile import Profile


class Continuity:
    """Frames that one participant saw on a bus.

    ``frames`` counts them by key; ``gaps`` and ``damaged`` count protected frames with a counter that is not
    consecutive, or with a wrong CRC.
    """

    def __init__(self, databases: Iterable[Database]) -> None:
        protected = [m for database in databases for m in database.messages.values() if m.data_ids]
        self._ids = {m.key: bytes(m.data_ids or b"") for m in protected}
        self._last: dict[int, int] = {}
        self.frames: Counter[int] = Counter()
        self.gaps = self.damaged = 0

    def add(self, key: int, data: bytes) -> None:
        """Add one frame, in the order of the bus."""
        self.frames[key] += 1
        ids = self._ids.get(key)
        if ids is None:
            return
        if len(data) < 2 or frame_crc(data, ids) != data[0]:
            self.damaged += 1
            return
        counter = data[1] & 0x0F
        last = self._last.get(key)
        if last is not None and counter != (last + 1) & 0x0F:
            self.gaps += 1
        self._last[key] = counter


def databases(profile: Profile) -> list[Database]:
    """The databases that define the protected frames of a machine."""
    return [load("crane"), *([load("machine")] if profile.machine_bus else [])]
