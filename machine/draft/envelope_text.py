"""The guard's envelope of a machine as TOML, from its profile: a draft, which a person checks and seals."""

from __future__ import annotations

import math
from typing import Final

from machine.draft.toml_text import value_text
from machine.geometry.grapple import lowest_pin_m
from machine.joints import JOINTS
from machine.profile import KeepOut, Profile, joint

LIMITS: Final = ("lower", "upper", "speed_limit", "acceleration_limit")
COLUMN_HALF_M: Final = 0.45
"""Half the edge of the box around the column with its foot."""
UNDER_BOOM_PIN_M: Final = 0.15
BELOW_CONTROLLER_M: Final = 0.05
"""The guard stops a pin this much lower than where the controller refuses it."""


def envelope_kinematics(profile: Profile) -> dict[str, float]:
    """The geometry in the guard's own terms, by key [m, rad]."""
    kin = profile.kinematics
    return {
        "boom_pin_z_m": kin.d1_m,
        "boom_pin_r_m": kin.a1_m,
        "plane_offset_rad": kin.theta1_offset_rad,
        "boom_m": kin.a2_m,
        "boom_offset_rad": kin.theta2_offset_rad,
        "telescope_offset_m": kin.a3_m,
        "stick_offset_rad": kin.theta3_offset_rad,
        "stick_m": kin.d4_m,
    }


def envelope_text(profile: Profile) -> str:
    """The envelope without its last line."""
    ground, kin = profile.workspace.ground_z_m, profile.kinematics
    hang_m = kin.hanger_to_fork_m + kin.fork_to_rotator_m - BELOW_CONTROLLER_M
    high = round(kin.d1_m - UNDER_BOOM_PIN_M + hang_m, 4)
    boxes = [("The column with its foot: what hangs stiff below the pin would hit it.", _column(ground, high))]
    boxes += [(f"keep_out.{name} of the profile.", _corners(box, hang_m)) for name, box in profile.keep_out.items()]
    out = [
        f"# Envelope of {profile.title},",
        "# for the guard: what this machine may do at most, whatever its profile says.",
        "#",
        "# A draft from its profile.  Check every limit against the machine; then seal the file with",
        "# `python -m controller.guard.seal FILE`.  Without the seal the guard does not start.",
        "",
        "# The hanger pin stays above this height; a grapple hangs below it.",
        f"ground_m = {value_text(round(lowest_pin_m(profile) - BELOW_CONTROLLER_M, 3))}",
        "",
        "[kinematics]",
        *(f"{key} = {value_text(value)}" for key, value in envelope_kinematics(profile).items()),
    ]
    for title, (low_m, high_m) in boxes:
        out += ["", f"# {title}", "[[boxes]]", f"low_m = {value_text(low_m)}", f"high_m = {value_text(high_m)}"]
    for j in JOINTS:
        spec = joint(profile, j)
        out += ["", f"[joints.{j.name.lower()}]", *(f"{key} = {value_text(getattr(spec, key))}" for key in LIMITS)]
    return "\n".join([*out, "", ""])


def _column(ground: float, high: float) -> tuple[list[float], list[float]]:
    return [-COLUMN_HALF_M, -COLUMN_HALF_M, ground], [COLUMN_HALF_M, COLUMN_HALF_M, high]


def _corners(box: KeepOut, hang_m: float) -> tuple[list[float], list[float]]:
    """The axis-parallel box around a box that is turned about the vertical, and ``hang_m`` higher."""
    (x, y, z), (a, b, c) = box.center_m, box.half_m
    cos, sin = abs(math.cos(box.yaw_rad)), abs(math.sin(box.yaw_rad))
    dx, dy = cos * a + sin * b, sin * a + cos * b
    low, high = (x - dx, y - dy, z - c), (x + dx, y + dy, z + c + hang_m)
    return [round(v, 4) for v in low], [round(v, 4) for v in high]
