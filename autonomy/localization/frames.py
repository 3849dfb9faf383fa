"""Transforms of the machine in the plane: rear frame and crane base, with their uncertainty.


The chain is rigid: centre of the front axle, articulation axis, rear frame, crane base (``machine.geometry.carrier``).
The optical frame of a camera in the base is ``autonomy.perception.camera.mount.optical_pose``; both halves share roll
and pitch about the articulation axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.localization.location import Location
from autonomy.localization.motion_model import Noise, axle_m, tilt
from autonomy.perception.camera.frame import Pose
from machine.geometry.carrier import rear_from_base, rear_from_front
from machine.profile import Carrier

STEP: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Placed:
    """A point in the plane's frame, east, north, up [m], and its covariance (3, 3)."""

    position_m: np.ndarray
    covariance: np.ndarray


class Frames:
    """The machine's frames at one location; an unknown z is that of level ground at the plane's origin."""

    def __init__(self, carrier: Carrier, location: Location, noise: Noise | None = None) -> None:
        self._carrier = carrier
        self._height = location.front_height_m
        z = location.z_m if np.isfinite(location.z_m) else carrier.wheel_radius_m
        sigma_z = location.height_sigma_m if np.isfinite(location.height_sigma_m) else 1.0
        n = noise or Noise()
        self._values = np.array([
            location.x_m, location.y_m, z, location.yaw_rad, location.articulation_rad, location.roll_rad,
            location.pitch_rad,
        ])  # fmt: skip
        self._spread = np.zeros((7, 7))
        known = [0, 1, 3]
        self._spread[np.ix_(known, known)] = location.covariance
        own = (sigma_z, n.articulation_rad, n.attitude_rad, n.attitude_rad)
        self._spread[[2, 4, 5, 6], [2, 4, 5, 6]] = np.square(own)

    def rear(self) -> Pose:
        """The rear frame; its origin is on the articulation axis."""
        return self._rear(self._values)

    def base(self) -> Pose:
        """The crane's base frame."""
        rear = self.rear()
        foot, *ends = (np.array(rear_from_base(self._carrier, tuple(p))) for p in (np.zeros(3), *np.eye(3)))
        turn = np.stack([end - foot for end in ends], axis=1)
        return Pose(rear.position_m + rear.rotation @ foot, rear.rotation @ turn)

    def optical(self, in_base: Pose) -> Pose:
        """A camera's optical frame, from its pose in the base."""
        base = self.base()
        return Pose(base.position_m + base.rotation @ in_base.position_m, base.rotation @ in_base.rotation)

    def from_rear(self, point: Sequence[float], covariance: np.ndarray | None = None) -> Placed:
        """A point of the rear frame [m]; ``covariance`` (3, 3) is its own in that frame."""
        at = np.asarray(point, float)

        def place(values: np.ndarray) -> np.ndarray:
            pose = self._rear(values)
            return pose.position_m + pose.rotation @ at

        slopes = [
            (place(self._values + STEP * unit) - place(self._values - STEP * unit)) / (2.0 * STEP) for unit in np.eye(7)
        ]
        j = np.stack(slopes, axis=1)
        spread = j @ self._spread @ j.T
        if covariance is not None:
            turn = self.rear().rotation
            spread = spread + turn @ covariance @ turn.T
        return Placed(place(self._values), spread)

    def from_base(self, point: Sequence[float], covariance: np.ndarray | None = None) -> Placed:
        """A point of the crane's base frame [m], as a log seen by a camera."""
        x, y, z = point
        if covariance is not None:
            foot, *ends = (np.array(rear_from_base(self._carrier, tuple(p))) for p in (np.zeros(3), *np.eye(3)))
            turn = np.stack([end - foot for end in ends], axis=1)
            covariance = turn @ covariance @ turn.T
        return self.from_rear(rear_from_base(self._carrier, (x, y, z)), covariance)

    def into_base(self, point: Sequence[float]) -> np.ndarray:
        """A point of the plane in the crane's base frame (3,)."""
        base = self.base()
        return base.rotation.T @ (np.asarray(point, float) - base.position_m)

    def _rear(self, values: np.ndarray) -> Pose:
        x, y, z, yaw, bend, roll, pitch = values
        lean = tilt(roll, pitch)
        ahead = lean @ (np.cos(bend), np.sin(bend), 0.0)  # direction of the front half without the rear's yaw
        rear = yaw - np.arctan2(ahead[1], ahead[0])
        c, s = np.cos(rear), np.sin(rear)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ lean
        axle = np.array(rear_from_front(float(bend), axle_m(self._carrier, self._height)))
        return Pose(np.array([x, y, z]) - turn @ axle, turn)
