"""What a well-formed profile must satisfy to be a machine: units, ranges and consistency.

``problems_of`` returns one sentence per problem, each starting with the key path; an empty list is a usable
profile. The ranges are generous physical bounds of road-going loader and forwarder cranes, so that they catch
a wrong unit or a slipped digit and never a real machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from math import hypot, pi, radians
from typing import Any, Final

import msgspec

from machine.joints import Joint
from machine.kinematics import max_reach_m
from machine.profile import (
    Bunk,
    Encoder,
    Grapple,
    JointSpec,
    Kinematics,
    Law,
    Profile,
    Timeouts,
    TongTable,
    Valve,
    Workspace,
    joint,
)

KP_DELAY_BOUND: Final = 0.5
"""Greatest gain times dead time of a velocity-type joint law (machines.md 4: about 0.4 is the practical
bound).
"""
DEADBAND_BOUND_PCT: Final = 50.0
TURN_RAD: Final = 2.0 * pi

_ENCODER_MESSAGES: Final = {
    "EncSlew": "rotary",
    "EncLift": "rotary",
    "EncTilt": "rotary",
    "EncExt": "linear",
    "EncRot": "rotary",
}
_VALVE_SIGNALS: Final = ("Slew", "Lift", "Tilt", "Ext", "Rot")
_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")

_Bounds = tuple[float, float, str]
_LENGTH: Final[_Bounds] = (0.3, 15.0, "m")
_OFFSET: Final[_Bounds] = (-2.0, 2.0, "m")
_ANGLE: Final[_Bounds] = (-TURN_RAD, TURN_RAD, "rad")
_PLACE: Final[_Bounds] = (-20.0, 20.0, "m")
_HEIGHT: Final[_Bounds] = (-5.0, 5.0, "m")

_BOUNDS: Final[dict[type[msgspec.Struct], dict[str, _Bounds]]] = {
    Profile: {"rate_hz": (50, 1000, "Hz")},
    Kinematics: {
        "d1_m": (0.0, 10.0, "m"),
        "a1_m": _OFFSET,
        "theta1_offset_rad": _ANGLE,
        "a2_m": _LENGTH,
        "theta2_offset_rad": _ANGLE,
        "a3_m": _OFFSET,
        "theta3_offset_rad": _ANGLE,
        "d4_m": _LENGTH,
        "hanger_to_fork_m": (0.0, 2.0, "m"),
        "fork_to_rotator_m": (0.0, 2.0, "m"),
        "rotator_to_tong_pivot_m": (0.0, 2.0, "m"),
    },
    Encoder: {
        "node": (1, 127, ""),
        "device_type": (0, 2**32 - 1, ""),
        "total_counts": (2, 2**32, "counts"),
        "unit_per_count": (1e-9, 0.1, "per count"),
        "zero_counts": (-(2**31), 2**32 - 1, "counts"),
    },
    Valve: {"delay_s": (0.0, 0.5, "s")},
    Law: {"kp_1_s": (0.05, 50.0, "1/s"), "kd": (0.0, 1.0, ""), "velocity_filter_s": (0.001, 0.5, "s")},
    Grapple: {
        "close_time_s": (0.2, 20.0, "s"),
        "open_time_s": (0.2, 20.0, "s"),
        "hold_pressure_bar": (10.0, 350.0, "bar"),
    },
    TongTable: {
        "angle_rad": (0.0, TURN_RAD, "rad"),
        "half_gap_m": _OFFSET,
        "tip_below_pin_m": (0.0, 3.0, "m"),
    },
    Bunk: {
        "center_m": _PLACE,
        "yaw_rad": _ANGLE,
        "length_m": (0.5, 15.0, "m"),
        "width_m": (0.3, 5.0, "m"),
        "floor_z_m": _HEIGHT,
        "stake_height_m": (0.0, 4.0, "m"),
    },
    Workspace: {"ground_z_m": _HEIGHT, "pick_center_m": _PLACE, "pick_half_size_m": (0.1, 10.0, "m")},
    Timeouts: {
        "lease_max_ms": (20, 500, "ms"),
        "stop_ramp_ms": (10, 300, "ms"),
    },
}
_SLIPS: Final = {
    "m": (1e-3, "mm"),
    "rad": (radians(1.0), "deg"),
    "s": (1e-3, "ms"),
    "m/s": (1e-3, "mm/s"),
    "rad/s": (radians(1.0), "deg/s"),
    "m/s^2": (1e-3, "mm/s^2"),
    "rad/s^2": (radians(1.0), "deg/s^2"),
    "bar": (1e-5, "Pa"),
    "Hz": (1e9, "s per tick in ns"),
}


def problems_of(profile: Profile) -> list[str]:
    """Every problem of a profile, each as ``key path: what is wrong; what is allowed``."""
    problems = [*_walk(profile, ""), *_whole(profile)]
    for which in Joint:
        problems += _joint_problems(which, joint(profile, which))
    problems += _duplicates(profile)
    problems += _grapple_problems(profile)
    return problems or list(_reach_problems(profile))


def _walk(struct: msgspec.Struct, path: str) -> Iterator[str]:
    """The table of bounds over a whole profile."""
    bounds = _BOUNDS.get(type(struct), {})
    for name in struct.__struct_fields__:
        value: Any = getattr(struct, name)
        where = f"{path}{name}"
        if isinstance(value, msgspec.Struct):
            yield from _walk(value, f"{where}.")
        elif isinstance(value, dict):
            for key, item in value.items():
                yield from _walk(item, f"{where}.{key}.")
        elif name in bounds:
            yield from _bounded_all(where, value, bounds[name])


def _bounded_all(path: str, value: Any, bounds: _Bounds) -> Iterator[str]:
    if isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from _bounded(f"{path}[{i}]", item, bounds)
    else:
        yield from _bounded(path, value, bounds)


def _bounded(path: str, value: float, bounds: _Bounds) -> Iterator[str]:
    low, high, unit = bounds
    if low <= value <= high:
        return
    factor, slip = _SLIPS.get(unit, (0.0, ""))
    hint = f"; was it given in {slip}?" if factor and low <= value * factor <= high else ""
    unit = f" {unit}" if unit else ""
    yield f"{path}: {value:.6g}{unit} is outside {low:.6g}..{high:.6g}{unit}{hint}"


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
    unit, reach, fastest = ("m", (-1.0, 20.0, "m"), 2.0) if kind == "prismatic" else ("rad", _ANGLE, 3.5)
    speed: _Bounds = (0.005, fastest, f"{unit}/s")
    yield from _bounded(f"{path}.lower", spec.lower, reach)
    yield from _bounded(f"{path}.upper", spec.upper, reach)
    if spec.lower >= spec.upper:
        yield f"{path}.lower: {spec.lower} {unit} is not below upper = {spec.upper} {unit}"
    yield from _bounded(f"{path}.speed_limit", spec.speed_limit, speed)
    yield from _bounded(f"{path}.acceleration_limit", spec.acceleration_limit, (0.01, 20.0, f"{unit}/s^2"))
    yield from _bounded(f"{path}.law.stop_band", spec.law.stop_band, (1e-5, 0.05, unit))
    yield from _valve_problems(path, spec, speed)
    if spec.encoder is not None:
        yield from _encoder_problems(path, spec, spec.encoder, unit)


def _valve_problems(path: str, spec: JointSpec, speed: _Bounds) -> Iterator[str]:
    valve, law = spec.valve, spec.law
    if valve.signal not in _VALVE_SIGNALS:
        allowed = ", ".join(_VALVE_SIGNALS)
        yield f'{path}.valve.signal: "{valve.signal}" is no valve command; use one of {allowed}'
    for side in ("plus", "minus"):
        deadband = getattr(valve, f"deadband_{side}_pct")
        if not 0.0 <= deadband < DEADBAND_BOUND_PCT:
            yield (
                f"{path}.valve.deadband_{side}_pct: {deadband} % is outside the range from 0 to below "
                f"{DEADBAND_BOUND_PCT:.0f} %"
            )
        key, full = f"{path}.valve.full_speed_{side}", getattr(valve, f"full_speed_{side}")
        yield from _bounded(key, full, speed)
        if spec.speed_limit > full:
            yield f"{key}: {full} {speed[2]} is less than speed_limit = {spec.speed_limit}; it cannot follow"
    gain_delay = law.kp_1_s * valve.delay_s
    if gain_delay > KP_DELAY_BOUND:
        yield (
            f"{path}.law.kp_1_s: {law.kp_1_s} 1/s with delay_s = {valve.delay_s} oscillates "
            f"(gain times delay {gain_delay:.2f}); at most {KP_DELAY_BOUND / valve.delay_s:.2f} 1/s"
        )


def _encoder_problems(path: str, spec: JointSpec, encoder: Encoder, unit: str) -> Iterator[str]:
    path += ".encoder"
    kind = "linear" if spec.kind == "prismatic" else "rotary"
    sent = _ENCODER_MESSAGES.get(encoder.message)
    if sent is None:
        allowed = ", ".join(_ENCODER_MESSAGES)
        yield f'{path}.message: "{encoder.message}" is no encoder message; use one of {allowed}'
    elif sent != encoder.kind:
        yield f'{path}.message: "{encoder.message}" carries a {sent} position but kind is "{encoder.kind}"'
    if encoder.kind != kind:
        yield f'{path}.kind: "{encoder.kind}" on a {spec.kind} joint; it needs a {kind} encoder'
    if encoder.device_type & 0xFFFF != 0x0196:
        yield (
            f"{path}.device_type: {encoder.device_type:#010x} is no CiA 406 encoder; "
            "the low half of object 1000h must be 0x0196"
        )
    yield from _bounded(f"{path}.noise", encoder.noise, (0.0, 0.05, unit))
    if encoder.kind == "rotary":
        if not 0 <= encoder.zero_counts < encoder.total_counts:
            yield f"{path}.zero_counts: {encoder.zero_counts} is outside 0..{encoder.total_counts - 1}"
        half = 0.5 * encoder.total_counts * encoder.unit_per_count
        if half <= max(abs(spec.lower), abs(spec.upper)) <= TURN_RAD:
            yield (
                f"{path}.total_counts: {encoder.total_counts} counts of {encoder.unit_per_count:.6g} rad "
                f"wrap at +-{half:.4g} rad, inside the joint's limits {spec.lower}..{spec.upper} rad"
            )
    elif encoder.total_counts * encoder.unit_per_count < spec.upper - spec.lower:
        yield (
            f"{path}.total_counts: {encoder.total_counts} counts of {encoder.unit_per_count:.6g} m are "
            f"shorter than the joint's range {spec.lower}..{spec.upper} m"
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
