"""Shows a load to the camera ahead of the machine, so that a rotator without an encoder is measured.

The crane works from memory of what that camera has seen, and a remembered load hangs as the count says.  So the planner
carries a load past the camera while it is unsure of the rotator, stands still there, and takes the log's direction from
the picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import atan2
from typing import Final

import numpy as np

from autonomy.crane_job.grasp_verification import is_between_jaws
from autonomy.crane_job.rotator_estimate import RotatorEstimate, has_no_encoder
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from autonomy.perception.camera.mount import optical_pose
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m, rotator_for_yaw
from machine.geometry.kinematics import Unreachable
from machine.joints import N_JOINTS
from machine.profile import Camera, Profile

UNSURE_RAD: Final = 0.15
"""A load is shown where the rotator's angle has a greater 1-sigma: three of them put an end of a log of 2 m, laid at
the side of the bunk, onto its stakes."""
UNSURE_AHEAD_RAD: Final = 0.08
"""... or this, where the log was gripped ahead of the machine: the camera is on the way, or nearly."""
AHEAD_RAD: Final = 1.9
"""Slew to either side beyond which a log lies ahead of the machine."""
AHEAD_M: Final = 3.0
"""Distance of a shown load in front of the camera: half of the picture is 3.6 m wide there."""
BELOW_CAMERA_M: Final = 0.45
"""A shown load hangs so far below the camera, clear of the ground and of the upper edge of the picture."""
ASIDE_M: Final = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Places beside the middle of the picture, for a slew that does not turn all round."""
VIEW_MARGIN_M: Final = 0.5
"""A load is measured this near to the jaws: the machine leans, and the load swings."""
VEHICLE_LINKS: Final = ("front", "rear")


@dataclass(frozen=True, slots=True)
class LoadView:
    """The camera of a machine that stands with this articulation [rad]."""

    profile: Profile
    camera: Camera
    articulation_rad: float

    def is_needed(self, rotator: RotatorEstimate, slew_rad: float) -> bool:
        """Whether a load gripped at this slew should be shown."""
        return rotator.sigma_rad > (UNSURE_AHEAD_RAD if abs(slew_rad) > AHEAD_RAD else UNSURE_RAD)

    def pose(self, arm: Arm, start: Pose, diameter_m: float) -> Pose:
        """The pose of the pin in which a load hangs in front of the camera, across its view and nearest to ``start``.

        Raises:
            Unreachable: the crane does not reach there.
        """
        mount = optical_pose(self.profile, self.camera, (0.0,) * N_JOINTS, self.articulation_rad)
        ahead = mount.rotation[:2, 2] / np.linalg.norm(mount.rotation[:2, 2])
        aside = np.array((-ahead[1], ahead[0]))
        height_m = float(mount.position_m[2]) - BELOW_CAMERA_M
        height_m += lowest_tip_below_pin_m(self.profile.grapple.jaws) - 0.5 * diameter_m
        reached = []
        for offset_m in sorted({side * m for m in ASIDE_M for side in (-1.0, 1.0)}):
            x, y = (mount.position_m[:2] + AHEAD_M * ahead + offset_m * aside).tolist()
            try:
                pose = arm.pose_above(x, y, height_m, max(height_m, travel_height_m(self.profile)))
            except Unreachable:
                continue
            reached.append((abs(offset_m) + abs(pose.slew_rad - start.slew_rad), pose))
        if not reached:
            raise Unreachable("the crane does not reach in front of the camera", "reach.camera")
        pose = min(reached, key=lambda found: found[0])[1]
        yaw = atan2(ahead[1], ahead[0])  # the jaws open along the view, so that the log lies across it
        return pose._replace(rot_rad=rotator_for_yaw(self.profile, pose.slew_rad, yaw, start.rot_rad))


def load_in_view(arm: Arm, logs: Iterable[LogObservation], pin: Pose) -> LogObservation | None:
    """What hangs in the jaws at a pin, of the logs of one picture; None where the picture shows no such log."""
    hanging = (log for log in logs if is_between_jaws(arm, log, pin, VIEW_MARGIN_M))
    return max(hanging, key=lambda o: o.length_m, default=None)


def load_view(profile: Profile, articulation_rad: float) -> LoadView | None:
    """The view of the machine's camera ahead; None where it has none, or needs none for it has an encoder."""
    camera = next((c for c in profile.cameras.values() if c.link in VEHICLE_LINKS), None)
    if camera is None or not has_no_encoder(profile):
        return None
    return LoadView(profile, camera, articulation_rad)
