"""What a machine is, as the controller and the planner know it: the profile (TOML) and its validation.

A profile never holds the truth of one individual machine (that is ``sim/truth``); it holds what a
commissioning engineer wrote down: geometry, limits, sensor nodes, valve map, gains.  Every limit and gain is
per second, so any control rate works.  For the prismatic joint EXT read metres where a field says
``rad``-free ``position``/``speed``.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from machine.joints import JOINTS, Joint


class Kinematics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard Denavit-Hartenberg chain to the hanger pin (RRRP) and the hanging grapple, in m and rad."""

    d1_m: float
    a1_m: float
    theta1_offset_rad: float
    a2_m: float
    theta2_offset_rad: float
    a3_m: float
    theta3_offset_rad: float
    d4_m: float
    hanger_to_fork_m: float
    fork_to_rotator_m: float
    rotator_to_tong_pivot_m: float


class Encoder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A CANopen (CiA 406) encoder: node id, message in ``crane.dbc`` and what start-up reads back and
    compares.

    position = direction * (counts - zero_counts) * unit_per_count, wrapped modulo ``total_counts`` around
    ``zero_counts`` for rotary encoders (object 6002h).  ``unit_per_count`` is rad or m.
    """

    node: int
    message: str
    kind: Literal["rotary", "linear"]
    device_type: int
    total_counts: int
    unit_per_count: float
    zero_counts: int
    direction: Literal[-1, 1]
    noise: float


class Valve(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A valve function: dead-band on either side [%], speed at full command [unit/s], delay [s], sign."""

    signal: str
    sign: Literal[-1, 1]
    deadband_plus_pct: float
    deadband_minus_pct: float
    full_speed_plus: float
    full_speed_minus: float
    delay_s: float


class Law(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """PD law of machines.md 4: gains in 1/s (kp) and dimensionless (kd), stop band in the joint's unit."""

    kp_1_s: float
    kd: float
    stop_band: float
    velocity_filter_s: float


class JointSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One actuated joint.  Positions in rad (m for ``prismatic``), speeds per second, accelerations per
    second squared.
    """

    kind: Literal["revolute", "prismatic"]
    lower: float
    upper: float
    speed_limit: float
    acceleration_limit: float
    encoder: Encoder | None
    valve: Valve
    law: Law


class TongTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Tong geometry over the tong angle (0 = fully open), machines.md 1.5."""

    angle_rad: tuple[float, ...]
    half_gap_m: tuple[float, ...]
    tip_below_pin_m: tuple[float, ...]


class Grapple(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grapple: geometry, open-loop times and the pressures that say closed."""

    close_time_s: float
    open_time_s: float
    hold_pressure_bar: float
    tongs: TongTable


class Bunk(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The load bunk: a floor with stakes whose long axis is horizontal; base frame."""

    center_m: tuple[float, float]
    yaw_rad: float
    length_m: float
    width_m: float
    floor_z_m: float
    stake_height_m: float


class Workspace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where logs lie and how they may be: centre of the pick area and the ground, base frame."""

    ground_z_m: float
    pick_center_m: tuple[float, float]
    pick_half_size_m: float


class Timeouts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reaction times of the supervisor in ms; frame timeouts come from the DBC."""

    lease_max_ms: int
    stop_ramp_ms: int


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole machine."""

    schema: Literal[1]
    name: str
    title: str
    rate_hz: int
    crane_bus: str
    machine_bus: str | None
    kinematics: Kinematics
    joints: dict[str, JointSpec]
    grapple: Grapple
    bunk: Bunk
    workspace: Workspace
    timeouts: Timeouts


def joint(profile: Profile, which: Joint) -> JointSpec:
    """The specification of one joint."""
    return profile.joints[which.name.lower()]


def joint_limits(profile: Profile) -> tuple[tuple[float, float], ...]:
    """(lower, upper) of every joint, indexed by ``Joint``; rad, m for EXT."""
    return tuple((spec.lower, spec.upper) for spec in (joint(profile, j) for j in JOINTS))
