"""Transforms of the machine in the plane: rear frame and crane base.

The chain is rigid: centre of the front axle, articulation axis, rear frame, crane base (``machine.geometry.carrier``).
The optical frame of a camera in the base is ``autonomy.perception.camera.mount.optical_pose``; both halves share roll
and pitch about the articulation axis.
"""

from __future__ import annotations

import numpy as np

from autonomy.localization.location import Location
from autonomy.localization.vehicle_filter import axle_m, tilt
from autonomy.perception.camera.frame import Pose
from machine.geometry.carrier import rear_from_base, rear_from_front
from machine.profile import Carrier


class Frames:
    """The machine's frames at one location; an unknown z is that of level ground at the plane's origin."""

    def __init__(self, carrier: Carrier, location: Location) -> None:
        self._carrier = carrier
        self._height = location.front_height_m
        z = location.z_m if np.isfinite(location.z_m) else carrier.wheel_radius_m
        self._values = np.array(
            [
                location.x_m,
                location.y_m,
                z,
                location.yaw_rad,
                location.articulation_rad,
                location.roll_rad,
                location.pitch_rad,
            ]
        )

    def rear(self) -> Pose:
        """Return the rear frame; its origin is on the articulation axis."""
        return self._rear(self._values)

    def base(self) -> Pose:
        """Return the crane's base frame."""
        rear = self.rear()
        base_offset, *ends = (np.array(rear_from_base(self._carrier, tuple(p))) for p in (np.zeros(3), *np.eye(3)))
        turn = np.stack([end - base_offset for end in ends], axis=1)
        return Pose(rear.position_m + rear.rotation @ base_offset, rear.rotation @ turn)

    def _rear(self, values: np.ndarray) -> Pose:
        x, y, z, yaw, articulation, roll, pitch = values
        tilt_rotation = tilt(roll, pitch)
        ahead = tilt_rotation @ (
            np.cos(articulation),
            np.sin(articulation),
            0.0,
        )  # direction of the front half without the rear's yaw
        rear = yaw - np.arctan2(ahead[1], ahead[0])
        c, s = np.cos(rear), np.sin(rear)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt_rotation
        axle = np.array(rear_from_front(float(articulation), axle_m(self._carrier, self._height)))
        return Pose(np.array([x, y, z]) - turn @ axle, turn)
