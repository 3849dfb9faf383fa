"""NMEA 2000 on top of 29-bit frames: identifier fields, fast packets, and the PGNs of ``gnss.dbc``.

Layouts are in ``gnss.dbc`` only; a message there that is longer than 8 bytes travels as a fast packet.
``Receiver.receive`` accepts every frame of a bus and returns a ``Reading`` when a message is complete; it ignores
unknown frames and refuses invalid ones (``FrameRefused``).  ``encode`` and ``frames`` are the inverse; a field not
given is sent as "not available".  Time is ``now_ns``, monotonic.  Source: NMEA 2000 as documented by canboat.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.dbc.codegen import Values
from can_dbc.dbc.signals import FrameRefused, Refusal
from can_dbc.frame import ERROR, EXTENDED, REMOTE
from runtime.errors import ConfigError, InputRefused

BROADCAST: Final = 255
MAX_FAST_PACKET_AGE_NS: Final = 750_000_000
MAX_OPEN_PACKETS: Final = 64
FIRST_FRAME_BYTES: Final = 6
NEXT_FRAME_BYTES: Final = 7
MAX_FAST_PACKET_BYTES: Final = FIRST_FRAME_BYTES + 31 * NEXT_FRAME_BYTES


class Identifier(NamedTuple):
    """The parts of a 29-bit identifier: priority 0 to 7, PGN, source and destination address (255: all)."""

    priority: int
    pgn: int
    source: int
    destination: int


def split_id(key: int) -> Identifier:
    """Split a key or bare identifier into its parts."""
    pgn = key >> 8 & 0x3FFFF
    destination = BROADCAST
    if pgn >> 8 & 0xFF < 240:
        destination, pgn = pgn & 0xFF, pgn & 0x3FF00
    return Identifier(key >> 26 & 7, pgn, key & 0xFF, destination)


def join_id(priority: int, pgn: int, source: int, destination: int = BROADCAST) -> int:
    """Build the extended key of a PGN; ValueError for a destination or low byte that the PGN's format excludes."""
    if pgn >> 8 & 0xFF < 240:
        if pgn & 0xFF:
            raise ValueError(f"PGN {pgn} is addressed, its low byte must be 0")
        pgn |= destination
    elif destination != BROADCAST:
        raise ValueError(f"PGN {pgn} is broadcast only, it cannot be sent to address {destination}")
    return EXTENDED | priority << 26 | pgn << 8 | source


class _Assembly:
    """The frames of one message so far; ``lost``: it cannot be completed, and its remaining frames are not used."""

    __slots__ = ("lost", "missing", "newest_ns", "next_index", "parts", "started_ns")

    def __init__(self, missing: int, next_index: int, lost: bool, now_ns: int) -> None:
        self.missing, self.next_index, self.lost = missing, next_index, lost
        self.started_ns = self.newest_ns = now_ns
        self.parts: list[bytes] = []

    def continues(self, index: int, now_ns: int) -> bool:
        """Tell whether a frame may be of this message: a later one, not stamped before its newest nor after 750 ms."""
        return index >= self.next_index and self.newest_ns <= now_ns <= self.started_ns + MAX_FAST_PACKET_AGE_NS


class Reassembler:
    """Reassembles the fast packets of one bus per source, destination, PGN and sequence number.

    A message is complete only of its first frame and all further ones in the order of their counter, none stamped
    before the one in front of it, within 750 ms.  Anything else loses it: frames without a first one, behind a gap or
    from a clock that was set are not used.  At most 64 are open.  ``lost`` counts the messages lost so far.
    """

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], _Assembly] = {}
        self.lost = 0

    def add(self, key: int, data: bytes, now_ns: int) -> bytes | None:
        """Add one frame; returns the payload if it completes a packet.  Raises FrameRefused for an invalid frame."""
        if len(data) < 2:
            raise FrameRefused(Refusal.LENGTH, f"fast packet frame of PGN {split_id(key).pgn}")
        index, slot = data[0] & 0x1F, (key & 0x03FF_FFFF, data[0] >> 5)
        assembly = self._open.get(slot)
        if index == 0:
            self._lose(assembly)
            assembly = self._begin(slot, data[1], 1, data[1] > MAX_FAST_PACKET_BYTES, now_ns)
            part, room = data[2:8], FIRST_FRAME_BYTES
        else:
            if assembly is None or not assembly.continues(index, now_ns):
                self._lose(assembly)
                self.lost += 1  # the message of this frame, whose first one did not come
                self._begin(slot, 0, index + 1, True, now_ns)
                return None
            if index > assembly.next_index:
                self._lose(assembly)
            assembly.newest_ns, assembly.next_index = now_ns, index + 1
            if assembly.lost:
                return None
            part, room = data[1:8], NEXT_FRAME_BYTES
        if assembly.lost or len(part) < min(assembly.missing, room):
            assembly.lost = True  # refused, and counted as that
            raise FrameRefused(Refusal.LENGTH, f"fast packet of PGN {split_id(key).pgn}")
        if assembly.missing > room:
            assembly.missing -= room
            assembly.parts.append(part)
            return None
        del self._open[slot]
        return b"".join(assembly.parts) + part[: assembly.missing]

    def end(self) -> None:
        """End the reception: no more frames will come, what is still open is lost."""
        for assembly in self._open.values():
            self._lose(assembly)
        self._open.clear()

    def _begin(self, slot: tuple[int, int], missing: int, next_index: int, lost: bool, now_ns: int) -> _Assembly:
        if slot not in self._open and len(self._open) >= MAX_OPEN_PACKETS:
            oldest = min(self._open, key=lambda slot: self._open[slot].started_ns)
            self._lose(self._open.pop(oldest))
        assembly = self._open[slot] = _Assembly(missing, next_index, lost, now_ns)
        return assembly

    def _lose(self, assembly: _Assembly | None) -> None:
        """Count a message as lost, once."""
        if assembly is not None and not assembly.lost:
            assembly.lost = True
            self.lost += 1


def fast_packet(payload: bytes, sequence: int) -> Iterator[bytes]:
    """Yield the frames of a fast packet, padded with ones; ``sequence`` 0 to 7 distinguishes packets of one PGN."""
    if len(payload) > MAX_FAST_PACKET_BYTES:
        raise ValueError(f"a fast packet carries at most {MAX_FAST_PACKET_BYTES} bytes, not {len(payload)}")
    head = (sequence & 7) << 5
    yield (bytes((head, len(payload))) + payload[:FIRST_FRAME_BYTES]).ljust(8, b"\xff")
    for index, start in enumerate(range(FIRST_FRAME_BYTES, len(payload), NEXT_FRAME_BYTES), 1):
        yield (bytes((head | index,)) + payload[start : start + NEXT_FRAME_BYTES]).ljust(8, b"\xff")


@dataclass(frozen=True, slots=True)
class Reading:
    """One decoded PGN: its identifier, its codec, and the values in signal order (None: not available)."""

    identifier: Identifier
    codec: MessageCodec
    values: Values

    @property
    def fields(self) -> dict[str, Any]:
        """The available values by name."""
        return self.codec.named(self.values)


class Receiver:
    """Decodes the PGNs of a database from the frames of a bus, fast packets included."""

    def __init__(self, database: Database | None = None) -> None:
        self.database = database or load("gnss")
        self.reassembler = Reassembler()

    def receive(self, key: int, data: bytes, now_ns: int) -> Reading | None:
        """Return a reading if this frame is or completes a message, else None; FrameRefused if it must not be used."""
        if not key & EXTENDED or key & (ERROR | REMOTE):
            return None
        codec = self.database.find(key)
        if codec is None:
            return None
        payload: bytes | None = data
        if codec.length > 8:
            payload = self.reassembler.add(key, data, now_ns)
            if payload is None:
                return None
        return Reading(split_id(key), codec, decode(codec, payload or b""))


def decode(codec: MessageCodec, payload: bytes) -> Values:
    """Decode a PGN to checked values; a fast packet may be longer than described (repeated groups, later fields)."""
    return codec.receive(payload[: codec.length] if codec.length > 8 else payload)


def encode(codec: MessageCodec, **fields: Any) -> bytes:
    """Encode the payload of a PGN; fields not given are "not available".  Raises InputRefused for an invalid value."""
    unknown = fields.keys() - codec.index.keys()
    if unknown:
        raise InputRefused("codec.unknown-field", f"{codec.name} has no field {', '.join(sorted(unknown))}")
    return codec.encode(*(fields.get(s.name) for s in codec.signals))


def frames(codec: MessageCodec, payload: bytes, source: int, sequence: int = 0) -> list[tuple[int, bytes]]:
    """List the frames that carry a payload: one, or those of a fast packet; the priority is that of the database."""
    if not codec.by_pgn:
        raise ConfigError("dbc.not-by-pgn", f"{codec.name} is not matched by PGN; its source address cannot be chosen")
    key = codec.key & ~0xFF | source
    if codec.length <= 8:
        return [(key, payload)]
    return [(key, data) for data in fast_packet(payload, sequence)]
