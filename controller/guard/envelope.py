"""Limits of a machine, read from the profile (TOML) by the guard itself.

Output: one `Axis` per joint with its command signal, its encoder and its limits, in the units of the profile, and the
period of the commands.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Final, NamedTuple

from controller.guard.layout import GuardConfigError

JOINT_NAMES: Final = ("slew", "lift", "tilt", "ext", "rot")
RATE_FACTOR: Final = 6.0
"""A command may change this many times faster than the acceleration limit; the controller stays below (4)."""


class Axis(NamedTuple):
    """One joint: command, encoder (message name empty without one) and limits [rad or m; % and %/s]."""

    number: int
    signal: str
    sign: int
    deadband_pct: float
    rate_pct_s: float
    lower: float
    upper: float
    message: str
    total_counts: int
    zero_counts: int
    unit: float


def read_envelope(path: Path) -> tuple[tuple[Axis, ...], int]:
    """Read the axes and the period of the commands [ns] of a profile file; raises GuardConfigError."""
    try:
        profile = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise GuardConfigError("guard.profile-unreadable", f"{path}: unreadable profile: {error}.") from error
    try:
        axes = tuple(_axis(i, profile["joints"][name]) for i, name in enumerate(JOINT_NAMES))
        return axes, 1_000_000_000 // int(profile["rate_hz"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise GuardConfigError(
            "guard.profile-incomplete", f"{path}: a joint or the rate is incomplete: {error!r}."
        ) from error


def _axis(number: int, joint: dict[str, Any]) -> Axis:
    valve, encoder = joint["valve"], joint.get("encoder")
    slowest = min(valve["full_speed_plus"], valve["full_speed_minus"])
    linear = encoder is not None and encoder["kind"] == "linear"
    return Axis(
        number=number,
        signal=str(valve["signal"]),
        sign=int(valve["sign"]),
        deadband_pct=float(min(valve["deadband_plus_pct"], valve["deadband_minus_pct"])),
        rate_pct_s=100.0 * RATE_FACTOR * float(joint["acceleration_limit"]) / float(slowest),
        lower=float(joint["lower"]),
        upper=float(joint["upper"]),
        message=str(encoder["message"]) if encoder else "",
        total_counts=0 if encoder is None or linear else int(encoder["total_counts"]),
        zero_counts=int(encoder["zero_counts"]) if encoder else 0,
        unit=float(encoder["unit_per_count"]) * int(encoder["direction"]) if encoder else 0.0,
    )
