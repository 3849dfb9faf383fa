"""Checks the values of a well-formed profile: units, ranges and consistency.

``problems_of`` returns every problem; an empty list means that the profile can be used.  The range of each single
number is in ``machine.loading.ranges``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import entry_points
from itertools import pairwise
from math import dist, hypot
from typing import Final

from machine.geometry.carrier import wheel_gap_m
from machine.geometry.kinematics import max_reach_m
from machine.joints import N_JOINTS, Joint
from machine.loading.ranges import ANGLE_RANGE, TURN_RAD, Range, check_range, out_of_range
from machine.loading.structure import Problem
from machine.profile import (
    JOINT_LAWS,
    OWN_LAWS,
    Camera,
    Carrier,
    CarrierValve,
    Encoder,
    Imu,
    JointSpec,
    Profile,
    Sag,
    Valve,
    encoders,
    joint,
)

MAX_GAIN_DELAY: Final = 0.5
"""Greatest product of gain and dead time of a velocity-type joint law; about 0.4 is the practical limit
(docs/reference/machines.md section 4).
"""
MAX_DEADBAND_PCT: Final = 50.0
FULL_SPEED_SHARE: Final = 2.0
"""A valve may let a joint be this many times faster than any speed limit; nobody opens it so far."""
MIN_ANTENNA_DISTANCE_M: Final = 0.3
"""Antennas closer together give no useful heading (docs/reference/machines.md section 8)."""
MAX_ARM_DROP_SHARE: Final = 0.9
"""Greatest drop of a wheel hub over the length of its arm; a steeper arm hardly lifts."""

MAX_KEEP_OUT: Final = 100
"""Boxes; a refusal names one in a byte."""
MAX_LEAN_RAD: Final = 0.06
"""Greatest lean of an empty crane: more than half a metre of sag at full reach."""

_ENCODER_MESSAGES: Final = {
    "EncSlew": "rotary",
    "EncLift": "rotary",
    "EncTilt": "rotary",
    "EncExt": "linear",
    "EncRot": "rotary",
}
_STEERING_MESSAGE: Final = "EncArtic"
_STEERING_ENCODER: Final = "carrier.articulation_encoder"
IMU_MESSAGE: Final = "GrappleImu"
_CRANE_LINKS: Final = ("base", "boom", "stick")
_CARRIER_LINKS: Final = ("front", "rear")
_VALVE_SIGNALS: Final = ("Slew", "Lift", "Tilt", "Ext", "Rot")
MIN_LINK_MS: Final = 500
"""Shortest limit of an operator's link: one of two heartbeats may be lost."""
_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")


def problems_of(profile: Profile) -> list[Problem]:
    """List every problem of the values of a profile."""
    problems = [*out_of_range(profile, ""), *_top_level_problems(profile)]
    for axis in Joint:
        problems += _joint_problems(axis, joint(profile, axis))
    problems += _duplicates(profile)
    problems += _grapple_problems(profile)
    for name, camera in profile.cameras.items():
        problems += _camera_problems(name, camera, profile.carrier is not None)
    if profile.carrier is not None:
        problems += _carrier_problems(profile, profile.carrier)
    if profile.imu is not None:
        problems += _imu_problems(profile, profile.imu)
    return problems or list(_geometry_problems(profile))


def _top_level_problems(profile: Profile) -> Iterator[Problem]:
    for key in ("name", "crane_bus", "machine_bus"):
        value = getattr(profile, key)
        if value is not None and not _NAME.fullmatch(value):
            yield _not_plain(key, value)
    if profile.machine_bus == profile.crane_bus:
        text = f'"{profile.machine_bus}" is also the crane bus; the two buses need different names'
        yield Problem("profile.same-bus", "machine_bus", text)
    if profile.rate_hz > 0 and 1_000_000 % profile.rate_hz:
        text = f"{profile.rate_hz} Hz is not a whole number of microseconds; use for example 100, 200 or 250"
        yield Problem("profile.rate-not-whole", "rate_hz", text)
    link_ms = profile.timeouts.operator_link_ms
    if 0 < link_ms < MIN_LINK_MS:
        text = f"{link_ms} ms is too short for heartbeats every 200 ms; use {MIN_LINK_MS}..1000, or 0 to watch no link"
        yield Problem("profile.link-limit-short", "timeouts.operator_link_ms", text)
    floor_z_m, ground_z_m = profile.bunk.floor_z_m, profile.workspace.ground_z_m
    if floor_z_m < ground_z_m:
        text = f"{floor_z_m} m is below the ground at {ground_z_m} m; a bunk floor is at or above it"
        yield Problem("profile.bunk-below-ground", "bunk.floor_z_m", text)
    if len(profile.keep_out) > MAX_KEEP_OUT:
        text = f"{len(profile.keep_out)} boxes are too many; at most {MAX_KEEP_OUT}"
        yield Problem("profile.keep-out-boxes", "keep_out", text)


def _not_plain(path: str, name: str) -> Problem:
    text = f'"{name}" is not a plain name; use a to z, 0 to 9 and _, starting with a letter'
    return Problem("profile.name-not-plain", path, text)


def _joint_problems(which: Joint, spec: JointSpec) -> Iterator[Problem]:
    path = f"joints.{which.name.lower()}"
    kind = "prismatic" if which is Joint.EXT else "revolute"
    if spec.kind != kind:
        yield Problem("profile.joint-kind", f"{path}.kind", f'"{spec.kind}" is not possible; this joint is {kind}')
        return
    unit, reach, fastest = ("m", (-1.0, 20.0, "m"), 2.0) if kind == "prismatic" else ("rad", ANGLE_RANGE, 3.5)
    speed: Range = (0.005, fastest, f"{unit}/s")
    yield from check_range(f"{path}.lower", spec.lower, reach)
    yield from check_range(f"{path}.upper", spec.upper, reach)
    if spec.lower >= spec.upper:
        text = f"{spec.lower} {unit} is not below upper = {spec.upper} {unit}"
        yield Problem("profile.limits-reversed", f"{path}.lower", text)
    yield from check_range(f"{path}.speed_limit", spec.speed_limit, speed)
    yield from check_range(f"{path}.acceleration_limit", spec.acceleration_limit, (0.01, 20.0, f"{unit}/s^2"))
    yield from check_range(f"{path}.law.stop_band", spec.law.stop_band, (1e-5, 0.05, unit))
    yield from check_range(f"{path}.law.layer", spec.law.layer, (1e-4, 0.5, unit))
    yield from _valve_problems(path, spec, speed)
    if spec.law.kind not in OWN_LAWS and not entry_points(group=JOINT_LAWS, name=spec.law.kind):
        foreign = sorted(point.name for point in entry_points(group=JOINT_LAWS))
        text = f'there is no joint law "{spec.law.kind}"; there are: {", ".join((*OWN_LAWS, *foreign))}'
        yield Problem("profile.law-unknown", f"{path}.law.kind", text)
    if spec.encoder is not None:
        messages = tuple(_ENCODER_MESSAGES)
        yield from _encoder_problems(f"{path}.encoder", kind, (spec.lower, spec.upper), spec.encoder, unit, messages)


def _valve_problems(path: str, spec: JointSpec, speed: Range) -> Iterator[Problem]:
    valve, law = spec.valve, spec.law
    if valve.signal not in _VALVE_SIGNALS:
        text = f'"{valve.signal}" is not a valve command; use one of {", ".join(_VALVE_SIGNALS)}'
        yield Problem("profile.valve-signal", f"{path}.valve.signal", text)
    full: Range = (speed[0], FULL_SPEED_SHARE * speed[1], speed[2])
    yield from _side_problems(f"{path}.valve", valve, "speed_limit", spec.speed_limit, full)
    if len(valve.lever) != len(valve.lever_at) or len(valve.lever) == 1:
        text = f"{len(valve.lever)} lever arms for {len(valve.lever_at)} positions; give one for each lever_at"
        yield Problem("profile.lever-length", f"{path}.valve.lever", text)
    if any(a >= b for a, b in pairwise(valve.lever_at)):
        yield Problem("profile.lever-order", f"{path}.valve.lever_at", "must rise from position to position")
    yield from _gain_problems(f"{path}.law.kp_1_s", law.kp_1_s, valve.delay_s)


def _side_problems(path: str, valve: Valve | CarrierValve, key: str, limit: float, speed: Range) -> Iterator[Problem]:
    """Check dead band and full speed of both sides of a valve whose function must reach ``limit`` (its ``key``)."""
    for side in ("plus", "minus"):
        deadband = getattr(valve, f"deadband_{side}_pct")
        if not 0.0 <= deadband < MAX_DEADBAND_PCT:
            text = f"{deadband} % is outside the range from 0 to below {MAX_DEADBAND_PCT:.0f} %"
            yield Problem("profile.deadband", f"{path}.deadband_{side}_pct", text)
        where, full = f"{path}.full_speed_{side}", getattr(valve, f"full_speed_{side}")
        yield from check_range(where, full, speed)
        if limit > full:
            text = f"{full} {speed[2]} is less than {key} = {limit}; the function cannot reach its limit"
            yield Problem("profile.full-speed-too-low", where, text)


def _gain_problems(path: str, gain_1_s: float, delay_s: float) -> Iterator[Problem]:
    if gain_1_s * delay_s > MAX_GAIN_DELAY:
        text = (
            f"{gain_1_s} 1/s with delay_s = {delay_s} oscillates "
            f"(gain times delay is {gain_1_s * delay_s:.2f}); at most {MAX_GAIN_DELAY / delay_s:.2f} 1/s"
        )
        yield Problem("profile.gain-too-high", path, text)


def _encoder_problems(
    path: str,
    joint_kind: str,
    limits: tuple[float, float],
    encoder: Encoder,
    unit: str,
    messages: tuple[str, ...],
) -> Iterator[Problem]:
    kind = "linear" if joint_kind == "prismatic" else "rotary"
    sent = _ENCODER_MESSAGES.get(encoder.message, "rotary")
    if encoder.message not in messages:
        text = f'"{encoder.message}" is not an encoder message; use one of {", ".join(messages)}'
        yield Problem("profile.encoder-message", f"{path}.message", text)
    elif sent != encoder.kind:
        text = f'"{encoder.message}" carries a {sent} position, but kind is "{encoder.kind}"'
        yield Problem("profile.encoder-message-kind", f"{path}.message", text)
    if encoder.kind != kind:
        text = f'"{encoder.kind}" on a {joint_kind} joint; the joint needs a {kind} encoder'
        yield Problem("profile.encoder-kind", f"{path}.kind", text)
    if encoder.device_type & 0xFFFF != 0x0196:
        text = f"{encoder.device_type:#010x} is not a CiA 406 encoder; the low half of object 1000h must be 0x0196"
        yield Problem("profile.encoder-device-type", f"{path}.device_type", text)
    yield from check_range(f"{path}.noise", encoder.noise, (1e-6, 0.05, unit))
    if encoder.kind == "rotary":
        if not 0 <= encoder.zero_counts < encoder.total_counts:
            text = f"{encoder.zero_counts} is outside 0..{encoder.total_counts - 1}"
            yield Problem("profile.encoder-zero", f"{path}.zero_counts", text)
        half = 0.5 * encoder.total_counts * encoder.unit_per_count
        if half <= max(map(abs, limits)) <= TURN_RAD:
            text = (
                f"{encoder.total_counts} counts of {encoder.unit_per_count:.6g} rad "
                f"wrap at +-{half:.4g} rad, inside the joint's limits {limits[0]}..{limits[1]} rad"
            )
            yield Problem("profile.encoder-wraps", f"{path}.total_counts", text)
    elif encoder.total_counts * encoder.unit_per_count < limits[1] - limits[0]:
        text = (
            f"{encoder.total_counts} counts of {encoder.unit_per_count:.6g} m are "
            f"shorter than the joint's range {limits[0]}..{limits[1]} m"
        )
        yield Problem("profile.encoder-too-short", f"{path}.total_counts", text)


def _duplicates(profile: Profile) -> Iterator[Problem]:
    user_names: dict[tuple[str, object], str] = {}
    for axis in Joint:
        name, spec = axis.name.lower(), joint(profile, axis)
        used: list[tuple[str, object]] = [("valve.signal", spec.valve.signal)]
        if spec.encoder is not None:
            used += [("encoder.node", spec.encoder.node), ("encoder.message", spec.encoder.message)]
        for key, value in used:
            other = user_names.setdefault((key, value), name)
            if other != name:
                yield _used_twice(f"joints.{name}.{key}", value, f"joints.{other}.{key}", "each joint")
    node = None if profile.carrier is None else profile.carrier.articulation_encoder.node
    if ("encoder.node", node) in user_names:
        other = user_names["encoder.node", node]
        yield _used_twice(f"{_STEERING_ENCODER}.node", node, f"joints.{other}.encoder.node", "each encoder")


def _used_twice(path: str, value: object, other: str, who: str) -> Problem:
    return Problem("profile.used-twice", path, f"{value} is already used by {other}; {who} needs its own")


def _imu_problems(profile: Profile, imu: Imu) -> Iterator[Problem]:
    if imu.message != IMU_MESSAGE:
        text = f'"{imu.message}" is not the message of a sensor on the grapple; use {IMU_MESSAGE}'
        yield Problem("profile.imu-message", "imu.message", text)
    for number, encoder in encoders(profile).items():
        if encoder.node == imu.node:
            where = f"joints.{Joint(number).name.lower()}.encoder" if number < N_JOINTS else _STEERING_ENCODER
            yield _used_twice("imu.node", imu.node, f"{where}.node", "the sensor")


def _grapple_problems(profile: Profile) -> Iterator[Problem]:
    jaws, path = profile.grapple.jaws, "grapple.tongs"
    rows = len(jaws.angle_rad)
    for key in ("half_gap_m", "tip_below_pin_m"):
        given = len(getattr(jaws, key))
        if given != rows:
            text = f"{given} values for {rows} angles; give one for each angle_rad"
            yield Problem("profile.jaw-table-length", f"{path}.{key}", text)
    if rows < 2 or jaws.angle_rad[0] != 0.0:
        text = "needs at least two angles, starting with 0.0 (fully open)"
        yield Problem("profile.jaw-table-start", f"{path}.angle_rad", text)
    if any(a >= b for a, b in pairwise(jaws.angle_rad)):
        yield Problem("profile.jaw-table-order", f"{path}.angle_rad", "must rise from row to row")
    if any(a <= b for a, b in pairwise(jaws.half_gap_m)):
        text = "must fall from row to row (angle 0 is fully open)"
        yield Problem("profile.jaw-table-order", f"{path}.half_gap_m", text)


def _camera_problems(name: str, camera: Camera, drives: bool) -> Iterator[Problem]:
    path = f"cameras.{name}"
    if not _NAME.fullmatch(name):
        yield _not_plain(path, name)
    if not camera.model.strip():
        yield Problem("profile.camera-model", f"{path}.model", "is empty; write the maker's name of the camera")
    links = (*_CRANE_LINKS, *(_CARRIER_LINKS if drives else ()))
    if camera.link not in links:
        text = f'"{camera.link}" is not a link of this machine; use one of {", ".join(links)}'
        yield Problem("profile.camera-link", f"{path}.link", text)
    for key, value, size in (("cx_px", camera.cx_px, camera.width_px), ("cy_px", camera.cy_px, camera.height_px)):
        if not 0.0 <= value <= size:
            text = f"{value:.6g} px is outside the picture, 0..{size} px"
            yield Problem("profile.camera-center", f"{path}.{key}", text)
    if camera.depth_min_m >= camera.depth_max_m:
        text = f"{camera.depth_min_m} m is not below depth_max_m = {camera.depth_max_m} m"
        yield Problem("profile.camera-depths", f"{path}.depth_min_m", text)


def _carrier_problems(profile: Profile, carrier: Carrier) -> Iterator[Problem]:
    path = "carrier"
    if profile.machine_bus is None:
        text = "missing; a machine with a carrier drives over its machine bus"
        yield Problem("profile.machine-bus-missing", "machine_bus", text)
    rate = carrier.articulation_rate_limit_rad_s
    speed: Range = (0.005, 3.5, "rad/s")
    yield from _side_problems(f"{path}.steer_valve", carrier.steer_valve, "articulation_rate_limit_rad_s", rate, speed)
    lift: Range = (0.005, 2.0, "m/s")
    rate = carrier.arm_rate_limit_m_s
    yield from _side_problems(f"{path}.arm_valve", carrier.arm_valve, "arm_rate_limit_m_s", rate, lift)
    yield from _gain_problems(f"{path}.arm_kp_1_s", carrier.arm_kp_1_s, carrier.arm_valve.delay_s)
    limit = carrier.articulation_limit_rad
    steer = carrier.articulation_encoder
    yield from _encoder_problems(_STEERING_ENCODER, "revolute", (-limit, limit), steer, "rad", (_STEERING_MESSAGE,))
    if carrier.cruise_speed_m_s > carrier.speed_limit_m_s:
        text = f"{carrier.cruise_speed_m_s} m/s is above speed_limit_m_s = {carrier.speed_limit_m_s} m/s"
        yield Problem("profile.cruise-speed", f"{path}.cruise_speed_m_s", text)
    apart = dist(carrier.antenna_main_m, carrier.antenna_aux_m)
    if not apart >= MIN_ANTENNA_DISTANCE_M:
        text = f"{apart:.2f} m from antenna_main_m gives no heading; at least {MIN_ANTENNA_DISTANCE_M} m apart"
        yield Problem("profile.antennas-too-close", f"{path}.antenna_aux_m", text)


def _suspension_problems(path: str, carrier: Carrier) -> Iterator[Problem]:
    """Check the geometry of swing arms and turning circle."""
    low, high = carrier.arm_drop_low_m, carrier.arm_drop_low_m + carrier.arm_travel_m
    most = MAX_ARM_DROP_SHARE * carrier.arm_length_m
    if max(abs(low), abs(high)) > most:
        text = (
            f"the hub would be {low:.2f}..{high:.2f} m below its pivot; an arm of "
            f"{carrier.arm_length_m:.2f} m reaches {-most:.2f}..{most:.2f} m"
        )
        yield Problem("profile.arm-travel", f"{path}.arm_travel_m", text)
        return
    if carrier.arm_transport_m > carrier.arm_travel_m:
        text = f"{carrier.arm_transport_m} m is above the travel of arm_travel_m = {carrier.arm_travel_m} m"
        yield Problem("profile.arm-transport", f"{path}.arm_transport_m", text)
    if carrier.wheel_width_m >= carrier.track_width_m:
        text = f"wheels {carrier.wheel_width_m} m wide overlap at track_width_m = {carrier.track_width_m} m"
        yield Problem("profile.wheel-width", f"{path}.wheel_width_m", text)
    gap = wheel_gap_m(carrier, carrier.articulation_limit_rad)
    if not gap > 0.0:
        text = (
            f"at {carrier.articulation_limit_rad} rad the inner wheels overlap by {-gap:.2f} m; "
            "reduce the angle or set the axles farther apart"
        )
        yield Problem("profile.wheels-overlap", f"{path}.articulation_limit_rad", text)


def _sag_problems(profile: Profile, sag: Sag) -> Iterator[Problem]:
    """Check that the compliant column is still a column at the farthest reach of the boom."""
    kin = profile.kinematics
    head, pin = kin.a1_m + kin.a2_m, max_reach_m(profile)
    lean = sag.head_rad_m * head + sag.pin_rad_m * pin - sag.rest_rad
    if not abs(lean) <= MAX_LEAN_RAD:
        text = (
            f"with head_rad_m and rest_rad the empty crane would lean {lean:.3f} rad at full reach; "
            f"at most {MAX_LEAN_RAD} rad; repeat the survey"
        )
        yield Problem("profile.sag-lean", "sag.pin_rad_m", text)
    if (sag.head_nm_m > 0.0) != (sag.pin_nm_m > 0.0):
        text = "the moment of the empty crane needs head_nm_m and pin_nm_m; give both or neither"
        yield Problem("profile.sag-moment", "sag.head_nm_m", text)


def _geometry_problems(profile: Profile) -> Iterator[Problem]:
    """Check what follows from several numbers; only meaningful for an otherwise sound profile."""
    if profile.carrier is not None:
        yield from _suspension_problems("carrier", profile.carrier)
    if profile.sag is not None:
        yield from _sag_problems(profile, profile.sag)
    yield from _reach_problems(profile)


def _reach_problems(profile: Profile) -> Iterator[Problem]:
    """Check that the arm reaches its work places."""
    reach = max_reach_m(profile)
    centers_m = {
        "bunk.center_m": profile.bunk.center_m,
        "workspace.pick_center_m": profile.workspace.pick_center_m,
    }
    for key, center_m in centers_m.items():
        if hypot(*center_m) > reach:
            text = f"{hypot(*center_m):.2f} m from the slew axis; the crane reaches {reach:.2f} m"
            yield Problem("profile.out-of-reach", key, text)
