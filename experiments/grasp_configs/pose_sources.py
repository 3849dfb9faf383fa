"""Sources of the log poses for a grasp planner: the plant itself, or the camera on the stick and a perception.

``true``: a detector without errors.  ``ours``: this project's perception with its own segmentation; ``masked``: the
same with true masks.  ``faithful``: paper A's steps on our masks (`autonomy.perception.papers.log_from_mask`).  The
camera is surveyed.  It sees the logs from the start position of the crane, and again from the side and from above
when the activity waits for that.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment

from autonomy.perception import papers
from autonomy.perception.camera.frame import Pose, RgbdFrame, optical_pose, rescaled
from autonomy.perception.fitting.measure import Masked
from autonomy.perception.log_detector import Perception
from autonomy.perception.log_list import LogObservation
from autonomy.perception.tracking.log_filter import SURVEYED
from experiments.common import plugins
from hil.calibration import surveyed_profile
from machine.profile import Profile
from sim.camera.rig import CameraRig
from sim.plant import Plant
from sim.wood.logs import LogState

CAMERA: Final = "stick"
TRUE: Final = "true"
"""The source that takes the poses from the plant."""
PICTURE_COUNT: Final = 3
MIN_MASK_PX: Final = 60
HIGHEST_LOG_M: Final = 1.0
"""Over the ground: what paper A's perception finds higher is the grapple, or an edge between near and far."""
SURE_SCORE: Final = 0.5
"""Masks with a lower score are left out of paper A's perception, as is usual for its network."""
RATE_NS: Final = 66_666_667
MISSED_M, MISSED_RAD, MISSED_WIDTH_M = 0.15, math.radians(8.0), 0.06
"""A log with a larger error in position, direction or diameter misleads a planner."""


@dataclass(frozen=True, slots=True)
class Detection:
    """The detected logs, and the CPU time per picture [s]."""

    logs: tuple[LogObservation, ...] = ()
    seconds: float = 0.0


def true_poses(plant: Plant) -> tuple[LogObservation, ...]:
    """Return the ground-truth poses of all logs."""
    return tuple(
        LogObservation(i, log.position_m, log.axis, log.length_m, log.diameter_m) for i, log in enumerate(plant.logs())
    )


class TruePoses:
    """Ground truth of the plant."""

    def __init__(self, plant: Plant, profile: Profile, seed: int) -> None:
        self._plant = plant

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Detection:
        """Return the logs now."""
        return Detection(true_poses(self._plant))


class OurPerception:
    """Our perception of three pictures per detection from the resting camera; detections are combined.

    ``masked``: with the masks of the renderer as a perfect segmentation.
    """

    def __init__(self, plant: Plant, profile: Profile, seed: int, masked: bool = False) -> None:
        self._masked = masked
        self._camera = _Surveyed(plant, profile, seed)
        self._perception = Perception(profile, SURVEYED)

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Detection:
        """Detect the logs after these pictures."""
        from autonomy.perception.segmentation.log_segmenter import segment

        capture = self._camera.detect(stamp_ns, q)
        begun = time.process_time()
        for frame in capture.frames:
            masks: Sequence[Masked] = capture.masks if self._masked else segment(frame)
            tracks = self._perception.step(frame, capture.pose, masks)
        seconds = (time.process_time() - begun) / len(capture.frames)
        return Detection(tuple(t.estimate.observation(t.id) for t in tracks if t.hits > 1), seconds)


class PaperPerception:
    """Paper A's perception of one picture: middle, main direction, width and trimmed ends of what is under each mask.

    It does not combine detections, and takes nothing that hangs for a log that lies.
    """

    def __init__(self, plant: Plant, profile: Profile, seed: int) -> None:
        self._camera = _Surveyed(plant, profile, seed)
        self._highest_m = profile.workspace.ground_z_m + HIGHEST_LOG_M

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Detection:
        """Detect the logs in one picture."""
        from autonomy.perception.segmentation.log_segmenter import segment

        capture, begun = self._camera.detect(stamp_ns, q), time.process_time()
        frame, pose = capture.frames[0], capture.pose
        estimates = [papers.log_from_mask(frame, one.mask) for one in segment(frame) if one.score >= SURE_SCORE]
        logs: list[LogObservation] = []
        for log in estimates:
            if log is None:
                continue
            center_m, axis = pose.to_base(log.center_m), pose.rotation @ log.axis
            if center_m[2] < self._highest_m:
                logs.append(LogObservation(len(logs), _triple(center_m), _triple(axis), log.length_m, log.diameter_m))
        return Detection(tuple(logs), time.process_time() - begun)


class ForeignPerception:
    """A foreign detector on one picture; it gets what ours gets: the picture of the surveyed camera."""

    def __init__(self, detector: plugins.LogPictureDetector, plant: Plant, profile: Profile, seed: int) -> None:
        self._detector, self._camera = detector, _Surveyed(plant, profile, seed)

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Detection:
        """Detect the logs in one picture."""
        capture, begun = self._camera.detect(stamp_ns, q), time.process_time()
        estimates, pose = self._detector(capture.frames[0]), capture.pose
        seconds = time.process_time() - begun
        logs = [
            LogObservation(
                i,
                _triple(pose.to_base(np.asarray(log.center_m))),
                _triple(pose.rotation @ np.asarray(log.axis)),
                log.length_m,
                log.diameter_m,
            )
            for i, log in enumerate(estimates)
        ]
        return Detection(tuple(logs), seconds)


class PoseSource(Protocol):
    """Detects the logs from the present position of the crane."""

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Detection:
        """Detect the logs with the joints measured at ``q`` [rad, EXT m]."""


POSE_SOURCES: Final[dict[str, Callable[[Plant, Profile, int], PoseSource]]] = {
    TRUE: TruePoses,
    "ours": OurPerception,
    "masked": partial(OurPerception, masked=True),
    "faithful": PaperPerception,
}


def pose_source(name: str, plant: Plant, profile: Profile, seed: int) -> PoseSource:
    """Make the source with this name: one of ours, or the detector of an entry point.

    Raises:
        InputRefused: there is no such detector.
    """
    if name in POSE_SOURCES:
        return POSE_SOURCES[name](plant, profile, seed)
    return ForeignPerception(plugins.load(plugins.LOG_DETECTORS, name), plant, profile, seed)


def misled(truth: Sequence[LogState], seen: Sequence[LogObservation]) -> bool:
    """Tell whether perception missed a log, invented one, or misplaced one (paper A's SE)."""
    if len(seen) != len(truth):
        return True
    apart = [[math.dist(o.center_m, log.position_m) for o in seen] for log in truth]
    for i, j in zip(*linear_sum_assignment(np.reshape(apart, (len(truth), len(seen)))), strict=True):
        log, near = truth[i], seen[j]
        away = np.asarray(near.center_m) - log.position_m
        across = float(np.linalg.norm(away - (away @ np.asarray(log.axis)) * np.asarray(log.axis)))
        turned = math.acos(min(1.0, abs(float(np.dot(near.axis, log.axis)))))
        wide = abs(near.diameter_m - log.diameter_m)
        if across > MISSED_M or turned > MISSED_RAD or wide > MISSED_WIDTH_M:
            return True
    return False


@dataclass(frozen=True, slots=True)
class Mask:
    """A log's pixels (H, W) bool."""

    mask: np.ndarray


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures of the resting camera, its pose by the profile, and the true masks."""

    frames: tuple[RgbdFrame, ...]
    pose: Pose
    masks: tuple[Mask, ...]


class _Surveyed:
    """The camera on the stick with the mount and depth scale from a survey."""

    def __init__(self, plant: Plant, profile: Profile, seed: int) -> None:
        self._plant = plant
        self._rig = CameraRig(plant.world, plant.profile, plant.world.truth, seed, size_px=None)
        self._profile = surveyed_profile(profile, plant.world.truth, CAMERA, seed)

    def detect(self, stamp_ns: int, q: Sequence[float]) -> Pictures:
        """Take ``PICTURE_COUNT`` pictures of the present scene."""
        camera, ids = self._profile.cameras[CAMERA], self._rig.picture(CAMERA)[2].mask
        pose = optical_pose(self._profile, camera, q)
        numbers = range(1, len(self._plant.logs()) + 1)
        masks = [Mask(ids == i) for i in numbers if np.count_nonzero(ids == i) >= MIN_MASK_PX]
        taken = [self._rig.frame(CAMERA, stamp_ns + i * RATE_NS) for i in range(PICTURE_COUNT)]
        frames = [RgbdFrame(f.name, f.stamp_ns, f.rgb, f.depth_m, f.intrinsics) for f in taken]
        return Pictures(tuple(rescaled(f, camera.depth_scale) for f in frames), pose, tuple(masks))


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(a) for a in v)
    return x, y, z
