"""What planner and console say to each other about a mission: how it stands, and what a person orders.

Both travel in the envelope of `can_dbc.messages.crane` (magic, version, profile, stamp, CRC, HMAC where there is a key); the
controller refuses either.  A `MissionReport` is JSON within it, so that it may say more than a fixed layout could; one
that does not fit its schema in every field is refused whole.  Places are (latitude, longitude) in degrees, WGS84,
directions degrees clockwise from true north.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Final, Literal

import msgspec

from can_dbc.messages.envelope import DatagramFault, DatagramRefused, Kind, sealed, unsealed

SCHEMA: Final = 1
MAX_BYTES: Final = 60_000
MAX_ROUTE: Final = 300
MAX_FENCES: Final = 20
MAX_CORNERS: Final = 300
"""Of all fences together."""
MAX_LANDINGS: Final = 20
MAX_LOGS: Final = 150
MAX_GIVEN_UP: Final = 20
MAX_TARGETS: Final = 8
MAX_TEXT: Final = 120

_ORDER: Final = struct.Struct("<I")


class Order(IntEnum):
    """What a person may order of a mission; every one is an edge, never a level."""

    AUTO = 1
    PAUSE = 2
    SINGLE_STEP = 3
    RUN_THROUGH = 4
    """No single step any more."""
    NEXT_STEP = 5
    ABORT = 6


@dataclass(frozen=True, slots=True)
class MissionOrder:
    """One order of a person to the planner."""

    sequence: int
    profile_hash: int
    stamp_ns: int
    order: Order


Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
Count = Annotated[int, msgspec.Meta(ge=0)]
Metres = Annotated[float, msgspec.Meta(ge=0.0)]
Bearing = Annotated[float, msgspec.Meta(ge=0.0, le=360.0)]
LatLon = tuple[Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)], Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]]


class Area(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fence without its closing corner; the machine stays in it, or out of it."""

    corners: Annotated[tuple[LatLon, ...], msgspec.Meta(max_length=MAX_CORNERS)]
    keep_out: bool
    name: Text


class Pile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A landing."""

    place: LatLon
    name: Text


class GivenUp(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that is left lying, and why."""

    log: int
    reason: Text


class Lying(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that the planner knows: its middle, its direction, how long ago it was seen; how often it was missed."""

    number: int
    place: LatLon
    bearing_deg: Bearing
    length_m: Metres
    diameter_m: Metres
    age_s: Metres
    misses: Count
    given_up: bool


class Whereabouts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the planner takes the middle of the front axle to be, and how well it knows (1 sigma)."""

    place: LatLon
    heading_deg: Bearing
    sigma_m: Metres


class MissionReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a mission stands, twice a second.

    ``state`` is its short name and ``words`` what the machine is about in it; ``paused`` says why nothing moves,
    ``waits_for`` what has come about and waits for the next single step, ``failure`` why it ended early.  ``targets``
    are the numbers of the logs that are aimed at, ``crane`` is what the crane is about.  ``route`` is driven round and
    round when ``closed``.  ``order`` is the sequence number of the last order and ``refusal`` why it was not obeyed.
    """

    schema: Literal[1]
    name: Text
    state: Text
    words: Text
    ended: bool
    auto: bool
    single_step: bool
    paused: Text
    waits_for: Text
    failure: Text
    order: Count
    refusal: Text
    loaded: Count
    on_board: Count
    on_board_m3: Metres
    unloaded: Count
    missed: Count
    given_up: Annotated[tuple[GivenUp, ...], msgspec.Meta(max_length=MAX_GIVEN_UP)]
    driven_m: Metres
    targets: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_TARGETS)]
    crane: Text
    here: Whereabouts | None
    route: Annotated[tuple[LatLon, ...], msgspec.Meta(max_length=MAX_ROUTE)]
    closed: bool
    fences: Annotated[tuple[Area, ...], msgspec.Meta(max_length=MAX_FENCES)]
    landings: Annotated[tuple[Pile, ...], msgspec.Meta(max_length=MAX_LANDINGS)]
    logs: Annotated[tuple[Lying, ...], msgspec.Meta(max_length=MAX_LOGS)]


_REPORT: Final = msgspec.json.Decoder(MissionReport)
_JSON: Final = msgspec.json.Encoder()


def encode_order(order: MissionOrder, key: bytes | None = None) -> bytes:
    """The bytes of an order."""
    return sealed(Kind.ORDER, (order.sequence, order.profile_hash, order.stamp_ns), _ORDER.pack(order.order), key)


def decode_order(data: bytes, key: bytes | None = None) -> MissionOrder:
    """The order in a datagram; raises DatagramRefused."""
    kind, common, body = unsealed(data, key)
    if kind != Kind.ORDER:
        raise DatagramRefused(DatagramFault.KIND)
    if len(body) != _ORDER.size:
        raise DatagramRefused(DatagramFault.LENGTH)
    try:
        return MissionOrder(*common, Order(*_ORDER.unpack(body)))
    except ValueError:
        raise DatagramRefused(DatagramFault.VALUE) from None


def encode_mission(
    report: MissionReport, sequence: int, profile_hash: int, stamp_ns: int, key: bytes | None = None
) -> bytes:
    """The bytes of a report; raises ValueError when it is longer than ``MAX_BYTES``."""
    data = sealed(Kind.MISSION, (sequence, profile_hash, stamp_ns), _JSON.encode(report), key)
    if len(data) > MAX_BYTES:
        raise ValueError(f"a mission report of {len(data)} bytes; {MAX_BYTES} is the most that one datagram takes")
    return data


def decode_mission(data: bytes, key: bytes | None = None) -> tuple[int, int, MissionReport]:
    """Profile hash, stamp [ns] and report in a datagram; raises DatagramRefused."""
    kind, (_, profile_hash, stamp_ns), body = unsealed(data, key)
    if kind != Kind.MISSION:
        raise DatagramRefused(DatagramFault.KIND)
    try:
        report = _REPORT.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise DatagramRefused(DatagramFault.VALUE) from None
    if sum(len(fence.corners) for fence in report.fences) > MAX_CORNERS:
        raise DatagramRefused(DatagramFault.VALUE)
    return profile_hash, stamp_ns, report
