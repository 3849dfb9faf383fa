"""Cartesian limits of a requested trajectory: the ground, the bunk's stakes, and the boxes of the profile.

Checked is what hangs stiff under the boom tip, from the hanger pin down to the rotator; the jaws below it must touch
logs and ground to work.  At most `MAX_KNOTS_CHECKED` knots of a datagram are checked, spread evenly and with the last
one among them: a setpoint reaches 0.4 s ahead and comes every 50 ms, so the tip moves by a few centimetres between two
checks.  A crane that is inside already, moved there by hand, may leave: only a knot that is inside where the first one
is not, or deeper in the ground than it, is refused.  The carrier's frame can be higher than its lowest position, and
then the ground lies deeper below the crane; the ground's limit counts for the highest frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import Final

from can_dbc.messages.crane import Knot
from controller.requests import RequestRefused
from machine.geometry.bunk import stake_walls
from machine.geometry.kinematics import pin_position
from machine.profile import Profile
from machine.status.reasons import Reason

MAX_KNOTS_CHECKED: Final = 4
GROUND_MARGIN_M: Final = 0.1
"""Ground that lies lower than the profile says, and sag: the rotator may be commanded this far below the ground."""
_ALLOWED_M: Final = 1e-3


class WorkspaceCheck:
    """Checks the tip against one profile."""

    __slots__ = ("_boxes", "_hang_m", "_kinematics", "_lowest_z_m")

    def __init__(self, profile: Profile) -> None:
        kin = self._kinematics = profile.kinematics
        self._hang_m = kin.hanger_to_fork_m + kin.fork_to_rotator_m
        lift_m = 0.0 if profile.carrier is None else profile.carrier.arm_travel_m
        self._lowest_z_m = profile.workspace.ground_z_m - lift_m - GROUND_MARGIN_M + self._hang_m
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
        """Number of the box that the tip at this pin position [m] is in, or -1."""
        low = z - self._hang_m
        for i, (bx, by, c, s, half_x, half_y, bottom, top) in enumerate(self._boxes):
            if low > top or z < bottom:
                continue
            dx, dy = x - bx, y - by
            if abs(c * dx + s * dy) <= half_x and abs(c * dy - s * dx) <= half_y:
                return i
        return -1
