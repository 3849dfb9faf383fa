"""What a machine is, as the controller and the planner know it: the profile (TOML) and its validation.

A profile never holds the truth of one individual machine (that is ``sim/truth``); it holds what a
commissioning engineer wrote down: geometry, limits, sensor nodes, valve map, gains.  Every limit and gain is
per second, so any control rate works.  For the prismatic joint EXT read metres where a field says
``rad``-free ``position``/``speed``.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from machine.joints import ARTICULATION, JOINTS, Joint


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
    """A valve function.

    Dead-band on either side [%], metering ``exponent`` behind it, speed at full command [unit/s], sign; dead time and
    lag of the spool behind it [s], and ``oil_s``, how much later still the joint follows, for pump and oil; pump flow
    that a joint speed takes on either side [m^3 per unit]; ``hysteresis_pct``, the whole width of the spool's play [%
    of the stroke].  ``lever``: arm of the cylinder at the joint positions ``lever_at``, as a share of where the full
    speeds and flows hold; empty when it is the same everywhere.
    """

    signal: str
    sign: Literal[-1, 1]
    deadband_plus_pct: float
    deadband_minus_pct: float
    full_speed_plus: float
    full_speed_minus: float
    delay_s: float
    lag_s: float
    flow_plus: float
    flow_minus: float
    exponent: float = 1.0
    hysteresis_pct: float = 0.0
    oil_s: float = 0.0
    lever_at: tuple[float, ...] = ()
    lever: tuple[float, ...] = ()


class Law(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A joint's law (docs/reference/machines.md section 4).

    ``kp_1_s`` [1/s] is what every ``kind`` may spend on small errors, ``kd`` [-] the gain of the PD's and PID's error
    rate, ``layer`` [unit] the boundary layer of the sliding laws.  ``damping_per_bar`` [unit/s per bar] gives way to
    vibrations of the load pressure.  Within ``stop_band`` [unit] a joint that came to rest is left alone.
    ``velocity_filter_s`` filters the velocity where a PLC runs the law.
    """

    kind: Literal["pd", "pid", "sliding_mode", "super_twisting"]
    kp_1_s: float
    kd: float
    layer: float
    damping_per_bar: float
    stop_band: float
    velocity_filter_s: float


class Hydraulics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What feeds the functions: the flow [m^3/s] that the pump gives at work."""

    pump_flow_m3_s: float


class Sag(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the column leans under the weight, as a survey found it; `machine.geometry.sag` says what it does to the pin.

    Lean of the empty crane [rad] = ``head_rad_m`` * r_head + ``pin_rad_m`` * r_pin - ``rest_rad``, and
    ``load_rad_nm`` per Nm that a load adds.  Moment of the empty crane at the lift joint [Nm] = ``head_nm_m`` *
    (r_head - a1) + ``pin_nm_m`` * (r_pin - a1).  The last three are 0 where no pressures were measured: then nothing
    is known of loads.
    """

    head_rad_m: float
    pin_rad_m: float
    rest_rad: float
    load_rad_nm: float = 0.0
    head_nm_m: float = 0.0
    pin_nm_m: float = 0.0


class Imu(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An inertial sensor on the grapple, and how its swing is damped (`controller.laws.sway`).

    ``node`` and ``message`` in ``crane.dbc`` as for an encoder.  It is mounted on the part above the rotator that
    swings on both hinges and does not turn, so that its axes are the crane's: radial lean and rate are positive when
    the grapple hangs and swings outward, tangential ones to the left, as the slew turns.  ``gain`` [-] is twice the
    damping ratio that the pin's motion adds to a pendulum of ``pendulum_m`` [m], the length of a point pendulum of the
    grapple's period; the pin goes no faster than ``pin_speed_m_s`` for it, and within ``dead_zone_rad`` of swing
    nothing is done.
    """

    node: int
    message: str
    gain: float
    pendulum_m: float
    pin_speed_m_s: float
    dead_zone_rad: float


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
    """Tong geometry over the tong angle (0 = fully open), docs/reference/machines.md section 1.5."""

    angle_rad: tuple[float, ...]
    half_gap_m: tuple[float, ...]
    tip_below_pin_m: tuple[float, ...]


class Grapple(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grapple: geometry, open-loop times, the pressure that says closed, and whether its opening is measured."""

    close_time_s: float
    open_time_s: float
    hold_pressure_bar: float
    opening_sensor: bool
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


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A stereo camera as mounted and calibrated (docs/reference/machines.md section 8): pinhole optics and depth range.

    ``position_m`` and ``rpy_rad`` (about the fixed axes x, then y, then z) place its body frame, x forward, y left,
    z up, in the frame of ``link``; a positive pitch looks down.  Its optical frame is x right, y down, z forward.
    ``fx_px`` .. ``cy_px`` are of the rectified left picture of ``width_px`` by ``height_px``.  Its depth is to be
    divided by ``depth_scale``, which a survey finds.
    """

    model: str
    link: str
    position_m: tuple[float, float, float]
    rpy_rad: tuple[float, float, float]
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    rate_hz: float
    depth_min_m: float
    depth_max_m: float
    depth_scale: float = 1.0


class CarrierValve(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A valve that the carrier's own nodes drive: dead-band on either side [%], speed at full command [unit/s],
    delay [s].
    """

    deadband_plus_pct: float
    deadband_minus_pct: float
    full_speed_plus: float
    full_speed_minus: float
    delay_s: float


class Carrier(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An articulated four-wheel carrier on swing arms (docs/reference/machines.md section 7); ``machine.geometry.carrier`` has its geometry.

    Frames ``rear`` and ``front`` share the articulation axis: origin on it, x forward, y left, z up, z = 0 at the
    pivots of the swing arms.  ``front_axle_m`` and ``rear_axle_m`` are their distances from the axis at the
    transport height.  A height counts how far the frame stands above its lowest position; ``arm_drop_low_m`` is
    the wheel hub below its pivot there (negative: above it).  Beyond ``tilt_limit_rad`` of roll or pitch the machine
    does not drive.  Steering speeds are in rad/s, + bends left; swing-arm
    speeds in m/s of height, + lifts the frame.
    """

    front_axle_m: float
    rear_axle_m: float
    track_width_m: float
    wheel_radius_m: float
    wheel_width_m: float
    arm_length_m: float
    arm_drop_low_m: float
    arm_travel_m: float
    arm_transport_m: float
    arm_kp_1_s: float
    arm_rate_limit_m_s: float
    arm_in_band_m: float
    articulation_limit_rad: float
    articulation_rate_limit_rad_s: float
    articulation_lag_s: float
    articulation_encoder: Encoder
    heading_kp_1_s: float
    cruise_speed_m_s: float
    speed_limit_m_s: float
    drive_acceleration_m_s2: float
    tilt_limit_rad: float
    crane_base_m: tuple[float, float, float]
    crane_yaw_rad: float
    antenna_main_m: tuple[float, float, float]
    antenna_aux_m: tuple[float, float, float]
    site_lat_deg: float
    site_lon_deg: float
    steer_valve: CarrierValve
    arm_valve: CarrierValve


class Plc(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A machine PLC on Ethernet in place of the nodes on crane0 (docs/reference/can-bus.md section 10).  ``role``: it closes the joint loops
    on the controller's references, or passes the controller's valve commands on.
    """

    role: Literal["references", "valves"]


class Timeouts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reaction times of the supervisor in ms; frame timeouts come from the DBC."""

    lease_max_ms: int
    stop_ramp_ms: int


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole machine; ``carrier`` is None when it stands still, ``cameras`` may be empty, ``plc``, ``sag`` and
    ``imu`` None without one."""

    schema: Literal[1]
    name: str
    title: str
    rate_hz: int
    crane_bus: str
    machine_bus: str | None
    kinematics: Kinematics
    joints: dict[str, JointSpec]
    hydraulics: Hydraulics
    grapple: Grapple
    bunk: Bunk
    workspace: Workspace
    timeouts: Timeouts
    carrier: Carrier | None
    cameras: dict[str, Camera] = {}
    plc: Plc | None = None
    sag: Sag | None = None
    imu: Imu | None = None


def joint(profile: Profile, which: Joint) -> JointSpec:
    """The specification of one joint."""
    return profile.joints[which.name.lower()]


def encoders(profile: Profile) -> dict[int, Encoder]:
    """Every encoder of the machine by the number of its joint, ``ARTICULATION`` for the carrier's."""
    found = {int(j): spec for j in JOINTS if (spec := joint(profile, j).encoder) is not None}
    if profile.carrier is not None:
        found[ARTICULATION] = profile.carrier.articulation_encoder
    return found


def joint_limits(profile: Profile) -> tuple[tuple[float, float], ...]:
    """(lower, upper) of every joint, indexed by ``Joint``; rad, m for EXT."""
    return tuple((spec.lower, spec.upper) for spec in (joint(profile, j) for j in JOINTS))
