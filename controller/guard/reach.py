"""Where the hanger pin is, by the guard's own kinematics, and whether a command brings it where it must not be.

Input: positions of slew, lift, tilt [rad] and telescope [m]; geometry, ground and boxes of the envelope, in the
crane's base frame [m].  The crane works in one vertical plane, so the pin is a sum of three vectors in it.
"""

from __future__ import annotations

from math import cos, sin
from typing import Final

from controller.guard.envelope import Envelope

AHEAD_S: Final = 0.1
"""The pin is judged where the commanded speeds bring it in this time."""


class Reach:
    """`deeper` is the rule."""

    __slots__ = ("_boxes", "_ground_m", "_k")

    def __init__(self, envelope: Envelope) -> None:
        self._k = envelope.kinematics
        self._ground_m, self._boxes = envelope.ground_m, envelope.boxes

    def pin(self, slew: float, lift: float, tilt: float, ext: float) -> tuple[float, float, float]:
        """Compute the position of the hanger pin [m]."""
        k = self._k
        boom = lift + k.boom_offset_rad
        stick = boom + tilt + k.stick_offset_rad
        length = k.stick_m + ext
        r = k.boom_pin_r_m + k.boom_m * cos(boom) + k.telescope_offset_m * cos(stick) + length * sin(stick)
        z = k.boom_pin_z_m + k.boom_m * sin(boom) + k.telescope_offset_m * sin(stick) - length * cos(stick)
        plane = slew + k.plane_offset_rad
        return r * cos(plane), r * sin(plane), z

    def depth_m(self, q: list[float]) -> float:
        """Tell how far the pin is below the ground or inside a box; negative outside."""
        point = self.pin(*q)
        deepest = self._ground_m - point[2]
        for low, high in self._boxes:
            inside = min(min(p - a, b - p) for p, a, b in zip(point, low, high, strict=True))
            deepest = max(deepest, inside)
        return deepest

    def deeper(self, q: list[float], speeds: list[float]) -> bool:
        """Tell whether the commanded ``speeds`` bring the pin into a forbidden place, or further into one."""
        after_m = self.depth_m([at + v * AHEAD_S for at, v in zip(q, speeds, strict=True)])
        return after_m > 0.0 and after_m > self.depth_m(q)
