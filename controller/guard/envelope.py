"""Limits of a machine for the guard, from a file of its own that is sealed with a digest and that calibration leaves.

The envelope file has ranges, speeds, geometry and forbidden boxes.  From the profile the guard takes only what
calibration finds (dead-bands, full speeds and delays of the valves, zero counts of the encoders) and the names of the
signals.  A profile whose ranges or speeds exceed the envelope stops the start.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
import zlib
from pathlib import Path
from typing import Any, Final, NamedTuple

from controller.guard.layout import GuardConfigError

JOINT_NAMES: Final = ("slew", "lift", "tilt", "ext", "rot")
RATE_FACTOR: Final = 6.0
"""A command may change this many times faster than the acceleration limit; the controller stays below (4)."""
DELAY_FACTOR, LAGS = 1.5, 3.0
"""A spool has closed into its dead-band this many dead times and lags of the valve after its command ended."""
SEAL: Final = b"# sha256: "
"""The last line of an envelope file: this, and the digest of everything before it."""
SHIPPED: Final = Path(__file__).parents[2] / "machine"
RATES_HZ: Final = (50, 1000)
_VALVE: Final = {
    "deadband_plus_pct": (0.0, 49.99), "deadband_minus_pct": (0.0, 49.99), "full_speed_plus": (1e-3, 20.0),
    "full_speed_minus": (1e-3, 20.0), "delay_s": (0.0, 0.5), "lag_s": (0.0, 0.3),
}  # fmt: skip
_ENCODER: Final = {"total_counts": (2, 1 << 32), "zero_counts": (-(1 << 31), 1 << 32), "unit_per_count": (1e-9, 0.1)}
_LIMITS: Final = {
    "lower": (-20.0, 20.0),
    "upper": (-20.0, 20.0),
    "speed_limit": (1e-3, 10.0),
    "acceleration_limit": (0.01, 20.0),
}
"""What a number may be; the controller's bounds are as wide or narrower."""
Corner = tuple[float, float, float]


class Axis(NamedTuple):
    """One joint: command, valve, encoder (message name empty without one), limits [rad or m, per second; %, %/s].

    ``deadbands_pct`` and ``full_speeds`` are those of a command of a negative and of a positive sign.
    """

    number: int
    signal: str
    sign: int
    deadbands_pct: tuple[float, float]
    full_speeds: tuple[float, float]
    rate_pct_s: float
    closing_ns: int
    lower: float
    upper: float
    speed_limit: float
    message: str
    total_counts: int
    zero_counts: int
    unit: float


class Kinematics(NamedTuple):
    """The crane in its vertical plane [m, rad]: boom pin from the base; boom; telescope axis off the stick pin; stick
    at extension 0; the angles at which joint angles are zero."""

    boom_pin_z_m: float
    boom_pin_r_m: float
    plane_offset_rad: float
    boom_m: float
    boom_offset_rad: float
    telescope_offset_m: float
    stick_offset_rad: float
    stick_m: float


class CarrierLimits(NamedTuple):
    """Limits of the carrier [m/s, m/s^2, rad, rad/s]."""

    speed_limit_m_s: float
    drive_acceleration_m_s2: float
    articulation_limit_rad: float
    articulation_rate_limit_rad_s: float


class Envelope(NamedTuple):
    """What a machine may do; ``carrier`` is None on a fixed base, ``boxes`` are (lowest, highest) corners."""

    axes: tuple[Axis, ...]
    period_ns: int
    kinematics: Kinematics
    ground_m: float
    boxes: tuple[tuple[Corner, Corner], ...]
    carrier: CarrierLimits | None
    profile_check: int = 0
    """CRC of the profile's file; the controller compares it with its own (`controller.config.Settings`)."""


def digest(body: bytes) -> bytes:
    """Compute the digest of an envelope file without its last line."""
    return hashlib.sha256(body).hexdigest().encode()


def read_envelope(path: Path) -> Envelope:
    """Read a profile file and the envelope of its machine; raises GuardConfigError."""
    try:
        content = path.read_bytes()
        profile = tomllib.loads(content.decode())
    except (OSError, ValueError, RecursionError) as error:  # not UTF-8, no TOML, or a number of 5000 digits
        raise GuardConfigError("guard.profile-unreadable", f"{path}: unreadable profile: {error}.") from error
    try:
        limits = _sealed(_find(path, str(profile["name"])))
        _compare(path, profile, limits)
        axes = tuple(_axis(i, profile["joints"][n], _limits(limits["joints"][n])) for i, n in enumerate(JOINT_NAMES))
        messages = [axis.message for axis in axes if axis.message]
        if len(set(messages)) < len(messages):
            raise ValueError(f"two joints have one encoder: {', '.join(messages)}")
        boxes = tuple((_corner(box["low_m"]), _corner(box["high_m"])) for box in limits.get("boxes", ()))
        if any(not all(a < b for a, b in zip(*box, strict=True)) for box in boxes):
            raise ValueError("a box has its corners the wrong way round")
        carrier = (
            CarrierLimits(**_within(limits["carrier"], dict.fromkeys(CarrierLimits._fields, (1e-3, 10.0))))
            if "machine_bus" in profile
            else None
        )
        geometry, ground_m = Kinematics(**_numbers(limits["kinematics"])), _number(limits["ground_m"])
        rate_hz = int(_within(profile, {"rate_hz": RATES_HZ})["rate_hz"])
        return Envelope(
            axes, 1_000_000_000 // rate_hz, geometry, ground_m, boxes, carrier, zlib.crc32(content) & 0xFFFFFF
        )
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        raise GuardConfigError(
            "guard.profile-incomplete", f"{path} or its envelope: a joint or the rate is incomplete: {error!r}."
        ) from error


def _number(value: object) -> float:
    """Check a limit; a NaN would switch its rule off."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a finite number")
    return float(value)


def _numbers(table: dict[str, Any]) -> dict[str, float]:
    return {key: _number(value) for key, value in table.items()}


def _within(table: dict[str, Any], ranges: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Read the numbers of a table that ``ranges`` names; ValueError for one outside its range."""
    found = {key: _number(table[key]) for key in ranges}
    for key, (low, high) in ranges.items():
        if not low <= found[key] <= high:
            raise ValueError(f"{key} = {found[key]:g} is outside {low:g} to {high:g}")
    return found


def _limits(table: dict[str, Any]) -> dict[str, float]:
    limits = _within(table, _LIMITS)
    if limits["lower"] >= limits["upper"]:
        raise ValueError(f"lower = {limits['lower']:g} is not below upper = {limits['upper']:g}")
    return limits


def _corner(values: list[Any]) -> Corner:
    x, y, z = map(_number, values)
    return x, y, z


def _find(profile: Path, machine: str) -> Path:
    """Find the envelope beside the profile, else the shipped one of the machine."""
    beside = profile.with_name(f"{machine}.envelope.toml")
    return beside if beside.is_file() else SHIPPED / beside.name


def _sealed(path: Path) -> dict[str, Any]:
    try:
        body, _, seal = path.read_bytes().rpartition(SEAL)
    except OSError as error:
        raise GuardConfigError("guard.envelope-missing", f"{path}: no envelope: {error.strerror}.") from error
    if seal.strip() != digest(body):
        raise GuardConfigError(
            "guard.envelope-damaged",
            f"{path}: the digest does not match; check every limit, then run python -m controller.guard.seal {path}.",
        )
    return tomllib.loads(body.decode())


def _compare(path: Path, profile: dict[str, Any], limits: dict[str, Any]) -> None:
    """Refuse a profile that allows more than the envelope: every limit that is in both, by its name."""
    pairs = [(f"joints.{name}", profile["joints"][name], limits["joints"][name]) for name in JOINT_NAMES]
    if "machine_bus" in profile:
        pairs.append(("carrier", profile["carrier"], limits["carrier"]))
    for name in JOINT_NAMES:
        _limits(limits["joints"][name])
        _limits(profile["joints"][name])
    for place, mine, most in pairs:
        for key, limit in most.items():
            _number(mine[key])
            if mine[key] < limit if key == "lower" else mine[key] > limit:
                raise GuardConfigError(
                    "guard.profile-exceeds-envelope",
                    f"{path}: {place}.{key} is {mine[key]:g}, and the envelope allows {limit:g}; reduce it.",
                )


def _axis(number: int, joint: dict[str, Any], limits: dict[str, float]) -> Axis:
    valve, encoder = joint["valve"], joint.get("encoder")
    linear = encoder is not None and encoder["kind"] == "linear"
    sides = ("minus", "plus") if int(valve["sign"]) > 0 else ("plus", "minus")
    numbers, name = _within(valve, _VALVE), JOINT_NAMES[number].capitalize()
    deadbands = [numbers[f"deadband_{side}_pct"] for side in sides]
    fulls = [numbers[f"full_speed_{side}"] for side in sides]
    if valve["sign"] not in (-1, 1) or valve["signal"] != name:
        raise ValueError(f"the valve of {name} has the sign {valve['sign']!r} and the signal {valve['signal']!r}")
    if encoder is not None:
        _within(encoder, _ENCODER)
        if encoder["direction"] not in (-1, 1) or linear != (encoder["message"] == "EncExt"):
            raise ValueError(f"the encoder of {name} is {encoder['message']!r}, {encoder['direction']!r}")
    return Axis(
        number=number,
        signal=str(valve["signal"]),
        sign=int(valve["sign"]),
        deadbands_pct=(deadbands[0], deadbands[1]),
        full_speeds=(fulls[0], fulls[1]),
        rate_pct_s=100.0 * RATE_FACTOR * limits["acceleration_limit"] / min(fulls),
        closing_ns=int((DELAY_FACTOR * numbers["delay_s"] + LAGS * numbers["lag_s"]) * 1e9),
        lower=limits["lower"],
        upper=limits["upper"],
        speed_limit=limits["speed_limit"],
        message=str(encoder["message"]) if encoder else "",
        total_counts=0 if encoder is None or linear else int(encoder["total_counts"]),
        zero_counts=int(encoder["zero_counts"]) if encoder else 0,
        unit=float(encoder["unit_per_count"]) * int(encoder["direction"]) if encoder else 0.0,
    )
