"""The checks of a requested trajectory: joint range, speed and its distance to the present motion, and where it leads.

A trajectory is refused whole with a `Reason`; nothing is corrected.  `TrajectoryCheck` judges joints, `WorkspaceCheck`
the tip: the ground, the bunk's stakes, and the boxes of the profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import Final

from can_dbc.messages.crane import CraneSetpoint, Knot
from controller.crane.reference_governor import Trajectory, extremes, peak_speed
from controller.requests import RequestRefused
from machine.geometry.bunk import stake_walls
from machine.geometry.grapple import lowest_pin_m
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint
from machine.status.reasons import Reason

SPEED_TOLERANCE_SHARE: Final = 1.05
"""A smooth profile cut into cubics overshoots its peak speed a little between the knots."""
JUMP_S: Final = 0.1
"""A new reference may differ by the distance that the joint covers in this time at its speed limit, ..."""
VELOCITY_JUMP_S: Final = 0.25
"""... and in velocity by the acceleration limit times this time (plus 10 % of the speed limit)."""


class TrajectoryCheck:
    """Checks the joints against one profile; the detail of a refusal is the joint."""

    __slots__ = ("_acceleration", "_lower", "_new_position", "_new_velocity", "_speed", "_upper")

    def __init__(self, profile: Profile) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self._lower = tuple(s.lower for s in specs)
        self._upper = tuple(s.upper for s in specs)
        self._speed = tuple(s.speed_limit for s in specs)
        self._acceleration = tuple(s.acceleration_limit for s in specs)
        self._new_position, self._new_velocity = [0.0] * N_JOINTS, [0.0] * N_JOINTS

    def load_and_check(
        self,
        setpoint: CraneSetpoint,
        candidate: Trajectory,
        position: Sequence[float],
        velocity: Sequence[float],
        now_ns: int,
    ) -> None:
        """Load ``candidate`` with a setpoint and check it.

        ``position`` and ``velocity`` are the motion that it must continue; a joint whose value is NaN is not compared.

        Raises:
            RequestRefused: the trajectory leaves the range, is too fast or jumps.
        """
        candidate.load(setpoint)
        new_position, new_velocity = self._new_position, self._new_velocity
        candidate.fill(JOINTS, now_ns, new_position, new_velocity)
        for j in JOINTS:
            self._check_path(setpoint, j)
            far = abs(new_position[j] - position[j]) > JUMP_S * self._speed[j]
            kick = abs(new_velocity[j] - velocity[j]) > VELOCITY_JUMP_S * self._acceleration[j] + 0.1 * self._speed[j]
            if far or kick:
                raise RequestRefused(Reason.REFERENCE_JUMP, j)

    def check_behind(self, position: Sequence[float], behind_s: float) -> None:
        """Check that the trajectory loaded last is within what a plan can be ahead of the present reference, which
        is ``behind_s`` late; a joint whose value is NaN is not compared.

        Raises:
            RequestRefused: setpoints have moved the plan away from the reference, jump by jump.
        """
        reach_s = JUMP_S + SPEED_TOLERANCE_SHARE * behind_s
        for j in JOINTS:
            if abs(self._new_position[j] - position[j]) > reach_s * self._speed[j]:
                raise RequestRefused(Reason.REFERENCE_JUMP, j)

    def _check_path(self, setpoint: CraneSetpoint, j: int) -> None:
        knots, lower, upper = setpoint.knots, self._lower[j], self._upper[j]
        fastest = SPEED_TOLERANCE_SHARE * self._speed[j]
        first, last = knots[0], knots[-1]
        if not lower <= first.position[j] <= upper:
            raise RequestRefused(Reason.JOINT_RANGE, j)
        if abs(first.velocity[j]) > fastest:
            raise RequestRefused(Reason.JOINT_SPEED, j)
        if setpoint.final and last.velocity[j] != 0.0:
            raise RequestRefused(Reason.FINAL_MOVING, j)
        a = first
        for b in knots[1:]:
            p0, v0, p1, v1 = a.position[j], a.velocity[j], b.position[j], b.velocity[j]
            h = (b.after_ns - a.after_ns) * 1e-9
            a = b
            # A cubic and its velocity lie within the hulls of their Bezier points; only a piece whose hulls leave the
            # limits is solved exactly.  The comparisons also refuse a NaN from an overflow.
            if (
                lower <= p1 <= upper
                and lower <= p0 + v0 * h / 3.0 <= upper
                and lower <= p1 - v1 * h / 3.0 <= upper
                and -fastest <= v1 <= fastest
                and -fastest <= 3.0 * (p1 - p0) / h - v0 - v1 <= fastest
            ):
                continue
            piece = (p0, v0, p1, v1, h)
            if not peak_speed(*piece) <= fastest:
                raise RequestRefused(Reason.JOINT_SPEED, j)
            low, high = extremes(*piece)
            if not (lower <= low and high <= upper):
                raise RequestRefused(Reason.JOINT_RANGE, j)


MAX_KNOTS_CHECKED: Final = 4
_ALLOWED_M: Final = 1e-3


class WorkspaceCheck:
    """Checks the tip against one profile.

    Against boxes what hangs stiff under the boom tip is checked, from the hanger pin down to the rotator; the jaws
    below it must touch logs to work.  Against the ground the grapple is (`machine.geometry.grapple.lowest_pin_m`).  At
    most `MAX_KNOTS_CHECKED` knots of a datagram are checked, spread evenly and with the last one among them: a setpoint
    reaches 0.4 s ahead and comes every 50 ms, so the tip moves by a few centimetres between two checks.  A crane that
    is inside already, moved there by hand, may leave: only a knot that is inside where the first one is not, or deeper
    in the ground than it, is refused.
    """

    __slots__ = ("_boxes", "_hang_m", "_kinematics", "_lowest_z_m")

    def __init__(self, profile: Profile) -> None:
        kin = self._kinematics = profile.kinematics
        self._hang_m = kin.hanger_to_fork_m + kin.fork_to_rotator_m
        self._lowest_z_m = lowest_pin_m(profile)
        self._boxes = tuple(
            (
                box.center_m[0],
                box.center_m[1],
                cos(box.yaw_rad),
                sin(box.yaw_rad),
                box.half_m[0],
                box.half_m[1],
                box.center_m[2] - box.half_m[2],
                box.center_m[2] + box.half_m[2],
            )
            for box in (*stake_walls(profile.bunk), *profile.keep_out.values())
        )

    def check(self, knots: Sequence[Knot]) -> None:
        """Check a trajectory.

        Raises:
            RequestRefused: it leads into the ground or into a box; the detail is the number of the box, stakes first.
        """
        last = len(knots) - 1
        step = -(-last // MAX_KNOTS_CHECKED) if last > 0 else 1
        start = pin_position(self._kinematics, knots[0].position)
        at = last
        while at > 0:
            x, y, z = pin_position(self._kinematics, knots[at].position)
            if z < self._lowest_z_m and z < start[2] - _ALLOWED_M:
                raise RequestRefused(Reason.BELOW_GROUND)
            inside = self._box_at(x, y, z)
            if inside >= 0 and self._box_at(start[0], start[1], start[2]) != inside:
                raise RequestRefused(Reason.KEEP_OUT, inside)
            at -= step

    def _box_at(self, x: float, y: float, z: float) -> int:
        """Return the number of the box that the tip at this pin position [m] is in, or -1."""
        low = z - self._hang_m
        for i, (bx, by, c, s, half_x, half_y, bottom, top) in enumerate(self._boxes):
            if low > top or z < bottom:
                continue
            dx, dy = x - bx, y - by
            if abs(c * dx + s * dy) <= half_x and abs(c * dy - s * dx) <= half_y:
                return i
        return -1
