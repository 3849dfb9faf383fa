"""The pose of the hanger pin in the crane's plane."""

from __future__ import annotations

from typing import NamedTuple


class Pose(NamedTuple):
    """Place of the hanger pin in the crane's plane, extension of the telescope, and rotator angle."""

    slew_rad: float
    r_m: float
    z_m: float
    ext_m: float
    rot_rad: float

    def at_height(self, z_m: float) -> Pose:
        """The same pose at another height of the pin."""
        return self._replace(z_m=z_m)
