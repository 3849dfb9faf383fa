"""The datagrams between planner and console about a mission: its report, and operator commands to the mission.

Both travel in the envelope of `can_dbc.messages.envelope` (magic, version, profile, stamp, CRC, HMAC if there is a
key); the controller refuses both.  A `MissionReport` is JSON, to hold more than a fixed layout could; a report that
does not match its schema in every field is refused as a whole.  Places are (latitude, longitude) in degrees, WGS84;
directions are degrees clockwise from true north.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Final, Literal

import msgspec

from can_dbc.messages.envelope import DatagramFault, DatagramRefused, Kind, sealed, unsealed

SCHEMA: Final = 1
MAX_BYTES: Final = 60_000
MAX_ROUTE_POINTS: Final = 300
MAX_FENCES: Final = 20
MAX_CORNERS: Final = 300
"""Of all fences together."""
MAX_LANDINGS: Final = 20
MAX_LOGS: Final = 150
MAX_GIVEN_UP: Final = 20
MAX_TARGETS: Final = 8
MAX_TEXT_CHARS: Final = 120

_COMMAND: Final = struct.Struct("<I")


class MissionAction(IntEnum):
    """Operator commands to a mission; each one is an edge, not a level."""

    AUTO = 1
    PAUSE = 2
    SINGLE_STEP = 3
    RUN_THROUGH = 4
    """End of single steps."""
    NEXT_STEP = 5
    ABORT = 6


@dataclass(frozen=True, slots=True)
class MissionCommand:
    """One operator command to the planner."""

    sequence: int
    profile_hash: int
    stamp_ns: int
    action: MissionAction


Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT_CHARS)]
Count = Annotated[int, msgspec.Meta(ge=0)]
Metres = Annotated[float, msgspec.Meta(ge=0.0)]
Bearing = Annotated[float, msgspec.Meta(ge=0.0, le=360.0)]
LatLon = tuple[Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)], Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]]


class Fence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fence without its closing corner; the machine stays inside it, or outside if ``keep_out``."""

    corners: Annotated[tuple[LatLon, ...], msgspec.Meta(max_length=MAX_CORNERS)]
    keep_out: bool
    name: Text


class Landing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A landing."""

    place: LatLon
    name: Text


class AbandonedLog(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that the planner no longer tries to load, and why."""

    log: int
    reason: Text


class KnownLog(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log on the planner's map: center, direction, time since it was seen, and number of missed grasps."""

    number: int
    place: LatLon
    bearing_deg: Bearing
    length_m: Metres
    diameter_m: Metres
    age_s: Metres
    misses: Count
    given_up: bool


class MachinePose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The planner's estimate of the middle of the front axle, with its standard deviation (1 sigma)."""

    place: LatLon
    heading_deg: Bearing
    sigma_m: Metres


class MissionReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The state of a mission, twice per second.

    ``state`` is the short name of its state and ``words`` describes it; ``paused`` says why nothing moves,
    ``waits_for`` which transition waits for the next single step, ``failure`` why the mission ended early.  ``targets``
    are the numbers of the logs to grasp, ``crane`` describes what the crane does.  ``route`` is driven repeatedly if
    ``closed``.  ``order`` is the sequence number of the last command or upload and ``refusal`` why it was refused; an
    upload, and a command that the operator's mode switch forbids, has a ``refusal_code``, too.
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
    given_up: Annotated[tuple[AbandonedLog, ...], msgspec.Meta(max_length=MAX_GIVEN_UP)]
    driven_m: Metres
    targets: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_TARGETS)]
    crane: Text
    here: MachinePose | None
    route: Annotated[tuple[LatLon, ...], msgspec.Meta(max_length=MAX_ROUTE_POINTS)]
    closed: bool
    fences: Annotated[tuple[Fence, ...], msgspec.Meta(max_length=MAX_FENCES)]
    landings: Annotated[tuple[Landing, ...], msgspec.Meta(max_length=MAX_LANDINGS)]
    logs: Annotated[tuple[KnownLog, ...], msgspec.Meta(max_length=MAX_LOGS)]
    refusal_code: Text = ""


_REPORT: Final = msgspec.json.Decoder(MissionReport)
_JSON: Final = msgspec.json.Encoder()


def encode_mission_command(command: MissionCommand, key: bytes | None = None) -> bytes:
    """Encode the bytes of a command."""
    common = (command.sequence, command.profile_hash, command.stamp_ns)
    return sealed(Kind.ORDER, common, _COMMAND.pack(command.action), key)


def decode_mission_command(data: bytes, key: bytes | None = None) -> MissionCommand:
    """Decode the command in a datagram.

    Raises:
        DatagramRefused: it is not a valid command.
    """
    kind, common, body = unsealed(data, key)
    if kind != Kind.ORDER:
        raise DatagramRefused(DatagramFault.KIND)
    if len(body) != _COMMAND.size:
        raise DatagramRefused(DatagramFault.LENGTH)
    try:
        return MissionCommand(*common, MissionAction(*_COMMAND.unpack(body)))
    except ValueError:
        raise DatagramRefused(DatagramFault.VALUE) from None


def encode_mission(
    report: MissionReport, sequence: int, profile_hash: int, stamp_ns: int, key: bytes | None = None
) -> bytes:
    """Encode the bytes of a report; raises ValueError if it is longer than ``MAX_BYTES``."""
    data = sealed(Kind.MISSION, (sequence, profile_hash, stamp_ns), _JSON.encode(report), key)
    if len(data) > MAX_BYTES:
        raise ValueError(f"a mission report of {len(data)} bytes does not fit; one datagram holds at most {MAX_BYTES}")
    return data


def decode_mission(data: bytes, key: bytes | None = None) -> tuple[int, int, MissionReport]:
    """Decode profile hash, stamp [ns] and report in a datagram; raises DatagramRefused."""
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


# -- The datagram from console to planner that offers a mission: the name and SHA-256 of a file that both can read.
#
# It travels as a mission command does, in the same envelope and to the same port.  The
# file itself is in a folder that both processes know, so a mission of any size fits, and with a key the digest
# authenticates it.  The planner's next mission report has the upload's sequence number in ``order`` and why it is
# refused in ``refusal`` and ``refusal_code``, and also goes to the sender.

DIGEST_BYTES: Final = 32
FILE_NAME: Final = re.compile(r"[^\W_][\w .-]{0,59}\.geojson")
"""Names of missions in the folder: letters of any language, no separators, no leading dot."""


@dataclass(frozen=True, slots=True)
class MissionUpload:
    """An offered mission: its file's name, and the SHA-256 of its bytes."""

    sequence: int
    profile_hash: int
    stamp_ns: int
    name: str
    digest: bytes


def encode_mission_upload(upload: MissionUpload, key: bytes | None = None) -> bytes:
    """Encode the bytes of an upload."""
    common = (upload.sequence, upload.profile_hash, upload.stamp_ns)
    return sealed(Kind.UPLOAD, common, upload.digest + upload.name.encode(), key)


def decode_mission_upload(data: bytes, key: bytes | None = None) -> MissionUpload:
    """Decode the upload in a datagram.

    Raises:
        DatagramRefused: it is not a valid upload.
    """
    kind, common, body = unsealed(data, key)
    if kind != Kind.UPLOAD:
        raise DatagramRefused(DatagramFault.KIND)
    name = body[DIGEST_BYTES:].decode(errors="replace")
    if not FILE_NAME.fullmatch(name):
        raise DatagramRefused(DatagramFault.VALUE)
    return MissionUpload(*common, name, body[:DIGEST_BYTES])


# -- The datagram from planner to console about the grasp that the crane is about to make, twice a second until the
# jaws have closed.
#
# It travels in the envelope of `can_dbc.messages.envelope` as JSON, like a mission report, and is only shown: the
# controller refuses it.  A grasp that does not match its schema in every field is refused as a whole.

MAX_GRASP_LOGS: Final = 20
MAX_REASON_CHARS: Final = 240


class ChosenGrasp(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the hanger pin will be when the jaws begin to close, in the crane's base frame [m], the direction of their
    opening axis there [rad, counter-clockwise from base x], the logs' numbers, and the planner's sentence why.
    """

    schema: Literal[1]
    pin_m: tuple[float, float, float]
    yaw_rad: float
    logs: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_GRASP_LOGS)]
    reason: Annotated[str, msgspec.Meta(max_length=MAX_REASON_CHARS)]


_GRASP: Final = msgspec.json.Decoder(ChosenGrasp)


def encode_grasp(
    grasp: ChosenGrasp, sequence: int, profile_hash: int, stamp_ns: int, key: bytes | None = None
) -> bytes:
    """Encode the bytes of a grasp."""
    return sealed(Kind.GRASP, (sequence, profile_hash, stamp_ns), msgspec.json.encode(grasp), key)


def decode_grasp(data: bytes, key: bytes | None = None) -> tuple[int, int, ChosenGrasp]:
    """Decode profile hash, stamp [ns] and grasp in a datagram.

    Raises:
        DatagramRefused: it is not a valid grasp.
    """
    kind, (_, profile_hash, stamp_ns), body = unsealed(data, key)
    if kind != Kind.GRASP:
        raise DatagramRefused(DatagramFault.KIND)
    try:
        return profile_hash, stamp_ns, _GRASP.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise DatagramRefused(DatagramFault.VALUE) from None
