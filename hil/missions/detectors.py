"""Log detectors of a mission in lockstep: a perfect one, or the front camera of the plant.

``perfect`` reports the true poses of the logs around the crane and in front of the machine.  ``faithful`` and ``ours``
take pictures with the surveyed front camera while the crane rests; the crane works from the map of logs.  ``faithful``
finds boxes and takes the depth at their middles, as paper B does, ``ours`` finds masks and fits cylinders.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.manager.activity_manager import ActivityManager
from autonomy.perception.driving_log_detector import (
    CylinderLocalizer,
    DrivingLogDetector,
    LogLocalizer,
    PaperBLocalizer,
    Segmentation,
)
from autonomy.perception.log_list import LogObservation
from autonomy.perception.papers import BoxSegmenter
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.tracking.log_filter import SURVEYED_BY_GNSS
from hil.calibration import surveyed_profile
from hil.harness.lockstep import LogDetector
from hil.plant.camera import RigCamera
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.camera.rig import CameraRig
from sim.instruments import detect_in_view
from sim.plant import Plant

CAMERA: Final = "front"
PERFECT: Final = "perfect"


class PerfectDetector:
    """Every log that a camera could see, at its true pose."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...]:
        """Return the logs in the base frame of the crane, whose x axis points backwards."""
        return tuple(
            LogObservation(log.id, log.position_m, log.axis, log.length_m, log.diameter_m)
            for log in detect_in_view(self._plant)
        )


class FrontCameraDetector:
    """The front camera; it takes pictures while the crane rests, and of a load that the crane shows it."""

    def __init__(self, front: DrivingLogDetector, manager: ActivityManager) -> None:
        self._front, self._manager = front, manager

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """Return the logs in a picture taken now; None while the manager wants none."""
        world, standpoint = self._manager.world, self._manager.standpoint(now_ns)
        if standpoint is None:
            return None
        return self._front.detect(world.base_at(now_ns), q, standpoint.articulation_rad, standpoint.load)


def check_camera(profile: Profile) -> None:
    """Check that the machine has a front camera.

    Raises:
        InputRefused: the machine has no front camera.
    """
    if CAMERA not in profile.cameras:
        raise InputRefused(
            "mission.no-front-camera", f"{profile.name} has no camera {CAMERA!r}; add [cameras.{CAMERA}] to the profile"
        )


def make_detector(kind: str, plant: Plant, profile: Profile, manager: ActivityManager, seed: int) -> LogDetector:
    """Make the detector ``kind`` of the module docstring.

    Raises:
        InputRefused: the machine has no front camera.
        ValueError: the network's weights are missing.
    """
    if kind == PERFECT:
        return PerfectDetector(plant)
    check_camera(profile)
    surveyed = surveyed_profile(profile, plant.world.truth, CAMERA, seed)
    source = RigCamera(CameraRig(plant.world, profile, plant.world.truth, seed), CAMERA)
    segment: Segmentation
    localizer: LogLocalizer
    if kind == "ours":
        segment, localizer = LogSegmenter().segment, CylinderLocalizer(surveyed, SURVEYED_BY_GNSS)
    else:
        segment, localizer = BoxSegmenter().segment, PaperBLocalizer()
    return FrontCameraDetector(DrivingLogDetector(surveyed, CAMERA, source, segment, localizer), manager)
