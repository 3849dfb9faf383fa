"""The transport protocol of J1939 (SAE J1939-21): messages of 9 to 1785 bytes in frames, heard on one bus.

``receive`` accepts every frame and returns the message that it completes: broadcast (BAM), and addressed (RTS/CTS),
where a CTS may ask for frames again.  It listens only and sends nothing.  A message is complete only of all its frames
in order, each at most 1.25 s after the one before and none stamped before it; ``lost`` counts the others, and
``unopened`` the frames of data that belong to no message under way, because its opening was not heard or it is lost.
Messages of the extended protocol (ETP, longer) are counted in ``extended`` and not decoded.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from can_dbc.frame import ERROR, EXTENDED, REMOTE
from can_dbc.protocols.nmea2000 import BROADCAST, split_id

CONNECTION_PGN: Final = 0xEC00
DATA_PGN: Final = 0xEB00
EXTENDED_CONNECTION_PGN: Final = 0xC800
MAX_GAP_NS: Final = 1_250_000_000
"""T2 and T3 of J1939-21, the longest silence within a message."""
BYTES_PER_FRAME: Final = 7
PRIORITY: Final = 6
"""Of a message's identifier: its frames tell only that of the transport."""
_RTS: Final = 16
_CTS: Final = 17
_BAM: Final = 32
_ABORT: Final = 255
_EXTENDED_RTS: Final = 20


class Transported(NamedTuple):
    """A whole message: the extended key that its identifier would have, and its bytes."""

    key: int
    data: bytes


class _Session:
    __slots__ = ("frames", "key", "newest_ns", "parts", "size")

    def __init__(self, key: int, size: int, frames: int, now_ns: int) -> None:
        self.key, self.size, self.frames, self.newest_ns = key, size, frames, now_ns
        self.parts: list[bytes] = []


class Transport:
    """The messages under way on one bus, one for each pair of addresses."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], _Session] = {}
        self.lost = self.extended = self.unopened = 0

    def receive(self, key: int, data: bytes, now_ns: int) -> Transported | None:
        """Return the message that this frame completes; a frame that is none of the transport's changes nothing."""
        if not key & EXTENDED or key & (ERROR | REMOTE):
            return None
        _, pgn, source, destination = split_id(key)
        if pgn == DATA_PGN:
            return self._data(source, destination, data, now_ns)
        if pgn == CONNECTION_PGN and len(data) == 8:
            self._control(source, destination, data, now_ns)
        elif pgn == EXTENDED_CONNECTION_PGN and len(data) == 8:
            self.extended += data[0] == _EXTENDED_RTS
        return None

    def end(self) -> None:
        """End the reception: no more frames will come, what is still under way is lost."""
        self.lost += len(self._open)
        self._open.clear()

    def _control(self, source: int, destination: int, data: bytes, now_ns: int) -> None:
        kind = data[0]
        if kind in (_BAM, _RTS):
            self._lose(source, destination)
            size, frames, pgn = data[1] | data[2] << 8, data[3], data[5] | data[6] << 8 | (data[7] & 3) << 16
            if not frames or frames != -(-size // BYTES_PER_FRAME) or (kind == _BAM) != (destination == BROADCAST):
                self.lost += 1
                return
            if pgn >> 8 & 0xFF < 240:
                pgn = pgn & 0x3FF00 | destination
            identifier = PRIORITY << 26 | pgn << 8 | source
            self._open[source, destination] = _Session(EXTENDED | identifier, size, frames, now_ns)
        elif kind == _CTS:
            session = self._open.get((destination, source))
            if session is not None:
                session.newest_ns = now_ns
                if 0 < data[2] <= len(session.parts):  # frames that the receiver wants once more
                    del session.parts[data[2] - 1 :]
        elif kind == _ABORT:
            self._lose(source, destination)
            self._lose(destination, source)

    def _data(self, source: int, destination: int, data: bytes, now_ns: int) -> Transported | None:
        session = self._open.get((source, destination))
        if session is None:
            self.unopened += 1
            return None
        number = len(session.parts) + 1
        in_time = session.newest_ns <= now_ns <= session.newest_ns + MAX_GAP_NS
        needed = min(BYTES_PER_FRAME, session.size - BYTES_PER_FRAME * len(session.parts))
        if not in_time or not data or data[0] != number or len(data) <= needed:
            self._lose(source, destination)
            return None
        session.newest_ns = now_ns
        session.parts.append(data[1:8])
        if number < session.frames:
            return None
        del self._open[source, destination]
        return Transported(session.key, b"".join(session.parts)[: session.size])

    def _lose(self, source: int, destination: int) -> None:
        if self._open.pop((source, destination), None) is not None:
            self.lost += 1
