"""The profile (TOML): a machine as controller and planner know it.

A profile holds what a commissioning engineer writes down: geometry, limits, sensor nodes, valve map, gains.  It never
holds the ground truth of an individual machine (``sim/truth``).  Limits and gains are per second, so that every
control rate works.  Positions and speeds without a unit in their name are in rad, for the prismatic joint EXT in m.
"""

from __future__ import annotations

from typing import Final, Literal

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
    """A CANopen (CiA 406) encoder: node id, message in ``crane.dbc`` and the values that start-up reads and compares.

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

    Dead band on either side [%], metering ``exponent`` beyond it, speed at full command [unit/s], sign; dead time and
    lag of the spool [s], and ``oil_s``, the further delay of the joint due to pump and oil; pump flow per joint speed
    on either side [m^3 per unit]; ``hysteresis_pct``, the full width of the spool's hysteresis [% of the stroke].
    ``lever``: lever arm of the cylinder at the joint positions ``lever_at``, as a share of the arm for which the full
    speeds and flows hold; empty if it is constant.
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


OWN_LAWS: Final = ("pd", "pd_plain", "pid", "sliding_mode", "sliding_mode_pe", "super_twisting")
JOINT_LAWS: Final = "timberhand.joint_laws"
"""Entry points of other laws: a factory that takes the `Law` and returns a `controller.laws.feedback.Feedback`."""


class Law(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A joint's control law (docs/reference/machines.md section 4).

    ``kind`` is one of `OWN_LAWS`, or an entry point of the group `JOINT_LAWS`.
    ``kp_1_s`` [1/s] is the gain of every ``kind`` for small errors, ``kd`` [-] the gain of the error rate of PD and
    PID, ``layer`` [unit] the boundary layer of the sliding-mode laws.  ``damping_per_bar`` [unit/s per bar] damps
    vibrations of the load pressure.  Within ``stop_band`` [unit] a joint at rest is not corrected.
    ``velocity_filter_s`` filters the velocity where a PLC runs the law.
    """

    kind: str
    kp_1_s: float
    kd: float
    layer: float
    damping_per_bar: float
    stop_band: float
    velocity_filter_s: float


class Hydraulics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The pump: its flow at working speed [m^3/s]."""

    pump_flow_m3_s: float


class Sag(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lean of the column under the crane's weight, from a survey; `machine.geometry.sag` applies it to the pin.

    Lean of the empty crane [rad] = ``head_rad_m`` * r_head + ``pin_rad_m`` * r_pin - ``rest_rad``, and
    ``load_rad_nm`` per Nm of a load.  Moment of the empty crane at the lift joint [Nm] = ``head_nm_m`` *
    (r_head - a1) + ``pin_nm_m`` * (r_pin - a1).  The last three are 0 if no pressures were measured; loads are then
    unknown.
    """

    head_rad_m: float
    pin_rad_m: float
    rest_rad: float
    load_rad_nm: float = 0.0
    head_nm_m: float = 0.0
    pin_nm_m: float = 0.0


class Imu(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An inertial sensor on the grapple, and the damping of its swing (`controller.laws.sway`).

    ``node`` and ``message`` in ``crane.dbc`` as for an encoder.  The sensor is mounted above the rotator, on the part
    that swings on both hinges and does not turn, so that its axes are the crane's: radial lean and rate are positive
    outward, tangential ones to the left, as the slew turns.  ``gain`` [-] is twice the damping ratio that the pin's
    motion adds to a pendulum of ``pendulum_m`` [m], the length of a point pendulum of the grapple's period; damping
    moves the pin at ``pin_speed_m_s`` at most, and not at all within ``dead_zone_rad`` of swing.
    """

    node: int
    message: str
    gain: float
    pendulum_m: float
    pin_speed_m_s: float
    dead_zone_rad: float


class JointSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One actuated joint.  Positions in rad (m for ``prismatic``), speeds per s, accelerations per s^2."""

    kind: Literal["revolute", "prismatic"]
    lower: float
    upper: float
    speed_limit: float
    acceleration_limit: float
    encoder: Encoder | None
    valve: Valve
    law: Law


class JawTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Jaw geometry as a function of the jaw angle, 0 = fully open (docs/reference/machines.md section 1.5)."""

    angle_rad: tuple[float, ...]
    half_gap_m: tuple[float, ...]
    tip_below_pin_m: tuple[float, ...]


class Grapple(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grapple: geometry, open-loop times, the pressure that means closed, and whether its opening is measured."""

    close_time_s: float
    open_time_s: float
    hold_pressure_bar: float
    opening_sensor: bool
    jaws: JawTable = msgspec.field(name="tongs")


class Bunk(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The load bunk, a horizontal floor with stakes, in the base frame."""

    center_m: tuple[float, float]
    yaw_rad: float
    length_m: float
    width_m: float
    floor_z_m: float
    stake_height_m: float


class Workspace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The area to pick logs from and the height of the ground, in the base frame."""

    ground_z_m: float
    pick_center_m: tuple[float, float]
    pick_half_size_m: float


class KeepOut(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box that the boom tip keeps out of, turned about the vertical: middle and half edges, in the base frame."""

    center_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    yaw_rad: float = 0.0


class Stability(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the machine bears (`controller.crane.load`).

    The empty crane weighs like ``head_kg`` at the stick pin and ``pin_kg`` at the hanger pin.  It tips over a line
    ``edge_m`` from the slew axis when the moment about it exceeds ``stabilising_nm`` on level ground; every radian by
    which the ground falls under the boom takes ``slope_nm_rad``.  ``share`` of the moment may be used.  On a machine
    that is bolted down the line is the lift joint and the moment what the crane lifts.
    """

    head_kg: float
    pin_kg: float
    edge_m: float
    stabilising_nm: float
    slope_nm_rad: float
    share: float


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A stereo camera as mounted and calibrated (docs/reference/machines.md section 8): pinhole optics and depth range.

    ``position_m`` and ``rpy_rad`` (about the fixed axes x, then y, then z) place its body frame, x forward, y left,
    z up, in the frame of ``link``; a positive pitch looks down.  Its optical frame is x right, y down, z forward.
    ``fx_px`` .. ``cy_px`` are those of the rectified left picture of ``width_px`` by ``height_px``.  Divide its depth
    by ``depth_scale``, the result of a survey.
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
    """A valve of the carrier's own nodes: dead band on either side [%], speed at full command [unit/s], delay [s]."""

    deadband_plus_pct: float
    deadband_minus_pct: float
    full_speed_plus: float
    full_speed_minus: float
    delay_s: float


class Carrier(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An articulated four-wheel carrier on swing arms (docs/reference/machines.md section 7).

    Its geometry is in ``machine.geometry.carrier``.
    Frames ``rear`` and ``front`` share the articulation axis: origin on it, x forward, y left, z up, z = 0 at the
    pivots of the swing arms.  ``front_axle_m`` and ``rear_axle_m`` are their distances from the axis at the
    transport height.  A height is that of the frame above its lowest position; ``arm_drop_low_m`` is the drop of the
    wheel hub below its pivot there (negative: above it).  Beyond ``tilt_limit_rad`` of roll or pitch the machine does
    not drive.  Steering speeds are in rad/s, + bends left; swing-arm speeds in m/s of height, + lifts the frame.
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
    """A machine PLC on Ethernet in place of the nodes on crane0 (docs/reference/can-bus.md section 10).

    ``role``: the PLC closes the joint loops on the controller's references, or passes on its valve commands.
    ``sample_ms``: period in which it reads the encoders; the bridge adds no samples between.
    """

    role: Literal["references", "valves"]
    sample_ms: float = 10.0


class Timeouts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reaction times of the supervisor in ms; frame timeouts come from the DBC.

    ``operator_link_ms``: so long may an operator who watches be silent; 0: the link is not watched.
    """

    lease_max_ms: int
    stop_ramp_ms: int
    operator_link_ms: int = 1000


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A machine; ``carrier`` is None for a stationary machine, ``cameras`` and ``keep_out`` may be empty, ``plc``,
    ``sag``, ``imu`` and ``stability`` are None without one."""

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
    stability: Stability | None = None
    keep_out: dict[str, KeepOut] = {}


def joint(profile: Profile, which: Joint) -> JointSpec:
    """Return the specification of one joint."""
    return profile.joints[which.name.lower()]


def encoders(profile: Profile) -> dict[int, Encoder]:
    """Return every encoder of the machine by the number of its joint, ``ARTICULATION`` for the carrier's."""
    encoder_by_joint = {int(j): spec for j in JOINTS if (spec := joint(profile, j).encoder) is not None}
    if profile.carrier is not None:
        encoder_by_joint[ARTICULATION] = profile.carrier.articulation_encoder
    return encoder_by_joint


def joint_limits(profile: Profile) -> tuple[tuple[float, float], ...]:
    """Return (lower, upper) of every joint, indexed by ``Joint`` [rad, m for EXT]."""
    return tuple((spec.lower, spec.upper) for spec in (joint(profile, j) for j in JOINTS))


# -- How far a controller may go beyond the limits of the profile's joints that a planner keeps.

SPEED_HEADROOM_SHARE: Final = 1.25
"""Share of a joint's speed limit that a correction may use, so that a joint behind its reference can catch up."""
