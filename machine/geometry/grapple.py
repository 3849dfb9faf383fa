"""Geometry of the hanging grapple: yaw, rotator and jaws.

Angles are in the base frame, rad, counter-clockwise seen from above.  The grapple hangs straight down; with the
rotator at 0 its jaws open across the reach: along base x on ``palms_471``, whose reach is +y at slew 0, so that a
grasped log lies along y.  The opening axis turns with ``slew + rot``.  The **grapple yaw** is the direction of the
opening axis; a log whose axis points to ``psi`` is grasped with yaw ``psi + pi/2``.  Log and grapple are symmetric, so
a yaw counts modulo pi.  Jaw angle 0 is fully open, the last value of the profile's table is closed without a load.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from math import ceil, degrees, floor, pi
from typing import Final

from machine.geometry.kinematics import Unreachable
from machine.joints import Joint
from machine.profile import JawTable, Kinematics, Profile, joint

FIXED_GROUND_M: Final = 0.2
"""The ground around a fixed base may lie this much lower than the profile says, ..."""
RAISED_GROUND_M: Final = 0.1
"""... and that of a carrier this much lower than with its frame at its highest."""


def grapple_yaw(profile: Profile, q: Sequence[float]) -> float:
    """Compute the direction of the opening axis [rad], not wrapped; ``q`` is indexed by ``Joint``."""
    return q[Joint.SLEW] + q[Joint.ROT] + _across(profile.kinematics)


def rotator_for_yaw(profile: Profile, slew: float, yaw: float, near: float = 0.0) -> float:
    """Find the rotator angle in its limits that gives ``yaw`` modulo pi at this slew, the one nearest to ``near``.

    Raises:
        Unreachable: the rotator turns less than pi, and no angle fits.
    """
    spec = joint(profile, Joint.ROT)
    turn = yaw - slew - _across(profile.kinematics)
    first, last = ceil((spec.lower - turn) / pi), floor((spec.upper - turn) / pi)
    fitting = [turn + k * pi for k in range(first, last + 1)]
    if not fitting:
        raise Unreachable(
            f"grapple yaw {degrees(yaw):.1f} deg at slew {degrees(slew):.1f} deg is out of reach: "
            f"the rotator turns only {degrees(spec.lower):.1f}..{degrees(spec.upper):.1f} deg",
            "reach.rotator",
        )
    return min(fitting, key=lambda angle: abs(angle - near))


def _across(kin: Kinematics) -> float:
    """Compute the direction across the reach at slew 0 [rad]."""
    return kin.theta1_offset_rad - pi / 2


def pin_to_jaw_pivot_m(kin: Kinematics) -> float:
    """Compute the height of the hanger pin above the jaw pivots of the hanging grapple [m]."""
    return kin.hanger_to_fork_m + kin.fork_to_rotator_m + kin.rotator_to_tong_pivot_m


def tip_below_pin_m(jaws: JawTable, jaw_rad: float) -> float:
    """Compute the depth of the jaw tips below the hanger pin [m]; linear between table rows, constant beyond them."""
    return _interpolate(jaws.angle_rad, jaws.tip_below_pin_m, jaw_rad)


def half_gap_m(jaws: JawTable, jaw_rad: float) -> float:
    """Compute half the distance between the jaw tips [m]; negative when the jaws overlap."""
    return _interpolate(jaws.angle_rad, jaws.half_gap_m, jaw_rad)


def lowest_tip_below_pin_m(jaws: JawTable) -> float:
    """Return the greatest depth of the tips while closing [m]: the clearance that a closing grapple needs."""
    return max(jaws.tip_below_pin_m)


def lowest_pin_m(profile: Profile) -> float:
    """Compute the height of the hanger pin [m] below which no work brings it: its grapple would be in the ground.

    On a fixed base that of the open grapple, which stands on the ground to grasp what lies there.  Under a carrier the
    ground is deeper by what its frame is raised; there it is that of the shortest grapple, closed and empty.
    """
    tips, ground_m, carrier = profile.grapple.jaws.tip_below_pin_m, profile.workspace.ground_z_m, profile.carrier
    if carrier is None:
        return ground_m - FIXED_GROUND_M + tips[0]
    return ground_m - carrier.arm_travel_m - RAISED_GROUND_M + min(tips)


def jaw_angle_from_opening_pct(jaws: JawTable, opening_pct: float) -> float:
    """Compute the jaw angle [rad] for the opening on the bus (100 = fully open, 0 = closed); clipped to that range."""
    return (1.0 - min(max(opening_pct, 0.0), 100.0) / 100.0) * jaws.angle_rad[-1]


def opening_pct_from_jaw_angle(jaws: JawTable, jaw_rad: float) -> float:
    """Compute the inverse of ``jaw_angle_from_opening_pct``."""
    return 100.0 * (1.0 - min(max(jaw_rad / jaws.angle_rad[-1], 0.0), 1.0))


def _interpolate(xs: Sequence[float], ys: Sequence[float], x: float) -> float:
    i = bisect_right(xs, x)
    if i == 0:
        return ys[0]
    if i == len(xs):
        return ys[-1]
    share = (x - xs[i - 1]) / (xs[i] - xs[i - 1])
    return ys[i - 1] + share * (ys[i] - ys[i - 1])
