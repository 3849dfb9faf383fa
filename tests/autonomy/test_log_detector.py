"""The log detector takes pictures while the crane is at rest, and reports problems."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.log_detector import MAX_REQUEST_GAP_NS, LogDetector
from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile
from runtime.errors import LinkError

PROFILE = load_profile("palms_471")
CAMERA = "stick"
Q = (0.0, 0.6, -1.2, 0.3, 0.0)
STEP_NS = 250_000_000


@dataclass
class Source:
    """Delivers pictures of an empty, level world, or fails."""

    failure: str = ""
    problem: str = ""
    count: int = field(default=0)

    def frame(self) -> RgbdFrame | None:
        if self.failure:
            raise LinkError("camera-source.disconnected", self.failure)
        if self.problem:
            return None
        self.count += 1
        pin = intrinsics(PROFILE.cameras[CAMERA])
        shape = (pin.height_px, pin.width_px)
        return RgbdFrame(CAMERA, self.count, np.full((*shape, 3), 90, np.uint8), np.full(shape, 4.0, np.float32), pin)

    def close(self) -> None: ...


def detector_of(source: Source) -> LogDetector:
    return LogDetector(PROFILE, CAMERA, source, lambda frame: ())


def test_the_first_request_only_gives_the_joints_and_the_second_gets_a_detection() -> None:
    source = Source()
    detector = detector_of(source)
    assert detector.detect(Q, STEP_NS) is None and source.count == 0
    assert detector.detect(Q, 2 * STEP_NS) == () and source.count == 1
    assert not detector.problem


def test_there_is_no_detection_while_the_crane_moves_or_after_a_long_gap() -> None:
    source = Source()
    detector = detector_of(source)
    detector.detect(Q, STEP_NS)
    moved = (Q[0] + 0.02, *Q[1:])
    assert detector.detect(moved, 2 * STEP_NS) is None
    assert detector.detect(moved, 2 * STEP_NS + MAX_REQUEST_GAP_NS) is None
    assert detector.detect(moved, 3 * STEP_NS + MAX_REQUEST_GAP_NS) == ()
    assert source.count == 1


def test_an_unmeasured_joint_prevents_detection_only_when_the_camera_pose_depends_on_it() -> None:
    blind = detector_of(Source())
    for k in (1, 2):
        seen = blind.detect((*Q[:4], math.nan), k * STEP_NS)
    assert seen == ()
    for k in (3, 4):
        seen = blind.detect((Q[0], math.nan, *Q[2:]), k * STEP_NS)
    assert seen is None and blind.problem


@pytest.mark.parametrize("source", [Source(failure="unplugged"), Source(problem="unplugged")])
def test_a_camera_without_pictures_is_reported_and_gives_no_log(source: Source) -> None:
    detector = detector_of(source)
    detector.detect(Q, STEP_NS)
    assert detector.detect(Q, 2 * STEP_NS) is None
    assert detector.problem == "unplugged"
