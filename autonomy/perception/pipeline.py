"""The perception pipeline: from a frame with its masks to logs with identities.

Steps: fit cylinders to masks, merge fragments of one log, reject implausible fits, track the rest over frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from autonomy.perception.camera.frame import Pose, RgbdFrame, check_frame
from autonomy.perception.fitting.contour import StereoSensor
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.fitting.measure import Masked, Rejection, measure
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors, Track
from autonomy.perception.tracking.log_tracker import LogTracker, is_displaced
from machine.profile import Profile
from runtime.errors import InputRefused

MAX_SINE_TO_LEVEL: Final = 0.5
"""A steeper cylinder is not a log but a jaw of the grapple, a stump or a tree, and cannot be gripped either."""
SIGMA_D_PX: Final = 0.2  # standard deviation of stereo disparity, assumed


class Perception:
    """Logs from the frames of a machine's cameras."""

    def __init__(self, profile: Profile, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._sensors = {
            name: StereoSensor(camera.fx_px * camera.baseline_m, SIGMA_D_PX) for name, camera in profile.cameras.items()
        }
        self._tracker = LogTracker(errors)
        self.rejections: tuple[Rejection, ...] = ()
        """Of the last step."""

    def step(self, frame: RgbdFrame, pose: Pose, instances: Sequence[Masked]) -> tuple[Track, ...]:
        """The confirmed logs after ``frame``, taken at ``pose``, in the frame in which the poses are given.

        Raises:
            InputRefused: the frame is invalid, or from a camera that the profile does not have.
        """
        fits = self.level_fits(frame, pose, instances)
        return self._tracker.step(fits, pose, frame.stamp_ns, partial(is_displaced, frame, pose))

    def level_fits(self, frame: RgbdFrame, pose: Pose, instances: Sequence[Masked]) -> list[CylinderFit]:
        """`fits` without what stands too steep at ``pose`` to be a log."""
        return [fit for fit in self.fits(frame, instances) if abs(fit.body.axis @ pose.rotation[2]) < MAX_SINE_TO_LEVEL]

    def fits(self, frame: RgbdFrame, instances: Sequence[Masked]) -> list[CylinderFit]:
        """The logs of one frame alone, in its optical frame; ``rejections`` holds the masks that gave none."""
        check_frame(frame)
        if frame.camera not in self._sensors:
            known = ", ".join(self._sensors) or "none"
            raise InputRefused(
                "frame.unknown-camera",
                f"the frame is of camera {frame.camera!r}, which the machine does not have; it has: {known}",
            )
        fits, rejections = measure(frame, [i.mask for i in instances], self._sensors[frame.camera])
        self.rejections = tuple(rejections)
        return fits
