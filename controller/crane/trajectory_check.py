"""The checks of a requested trajectory: joint range, speed and its distance to the present motion, and where it leads.

A trajectory is refused whole with a `Reason`; nothing is corrected.  `TrajectoryCheck` judges joints, `WorkspaceCheck`
the tip: the ground, the bunk's stakes, and the boxes of the profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, cos, dist, nan, sin
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
"""Knots after the first one."""
STEP_M: Final = 0.1
MAX_STEPS: Final = 16
"""Between two knots the tip is checked this often, and so many times at most."""
_ALLOWED_M: Final = 1e-3
_CHORD_M: Final = 0.02
"""A straight line between two places of the joints may run this far below the curve."""


class WorkspaceCheck:
    """Checks the tip against one profile.

    Against boxes what hangs stiff under the boom tip is checked, from the hanger pin down to the rotator; the jaws
    below it must touch logs to work.  Against the ground the grapple is (`machine.geometry.grapple.lowest_pin_m`).  At
    most `MAX_KNOTS_CHECKED` knots of a datagram besides the first one are checked, spread evenly and with the last one
    among them, and the way between them, from where the reference is now, in steps of `STEP_M`.  A crane that is inside
    already, moved there by hand, may leave: only a place that is inside a box where the reference is not, or deeper in
    the ground than the reference has been since the machine was armed, is refused; so setpoints that each lead a
    little deeper lead nowhere.
    """

    __slots__ = ("_boxes", "_floor_z_m", "_hang_m", "_kinematics", "_lowest_z_m")

    def __init__(self, profile: Profile) -> None:
        kin = self._kinematics = profile.kinematics
        self._hang_m = kin.hanger_to_fork_m + kin.fork_to_rotator_m
        self._lowest_z_m = lowest_pin_m(profile)
        self._floor_z_m = nan
        """The least height of the pin that is allowed now; NaN until the reference is known."""
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

    def forget(self) -> None:
        """Forget how deep the reference has been: a person may move a machine that is not armed."""
        self._floor_z_m = nan

    def check(self, start: Sequence[float], knots: Sequence[Knot]) -> None:
        """Check a trajectory that is joined to the reference at ``start`` [rad, EXT m].

        Raises:
            RequestRefused: it leads into the ground or into a box; the detail is the number of the box, stakes first.
        """
        last = len(knots) - 1
        step = -(-last // MAX_KNOTS_CHECKED) if last > 0 else 1
        before: Sequence[float] = start
        pin: Sequence[float] = pin_position(self._kinematics, start)
        box = self._box_at(pin[0], pin[1], pin[2])
        self._raise_floor(pin[2])
        before, pin = self._check_way(before, pin, knots[0].position, box)
        at = last % step or step
        while at <= last:
            before, pin = self._check_way(before, pin, knots[at].position, box)
            at += step

    def enters(self, start: Sequence[float], end: Sequence[float]) -> bool:
        """Tell whether a motion from the joints' places ``start`` to ``end`` leads into the ground or into a box."""
        pin = pin_position(self._kinematics, start)
        self._raise_floor(pin[2])
        try:
            self._check_way(start, pin, end, self._box_at(pin[0], pin[1], pin[2]))
        except RequestRefused:
            return True
        return False

    def _raise_floor(self, z: float) -> None:
        """Allow no place deeper than the reference, once it is known, and none below the ground once it is over it."""
        floor = self._floor_z_m
        self._floor_z_m = min(self._lowest_z_m, z if floor != floor else max(floor, z))

    def _check_way(
        self, start: Sequence[float], start_pin: Sequence[float], end: Sequence[float], box: int
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Check the way between two places of the joints, the last one included; return it with its pin."""
        pin = pin_position(self._kinematics, end)
        far = dist(start_pin, pin)
        steps = min(ceil(far / STEP_M), MAX_STEPS) if far > STEP_M else 1
        for i in range(1, steps):
            share = i / steps
            between = [a + share * (b - a) for a, b in zip(start, end, strict=True)]
            self._check_pin(pin_position(self._kinematics, between), box, _CHORD_M)
        self._check_pin(pin, box, 0.0)
        return end, pin

    def _check_pin(self, pin: Sequence[float], box: int, sag_m: float) -> None:
        """Check one place of the pin, which may be ``sag_m`` too low; ``box``: the one of the reference, or -1."""
        z, floor = pin[2], self._floor_z_m
        if z < (floor - _ALLOWED_M if floor < self._lowest_z_m else self._lowest_z_m) - sag_m:
            raise RequestRefused(Reason.BELOW_GROUND)
        inside = self._box_at(pin[0], pin[1], z)
        if inside >= 0 and inside != box:
            raise RequestRefused(Reason.KEEP_OUT, inside)

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
