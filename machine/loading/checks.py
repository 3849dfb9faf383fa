"""What a well-formed profile must satisfy to be a machine: units, ranges and consistency.

``problems_of`` returns one sentence per problem, each starting with the key path; an empty list is a usable
profile.  The range of each number alone is in ``machine.loading.ranges``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from math import dist, hypot
from typing import Final

from machine.geometry.carrier import wheel_gap_m
from machine.geometry.kinematics import max_reach_m
from machine.joints import N_JOINTS, Joint
from machine.loading.ranges import ANGLE, TURN_RAD, Bounds, bounded, out_of_range
from machine.profile import (
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

KP_DELAY_BOUND: Final = 0.5
"""Greatest gain times dead time of a velocity-type joint law (docs/reference/machines.md section 4: about 0.4 is the practical
bound).
"""
DEADBAND_BOUND_PCT: Final = 50.0
ANTENNAS_APART_M: Final = 0.3
"""Least distance of the two antennas: nearer, the heading is worth nothing (docs/reference/machines.md section 8)."""
ARM_STEEPEST: Final = 0.9
"""Greatest drop of a wheel hub over the length of its arm: a steeper arm hardly lifts."""

LEAN_BOUND_RAD: Final = 0.06
"""Greatest lean of an empty crane: over half a metre of sag at full reach."""

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
_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")


def problems_of(profile: Profile) -> list[str]:
    """Every problem of a profile, each as ``key path: what is wrong; what is allowed``."""
    problems = [*out_of_range(profile, ""), *_whole(profile)]
    for which in Joint:
        problems += _joint_problems(which, joint(profile, which))
    problems += _duplicates(profile)
    problems += _grapple_problems(profile)
    for name, camera in profile.cameras.items():
        problems += _camera_problems(name, camera, profile.carrier is not None)
    if profile.carrier is not None:
        problems += _carrier_problems(profile, profile.carrier)
    if profile.imu is not None:
        problems += _imu_problems(profile, profile.imu)
    if profile.sag is not None:
        problems += _sag_problems(profile, profile.sag)
    return problems or list(_reach_problems(profile))


def _whole(profile: Profile) -> Iterator[str]:
    for key in ("name", "crane_bus", "machine_bus"):
        value = getattr(profile, key)
        if value is not None and not _NAME.fullmatch(value):
            yield f'{key}: "{value}" is not a plain name; use a to z, 0 to 9 and _, a letter first'
    if profile.machine_bus == profile.crane_bus:
        yield f'machine_bus: "{profile.machine_bus}" is the crane bus; the two buses need different names'
    if profile.rate_hz > 0 and 1_000_000 % profile.rate_hz:
        yield f"rate_hz: {profile.rate_hz} Hz gives no whole microseconds; use for example 100, 200 or 250"
    if profile.bunk.floor_z_m < profile.workspace.ground_z_m:
        yield (
            f"bunk.floor_z_m: {profile.bunk.floor_z_m} m is below the ground at "
            f"{profile.workspace.ground_z_m} m; a bunk floor is at or above it"
        )


def _joint_problems(which: Joint, spec: JointSpec) -> Iterator[str]:
    path = f"joints.{which.name.lower()}"
    kind = "prismatic" if which is Joint.EXT else "revolute"
    if spec.kind != kind:
        yield f'{path}.kind: "{spec.kind}" cannot be; this joint is {kind}'
        return
    unit, reach, fastest = ("m", (-1.0, 20.0, "m"), 2.0) if kind == "prismatic" else ("rad", ANGLE, 3.5)
    speed: Bounds = (0.005, fastest, f"{unit}/s")
    yield from bounded(f"{path}.lower", spec.lower, reach)
    yield from bounded(f"{path}.upper", spec.upper, reach)
    if spec.lower >= spec.upper:
        yield f"{path}.lower: {spec.lower} {unit} is not below upper = {spec.upper} {unit}"
    yield from bounded(f"{path}.speed_limit", spec.speed_limit, speed)
    yield from bounded(f"{path}.acceleration_limit", spec.acceleration_limit, (0.01, 20.0, f"{unit}/s^2"))
    yield from bounded(f"{path}.law.stop_band", spec.law.stop_band, (1e-5, 0.05, unit))
    yield from bounded(f"{path}.law.layer", spec.law.layer, (1e-4, 0.5, unit))
    yield from _valve_problems(path, spec, speed)
    if spec.encoder is not None:
        messages = tuple(_ENCODER_MESSAGES)
        yield from _encoder_problems(f"{path}.encoder", kind, (spec.lower, spec.upper), spec.encoder, unit, messages)


def _valve_problems(path: str, spec: JointSpec, speed: Bounds) -> Iterator[str]:
    valve, law = spec.valve, spec.law
    if valve.signal not in _VALVE_SIGNALS:
        allowed = ", ".join(_VALVE_SIGNALS)
        yield f'{path}.valve.signal: "{valve.signal}" is no valve command; use one of {allowed}'
    yield from _side_problems(f"{path}.valve", valve, "speed_limit", spec.speed_limit, speed)
    if len(valve.lever) != len(valve.lever_at) or len(valve.lever) == 1:
        yield f"{path}.valve.lever: {len(valve.lever)} arms for {len(valve.lever_at)} positions; one for each lever_at"
    if any(a >= b for a, b in pairwise(valve.lever_at)):
        yield f"{path}.valve.lever_at: must rise from position to position"
    yield from _gain_problems(f"{path}.law.kp_1_s", law.kp_1_s, valve.delay_s)


def _side_problems(path: str, valve: Valve | CarrierValve, key: str, limit: float, speed: Bounds) -> Iterator[str]:
    """Dead-band and full speed of both sides of a valve whose function is asked for ``limit`` (its ``key``)."""
    for side in ("plus", "minus"):
        deadband = getattr(valve, f"deadband_{side}_pct")
        if not 0.0 <= deadband < DEADBAND_BOUND_PCT:
            yield (
                f"{path}.deadband_{side}_pct: {deadband} % is outside the range from 0 to below "
                f"{DEADBAND_BOUND_PCT:.0f} %"
            )
        where, full = f"{path}.full_speed_{side}", getattr(valve, f"full_speed_{side}")
        yield from bounded(where, full, speed)
        if limit > full:
            yield f"{where}: {full} {speed[2]} is less than {key} = {limit}; it cannot follow"


def _gain_problems(path: str, gain_1_s: float, delay_s: float) -> Iterator[str]:
    if gain_1_s * delay_s > KP_DELAY_BOUND:
        yield (
            f"{path}: {gain_1_s} 1/s with delay_s = {delay_s} oscillates "
            f"(gain times delay {gain_1_s * delay_s:.2f}); at most {KP_DELAY_BOUND / delay_s:.2f} 1/s"
        )


def _encoder_problems(
    path: str,
    joint_kind: str,
    limits: tuple[float, float],
    encoder: Encoder,
    unit: str,
    messages: tuple[str, ...],
) -> Iterator[str]:
    kind = "linear" if joint_kind == "prismatic" else "rotary"
    sent = _ENCODER_MESSAGES.get(encoder.message, "rotary")
    if encoder.message not in messages:
        yield f'{path}.message: "{encoder.message}" is no encoder message; use one of {", ".join(messages)}'
    elif sent != encoder.kind:
        yield f'{path}.message: "{encoder.message}" carries a {sent} position but kind is "{encoder.kind}"'
    if encoder.kind != kind:
        yield f'{path}.kind: "{encoder.kind}" on a {joint_kind} joint; it needs a {kind} encoder'
    if encoder.device_type & 0xFFFF != 0x0196:
        yield (
            f"{path}.device_type: {encoder.device_type:#010x} is no CiA 406 encoder; "
            "the low half of object 1000h must be 0x0196"
        )
    yield from bounded(f"{path}.noise", encoder.noise, (0.0, 0.05, unit))
    if encoder.kind == "rotary":
        if not 0 <= encoder.zero_counts < encoder.total_counts:
            yield f"{path}.zero_counts: {encoder.zero_counts} is outside 0..{encoder.total_counts - 1}"
        half = 0.5 * encoder.total_counts * encoder.unit_per_count
        if half <= max(map(abs, limits)) <= TURN_RAD:
            yield (
                f"{path}.total_counts: {encoder.total_counts} counts of {encoder.unit_per_count:.6g} rad "
                f"wrap at +-{half:.4g} rad, inside the joint's limits {limits[0]}..{limits[1]} rad"
            )
    elif encoder.total_counts * encoder.unit_per_count < limits[1] - limits[0]:
        yield (
            f"{path}.total_counts: {encoder.total_counts} counts of {encoder.unit_per_count:.6g} m are "
            f"shorter than the joint's range {limits[0]}..{limits[1]} m"
        )


def _duplicates(profile: Profile) -> Iterator[str]:
    seen: dict[tuple[str, object], str] = {}
    for which in Joint:
        name, spec = which.name.lower(), joint(profile, which)
        used: list[tuple[str, object]] = [("valve.signal", spec.valve.signal)]
        if spec.encoder is not None:
            used += [("encoder.node", spec.encoder.node), ("encoder.message", spec.encoder.message)]
        for key, value in used:
            other = seen.setdefault((key, value), name)
            if other != name:
                yield (
                    f"joints.{name}.{key}: {value} is already used by joints.{other}.{key}; each joint needs its own"
                )
    node = None if profile.carrier is None else profile.carrier.articulation_encoder.node
    if ("encoder.node", node) in seen:
        other = seen["encoder.node", node]
        yield (
            f"carrier.articulation_encoder.node: {node} is already used by joints.{other}.encoder.node; "
            "each encoder needs its own"
        )


def _imu_problems(profile: Profile, imu: Imu) -> Iterator[str]:
    if imu.message != IMU_MESSAGE:
        yield f'imu.message: "{imu.message}" is no message of a sensor on the grapple; use {IMU_MESSAGE}'
    for number, encoder in encoders(profile).items():
        if encoder.node == imu.node:
            where = f"joints.{Joint(number).name.lower()}.encoder" if number < N_JOINTS else _STEERING_ENCODER
            yield f"imu.node: {imu.node} is already used by {where}.node; the sensor needs its own"


def _grapple_problems(profile: Profile) -> Iterator[str]:
    tongs = profile.grapple.tongs
    rows = len(tongs.angle_rad)
    for key in ("half_gap_m", "tip_below_pin_m"):
        given = len(getattr(tongs, key))
        if given != rows:
            yield f"grapple.tongs.{key}: {given} values for {rows} angles; one for each angle_rad"
    if rows < 2 or tongs.angle_rad[0] != 0.0:
        yield "grapple.tongs.angle_rad: needs at least two angles, starting with 0.0 (fully open)"
    if any(a >= b for a, b in pairwise(tongs.angle_rad)):
        yield "grapple.tongs.angle_rad: must rise from row to row"
    if any(a <= b for a, b in pairwise(tongs.half_gap_m)):
        yield "grapple.tongs.half_gap_m: must fall from row to row (angle 0 is fully open)"


def _camera_problems(name: str, camera: Camera, drives: bool) -> Iterator[str]:
    path = f"cameras.{name}"
    if not _NAME.fullmatch(name):
        yield f'{path}: "{name}" is not a plain name; use a to z, 0 to 9 and _, a letter first'
    if not camera.model.strip():
        yield f"{path}.model: is empty; write the maker's name of the camera"
    links = (*_CRANE_LINKS, *(_CARRIER_LINKS if drives else ()))
    if camera.link not in links:
        yield f'{path}.link: "{camera.link}" is no link of this machine; use one of {", ".join(links)}'
    for key, value, size in (("cx_px", camera.cx_px, camera.width_px), ("cy_px", camera.cy_px, camera.height_px)):
        if not 0.0 <= value <= size:
            yield f"{path}.{key}: {value:.6g} px is outside the picture, 0..{size} px"
    if camera.depth_min_m >= camera.depth_max_m:
        yield f"{path}.depth_min_m: {camera.depth_min_m} m is not below depth_max_m = {camera.depth_max_m} m"


def _carrier_problems(profile: Profile, carrier: Carrier) -> Iterator[str]:
    path = "carrier"
    if profile.machine_bus is None:
        yield "machine_bus: missing; a machine with a carrier drives over its machine bus"
    rate = carrier.articulation_rate_limit_rad_s
    speed: Bounds = (0.005, 3.5, "rad/s")
    yield from _side_problems(f"{path}.steer_valve", carrier.steer_valve, "articulation_rate_limit_rad_s", rate, speed)
    lift: Bounds = (0.005, 2.0, "m/s")
    rate = carrier.arm_rate_limit_m_s
    yield from _side_problems(f"{path}.arm_valve", carrier.arm_valve, "arm_rate_limit_m_s", rate, lift)
    yield from _gain_problems(f"{path}.arm_kp_1_s", carrier.arm_kp_1_s, carrier.arm_valve.delay_s)
    limit = carrier.articulation_limit_rad
    steer = carrier.articulation_encoder
    where = f"{path}.articulation_encoder"
    yield from _encoder_problems(where, "revolute", (-limit, limit), steer, "rad", (_STEERING_MESSAGE,))
    if carrier.cruise_speed_m_s > carrier.speed_limit_m_s:
        yield (
            f"{path}.cruise_speed_m_s: {carrier.cruise_speed_m_s} m/s is above "
            f"speed_limit_m_s = {carrier.speed_limit_m_s} m/s"
        )
    apart = dist(carrier.antenna_main_m, carrier.antenna_aux_m)
    if not apart >= ANTENNAS_APART_M:
        yield (
            f"{path}.antenna_aux_m: {apart:.2f} m from antenna_main_m gives no heading; "
            f"at least {ANTENNAS_APART_M} m apart"
        )
    yield from _suspension_problems(path, carrier)


def _suspension_problems(path: str, carrier: Carrier) -> Iterator[str]:
    """Swing arms and the turning circle as geometry."""
    low, high = carrier.arm_drop_low_m, carrier.arm_drop_low_m + carrier.arm_travel_m
    most = ARM_STEEPEST * carrier.arm_length_m
    if max(abs(low), abs(high)) > most:
        yield (
            f"{path}.arm_travel_m: the hub would stand {low:.2f}..{high:.2f} m below its pivot; an arm of "
            f"{carrier.arm_length_m:.2f} m reaches {-most:.2f}..{most:.2f} m"
        )
        return
    if carrier.arm_transport_m > carrier.arm_travel_m:
        yield (
            f"{path}.arm_transport_m: {carrier.arm_transport_m} m is above the travel of "
            f"arm_travel_m = {carrier.arm_travel_m} m"
        )
    if carrier.wheel_width_m >= carrier.track_width_m:
        yield (
            f"{path}.wheel_width_m: wheels {carrier.wheel_width_m} m wide overlap at "
            f"track_width_m = {carrier.track_width_m} m"
        )
    gap = wheel_gap_m(carrier, carrier.articulation_limit_rad)
    if not gap > 0.0:
        yield (
            f"{path}.articulation_limit_rad: at {carrier.articulation_limit_rad} rad the inner wheels overlap by "
            f"{-gap:.2f} m; bend less or set the axles farther apart"
        )


def _sag_problems(profile: Profile, sag: Sag) -> Iterator[str]:
    """A column that gives way is still a column, at the farthest reach of the boom."""
    kin = profile.kinematics
    head, pin = kin.a1_m + kin.a2_m, max_reach_m(profile)
    lean = sag.head_rad_m * head + sag.pin_rad_m * pin - sag.rest_rad
    if not abs(lean) <= LEAN_BOUND_RAD:
        yield (
            f"sag.pin_rad_m: the empty crane would lean {lean:.3f} rad at full reach, with head_rad_m and rest_rad; "
            f"at most {LEAN_BOUND_RAD} rad; survey it anew"
        )
    if (sag.head_nm_m > 0.0) != (sag.pin_nm_m > 0.0):
        yield "sag.head_nm_m: the moment of the empty crane needs head_nm_m and pin_nm_m; give both or neither"


def _reach_problems(profile: Profile) -> Iterator[str]:
    """Places of work that the arm cannot span; asked only of an otherwise sound profile."""
    reach = max_reach_m(profile)
    places = {
        "bunk.center_m": profile.bunk.center_m,
        "workspace.pick_center_m": profile.workspace.pick_center_m,
    }
    for key, place in places.items():
        if hypot(*place) > reach:
            yield f"{key}: {hypot(*place):.2f} m from the slew axis; the crane reaches {reach:.2f} m"
