"""The true position of the hanger pin: the column leans under the crane's weight, and no encoder measures it.

    lean [rad] = head * r_head + pin * r_pin - rest + load * g * kg * r_pin        forward and down, about the foot

with r_head and r_pin the horizontal distances of stick pin and hanger pin from the slew axis: the weights of boom,
stick and grapple act there, and a load hangs from the pin.  ``profile.sag`` holds the result of a survey
(docs/reference/plant-model.md section 2: the column yields most).  ``true_pin`` maps joints to the point, ``aim`` and
``aim_free`` are its inverse; without a sag table both are the encoder kinematics of `machine.geometry.kinematics`.
Plain floats, base frame, m and rad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, hypot, isfinite, sin
from typing import Final

from machine.geometry.kinematics import Limits, Point, Unreachable, inverse, pin_position, solve
from machine.joints import Joint
from machine.profile import Kinematics, Profile, Sag, joint_limits

GRAVITY_M_S2: Final = 9.81
FOOT_SHARE: Final = 0.2
"""Height of the slew bearing, about which the column bends, as a share of the boom pin's height."""
MAX_LOAD_KG: Final = 2000.0
"""More than any crane of this kind lifts; a greater value means a broken sensor."""
AIM_TOLERANCE_M: Final = 1e-6
"""Greatest distance of the true pin from the requested point."""
MAX_AIM_ITERATIONS: Final = 12
"""Each iteration reduces the error to a fiftieth, with a soft column to a tenth."""


def plausible_load_kg(load_kg: float) -> float:
    """Return a reported load for use by a planner: 0 if it is unknown (NaN), negative or implausibly high."""
    return load_kg if isfinite(load_kg) and 0.0 <= load_kg <= MAX_LOAD_KG else 0.0


def distances(kin: Kinematics, q: Sequence[float]) -> tuple[float, float, float]:
    """Compute stick pin's and hanger pin's distances from the slew axis and hanger pin's height, without sag [m]."""
    x, y, z = pin_position(kin, q)
    theta = q[Joint.SLEW] + kin.theta1_offset_rad
    head = kin.a1_m + kin.a2_m * cos(q[Joint.LIFT] + kin.theta2_offset_rad)
    return head, x * cos(theta) + y * sin(theta), z


def lean_rad(sag: Sag, kin: Kinematics, q: Sequence[float], load_kg: float = 0.0) -> float:
    """Forward lean of the column for a joint vector and a load [rad]."""
    head, pin, _ = distances(kin, q)
    return _lean(sag, head, pin, load_kg)


def _lean(sag: Sag, head: float, pin: float, load_kg: float) -> float:
    pin_rad_m = sag.pin_rad_m + sag.load_rad_nm * GRAVITY_M_S2 * load_kg
    return sag.head_rad_m * head + pin_rad_m * pin - sag.rest_rad


def true_pin(sag: Sag | None, kin: Kinematics, q: Sequence[float], load_kg: float = 0.0) -> Point:
    """Compute the hanger pin with the column leaning [m]."""
    if sag is None:
        return pin_position(kin, q)
    head, r, z = distances(kin, q)
    lean, foot = _lean(sag, head, r, load_kg), FOOT_SHARE * kin.d1_m
    up = z - foot
    r, z = r * cos(lean) + up * sin(lean), foot + up * cos(lean) - r * sin(lean)
    theta = q[Joint.SLEW] + kin.theta1_offset_rad
    return r * cos(theta), r * sin(theta), z


def aim(
    sag: Sag | None,
    kin: Kinematics,
    limits: Limits,
    x: float,
    y: float,
    z: float,
    ext_m: float,
    load_kg: float = 0.0,
) -> tuple[float, float, float]:
    """Find slew, lift and tilt for the true pin at a point with the given extension; `kinematics.inverse` with sag.

    Raises:
        Unreachable: the sentence names the point that the crane without sag would have to reach.
    """
    if sag is None:
        return inverse(kin, limits, x, y, z, ext_m)

    def joints(px: float, py: float, pz: float) -> tuple[float, float, float, float]:
        return *inverse(kin, limits, px, py, pz, ext_m), ext_m

    return _iterate(sag, kin, joints, x, y, z, load_kg)[:3]


def aim_free(
    profile: Profile,
    x: float,
    y: float,
    z: float,
    preference: float | Sequence[float] | None = None,
    load_kg: float = 0.0,
) -> tuple[float, float, float, float]:
    """Find slew, lift, tilt and extension for the true pin at a point; `kinematics.solve` with the profile's sag.

    Raises:
        Unreachable: no joint position inside the limits reaches the point.
    """
    if profile.sag is None:
        return solve(profile, x, y, z, preference)
    kin = profile.kinematics
    ext_m = solve(profile, x, y, z, preference)[Joint.EXT]
    try:
        return *aim(profile.sag, kin, joint_limits(profile), x, y, z, ext_m, load_kg), ext_m
    except Unreachable:  # at the edge of the work space the extension has to change, too
        return _iterate(profile.sag, kin, lambda px, py, pz: solve(profile, px, py, pz, preference), x, y, z, load_kg)


def _iterate(
    sag: Sag,
    kin: Kinematics,
    joints: Callable[[float, float, float], tuple[float, float, float, float]],
    x: float,
    y: float,
    z: float,
    load_kg: float,
) -> tuple[float, float, float, float]:
    """Find the joints for the point as far above the requested one as the crane sags: fixed-point iteration."""
    up = (0.0, 0.0, 0.0)
    for _ in range(MAX_AIM_ITERATIONS):
        q = joints(x + up[0], y + up[1], z + up[2])
        there = true_pin(sag, kin, q, load_kg)
        off = (x - there[0], y - there[1], z - there[2])
        if hypot(*off) < AIM_TOLERANCE_M:
            return q
        up = (up[0] + off[0], up[1] + off[1], up[2] + off[2])
    raise Unreachable(
        f"({x:.3f}, {y:.3f}, {z:.3f}) m lies too near the mast: the lean of the column carries the pin past it; aim "
        "farther out"
    )
