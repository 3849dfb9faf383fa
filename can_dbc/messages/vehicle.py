"""The datagrams about driving: drive setpoint (planner to controller) and vehicle report (controller to planner).

They travel in the envelope of `can_dbc.messages.envelope`; `can_dbc.messages.datagrams` encodes and decodes them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from can_dbc.messages.envelope import Common, finite

_DRIVE: Final = struct.Struct("<IBB9d")
_VEHICLE: Final = struct.Struct("<IBHHBBH3Q14d")
_FLOAT_FRONT: Final = 1
_FLOAT_REAR: Final = 2
_LEVEL: Final = 4
_FLAGS: Final = _FLOAT_FRONT | _FLOAT_REAR | _LEVEL

Heights = tuple[float, float, float, float]
"""Of the swing arms front left, front right, rear left, rear right [m] above the lowest position of the frame."""


class Steering(IntEnum):
    """What steers the machine during a drive setpoint."""

    WAYPOINT = 0
    """The bearing to the waypoint (paper B's law)."""
    ARTICULATION = 1
    """A requested articulation angle."""


_STEERINGS: Final = tuple(Steering)
"""By number, as in `can_dbc.messages.crane`."""


class Driving(IntEnum):
    """State of the vehicle."""

    STANDING = 0
    DRIVING = 1
    """A drive setpoint is executed, also one of zero speed."""
    BRAKING = 2
    """The setpoint has ended, and the machine slows down."""


@dataclass(frozen=True, slots=True)
class DriveSetpoint:
    """A drive command with a lease: valid until ``stamp_ns + lease_ns``.

    WAYPOINT steers to ``latitude_deg`` and ``longitude_deg`` (WGS 84); ARTICULATION bends to ``articulation_rad``,
    which moves with ``articulation_rate_rad_s`` (+ left).  The fields of the other steering are 0.  ``speed_m_s``
    is that of the front axle, + forward; 0 stands still with the brake on.  ``level`` corrects the heights for roll and
    pitch.  One axle may float, never both.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    lease_ns: int
    steering: Steering
    latitude_deg: float
    longitude_deg: float
    articulation_rad: float
    articulation_rate_rad_s: float
    speed_m_s: float
    heights_m: Heights
    float_front: bool
    float_rear: bool
    level: bool = False


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """State of the vehicle, 20 times per second on a machine that drives; unknown values are NaN.

    ``*_ns`` are monotonic reception stamps of the values that follow them, 0 for never.  ``driving`` is a `Driving`;
    ``refused`` counts drive setpoints refused since start, ``refusal`` is the last reason.  ``heading_rad`` is
    clockwise from true north, of the half that carries the antennas, but ``yaw_rate_rad_s`` is + when it turns left.
    ``fix`` is the method of PGN 129029, ``sigma_m`` the horizontal error (1 sigma) that goes with it.  ``roll_rad`` is
    + with the right side down, ``pitch_rad`` + nose up.  ``stale_mask`` has a bit, in the order of `VEHICLE_INPUTS`,
    for every stale input.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    drive_sequence: int
    driving: int
    refusal: int
    refused: int
    position_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    fix: int
    satellites: int
    sigma_m: float
    heading_ns: int
    heading_rad: float
    yaw_rate_rad_s: float
    motion_ns: int
    speed_m_s: float
    articulation_rad: float
    roll_rad: float
    pitch_rad: float
    heights_m: Heights
    stale_mask: int


VEHICLE_INPUTS: Final = (
    "VehStat",
    "ArmHeightA",
    "ArmHeightB",
    "PositionRapidUpdate",
    "VesselHeading",
    "RateOfTurn",
    "GnssPositionData",
    "EncArtic",
)
"""Messages by their bit in ``VehicleReport.stale_mask``."""


def drive_body(m: DriveSetpoint) -> bytes:
    """Encode the body of a drive setpoint."""
    flags = _FLOAT_FRONT * m.float_front | _FLOAT_REAR * m.float_rear | _LEVEL * m.level
    return _DRIVE.pack(
        m.lease_ns // 1000,
        m.steering,
        flags,
        m.latitude_deg,
        m.longitude_deg,
        m.articulation_rad,
        m.articulation_rate_rad_s,
        m.speed_m_s,
        *m.heights_m,
    )


def drive_from(common: Common, body: bytes) -> DriveSetpoint:
    """Decode the drive setpoint in a body.

    Raises struct.error for a wrong length, ValueError for an illegal value and DatagramRefused for one that is not
    finite.
    """
    lease_us, steering, flags, latitude, longitude, angle, rate, speed, *heights = _DRIVE.unpack(body)
    if flags & ~_FLAGS:
        raise ValueError("unknown flags")
    if steering >= len(_STEERINGS):
        raise ValueError("unknown steering")
    finite((latitude, longitude, angle, rate, speed, *heights))
    h1, h2, h3, h4 = heights
    return DriveSetpoint(
        *common,
        lease_us * 1000,
        _STEERINGS[steering],
        latitude,
        longitude,
        angle,
        rate,
        speed,
        (h1, h2, h3, h4),
        bool(flags & _FLOAT_FRONT),
        bool(flags & _FLOAT_REAR),
        bool(flags & _LEVEL),
    )


def vehicle_body(m: VehicleReport) -> bytes:
    """Encode the body of a vehicle report."""
    return _VEHICLE.pack(
        m.drive_sequence,
        m.driving,
        m.refusal,
        m.refused & 0xFFFF,
        m.fix,
        m.satellites,
        m.stale_mask,
        m.position_ns,
        m.heading_ns,
        m.motion_ns,
        m.latitude_deg,
        m.longitude_deg,
        m.altitude_m,
        m.sigma_m,
        m.heading_rad,
        m.yaw_rate_rad_s,
        m.speed_m_s,
        m.articulation_rad,
        m.roll_rad,
        m.pitch_rad,
        *m.heights_m,
    )


def vehicle_from(common: Common, body: bytes) -> VehicleReport:
    """Decode the vehicle report in a body; raises struct.error for a wrong length."""
    values = _VEHICLE.unpack(body)
    sequence, driving, refusal, refused, fix, satellites, stale, position_ns, heading_ns, motion_ns = values[:10]
    latitude, longitude, altitude, sigma, heading, yaw_rate, speed, angle, roll, pitch, *heights = values[10:]
    h1, h2, h3, h4 = heights
    return VehicleReport(
        *common,
        sequence,
        driving,
        refusal,
        refused,
        position_ns,
        latitude,
        longitude,
        altitude,
        fix,
        satellites,
        sigma,
        heading_ns,
        heading,
        yaw_rate,
        motion_ns,
        speed,
        angle,
        roll,
        pitch,
        (h1, h2, h3, h4),
        stale,
    )
