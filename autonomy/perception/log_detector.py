"""The log detector: one camera of the machine in, the list of logs in the crane's base frame out.

``LogDetector.detect`` takes a picture only while the crane is at rest, because the pose of a camera on a moving stick
is not known well enough.  Otherwise it returns None, and the caller requests again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame, check_frame, optical_pose, rescaled
from autonomy.perception.fitting.contour import StereoSensor
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.fitting.measure import Masked, Rejection, measure
from autonomy.perception.log_list import LogObservation
from autonomy.perception.shown_picture import MeasuredPicture, ignore_picture
from autonomy.perception.sources.camera_source import CameraSource
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors, Track
from autonomy.perception.tracking.log_tracker import LogTracker, is_displaced
from machine.joints import N_JOINTS
from machine.profile import Profile
from runtime.errors import InputRefused, LinkError

REST_TOLERANCE: Final = 0.004
"""The crane is at rest when no joint moves by more than this between two requests [rad, m]: 2 cm at full reach."""
MAX_REQUEST_GAP_NS: Final = 1_000_000_000
"""After a longer gap between requests it is unknown whether the crane moved."""


class LogDetector:
    """One camera of a machine.

    ``segment`` returns the masks of the logs in a frame; ``measured`` gets every picture that was measured.
    ``problem`` says why the last call of ``detect`` returned no logs; it is empty when the call succeeded or the crane
    was moving.

    Raises:
        KeyError: the machine has no such camera.
    """

    def __init__(
        self,
        profile: Profile,
        camera: str,
        source: CameraSource,
        segment: Callable[[RgbdFrame], Sequence[Masked]],
        measured: Callable[[MeasuredPicture], None] = ignore_picture,
    ) -> None:
        self.problem = ""
        self.logs: tuple[LogObservation, ...] = ()
        """Result of the last successful detection."""
        self._profile, self._camera = profile, profile.cameras[camera]
        self._source, self._segment, self._measured = source, segment, measured
        self._perception = Perception(profile)
        self._last_q = np.full(N_JOINTS, np.nan)
        self._last_request_ns = 0

    def rests(self, q: Sequence[float], now_ns: int) -> bool:
        """Tell whether the crane rests: its joints ``q`` at ``now_ns`` are those of the last call, not long ago."""
        at = np.array(q, float)
        moved = np.abs(at - self._last_q)
        recent = now_ns - self._last_request_ns < MAX_REQUEST_GAP_NS
        self._last_q, self._last_request_ns = at, now_ns
        return recent and bool(np.all(moved[np.isfinite(at)] < REST_TOLERANCE))

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """Detect the logs in the base frame in a picture that is newer than the request; None when there is none.

        ``q`` are the joints in ``Joint`` order [rad, m] at ``now_ns``, NaN where there is no encoder.
        """
        if not self.rests(q, now_ns):
            self.problem = ""
            return None
        try:
            pose = optical_pose(self._profile, self._camera, q)
            if not np.all(np.isfinite(pose.rotation)):
                self.problem = f"the pose of camera {self._camera.model} depends on a joint whose position is unknown"
                return None
            frame = self._source.frame()
            if frame is None:
                self.problem = getattr(self._source, "problem", "") or "the camera delivers no picture"
                return None
            frame = rescaled(frame, self._camera.depth_scale)
            masks = self._segment(frame)
            tracks = self._perception.step(frame, pose, masks)
        except (LinkError, InputRefused) as error:
            self.problem = str(error)
            return None
        self.problem = ""
        self.logs = tuple(t.estimate.observation(t.id, t.last_seen_ns == frame.stamp_ns) for t in tracks)
        self._measured(MeasuredPicture(frame, pose, masks, self.logs))
        return self.logs


# -- The perception pipeline: from a frame with its masks to logs with identities.
#
# Steps: fit cylinders to masks, merge fragments of one log, reject implausible fits, track the rest over frames.

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
        """Return the confirmed logs after ``frame``, taken at ``pose``, in the frame in which the poses are given.

        Raises:
            InputRefused: the frame is invalid, or from a camera that the profile does not have.
        """
        fits = self.level_fits(frame, pose, instances)
        return self._tracker.step(fits, pose, frame.stamp_ns, partial(is_displaced, frame, pose))

    def level_fits(self, frame: RgbdFrame, pose: Pose, instances: Sequence[Masked]) -> list[CylinderFit]:
        """Return `fits` without what stands too steep at ``pose`` to be a log."""
        return [fit for fit in self.fits(frame, instances) if abs(fit.body.axis @ pose.rotation[2]) < MAX_SINE_TO_LEVEL]

    def fits(self, frame: RgbdFrame, instances: Sequence[Masked]) -> list[CylinderFit]:
        """Fit the logs of one frame alone, in its optical frame; ``rejections`` holds the masks that gave none."""
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
