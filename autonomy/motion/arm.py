"""The arm for planning: poses above a point, with the telescope where it is fastest or most compact.

Inputs: one machine with a load.  Failure: ``Unreachable``.
"""

from __future__ import annotations

from math import hypot
from typing import Final

import numpy as np

from autonomy.motion.arm_kinematics import LEVEL, STOP_MARGIN, ArmKinematics
from autonomy.motion.pose import Pose
from autonomy.motion.telescope import fastest_extension
from machine.geometry.kinematics import Unreachable
from machine.geometry.sag import aim_free
from machine.joints import Joint
from machine.profile import Profile

SLEW_MARGIN_RAD: Final = 0.01
_EXTENSION_CACHE_GRID_M: Final = 0.1
"""Grid of the cache of extensions: places within one cell share an extension."""
DEXTEROUS_STRETCH: Final = 0.88
"""Distance of the pin from the boom pin, as a share of the straight arm's length, that leaves speed in all
directions."""


class Arm(ArmKinematics):
    """One machine with a load [kg] in its grapple, prepared for planning; ``slope`` as in `ArmKinematics`.

    ``free_telescope``: `pose_above` chooses the extension from which the crane gets over the bunk fastest; otherwise it
    works like `compact_pose_above`.
    """

    def __init__(
        self, profile: Profile, load_kg: float = 0.0, free_telescope: bool = True, slope: tuple[float, float] = LEVEL
    ) -> None:
        super().__init__(profile, load_kg, slope)
        self._free_telescope = free_telescope
        self._extension_cache: dict[tuple[int, int, int], float | None] = {}

    def loaded(self, load_kg: float) -> Arm:
        """The same machine with another load."""
        return self if load_kg == self.load_kg else Arm(self.profile, load_kg, self._free_telescope, self.slope)

    def pose_above(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The pose with the jaws above a point, the pin at ``low_z_m``, whose extension also serves at ``high_z_m``;
        rotator at 0.

        Raises:
            Unreachable: the point is out of reach at one of the heights.
        """
        x, y = x - self._aside_m[0], y - self._aside_m[1]
        if not self._free_telescope:
            return self._compact_pose(x, y, low_z_m, high_z_m)
        try:
            return self._pose_with_extension(
                x, y, low_z_m, high_z_m, self._fastest_extension(hypot(x, y), low_z_m, high_z_m)
            )
        except Unreachable:
            return self._compact_pose(x, y, low_z_m, high_z_m)

    def compact_pose_above(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The same with the telescope out only as far as leaves the arm speed in all directions there.

        Raises:
            Unreachable: the point is out of reach at one of the heights.
        """
        return self._compact_pose(x - self._aside_m[0], y - self._aside_m[1], low_z_m, high_z_m)

    def _compact_pose(self, x: float, y: float, low_z_m: float, high_z_m: float) -> Pose:
        """The pose with the pin above a point."""
        r = hypot(x, y) - self._kin.a1_m
        stretch = max(hypot(r, z - self._kin.d1_m) for z in (low_z_m, high_z_m)) / DEXTEROUS_STRETCH
        return self._pose_with_extension(x, y, low_z_m, high_z_m, stretch - self._kin.a2_m - self._kin.d4_m)

    def _pose_with_extension(self, x: float, y: float, low_z_m: float, high_z_m: float, wish_m: float) -> Pose:
        least, most = self._limits[Joint.EXT]
        wish_m = min(max(wish_m, least + 2.0 * STOP_MARGIN), most - 2.0 * STOP_MARGIN)
        slew, _, _, ext = aim_free(self.profile, x, y, low_z_m, wish_m, self.load_kg)
        low, high = self._limits[Joint.SLEW]
        if not low + SLEW_MARGIN_RAD <= slew <= high - SLEW_MARGIN_RAD:
            raise Unreachable(f"point ({x:.2f}, {y:.2f}) m is at the stop of the slew", "motion.at-slew-stop")
        pose = Pose(slew, hypot(x, y), low_z_m, ext, 0.0)
        heights = high_z_m, low_z_m, 0.5 * (low_z_m + high_z_m), high_z_m
        self.joints(np.array([pose.at_height(z) for z in heights]))
        return pose

    def _fastest_extension(self, r_m: float, low_z_m: float, high_z_m: float) -> float:
        """The extension from which the crane gets up and over the bunk fastest, from a horizontal distance, m."""
        key = (
            round(r_m / _EXTENSION_CACHE_GRID_M),
            round(low_z_m / _EXTENSION_CACHE_GRID_M),
            round(high_z_m / _EXTENSION_CACHE_GRID_M),
        )
        if key not in self._extension_cache:
            r, low, high = (k * _EXTENSION_CACHE_GRID_M for k in key)
            down, up = (Pose(0.0, r, z, 0.0, 0.0) for z in (low, high))
            self._extension_cache[key] = fastest_extension(
                self, down, up, up._replace(r_m=hypot(*self.profile.bunk.center_m))
            )
        if (found := self._extension_cache[key]) is None:
            raise Unreachable("no extension serves at both heights", "motion.no-common-extension")
        return found
