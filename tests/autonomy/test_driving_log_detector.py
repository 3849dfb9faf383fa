"""The front camera of a driving machine detects a drawn log in its place, also when the machine is bent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from autonomy.perception.camera.frame import Pose, RgbdFrame, optical_pose
from autonomy.perception.driving_log_detector import (
    MAX_RANGE_M,
    MIN_HITS_WITH_HIDDEN_END,
    CylinderLocalizer,
    DrivingLogDetector,
    PaperBLocalizer,
)
from autonomy.perception.log_list import END, HIDDEN_END_SIGMA_M, START, LogObservation, unpack_covariance
from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile
from runtime.errors import LinkError

PROFILE = load_profile("aoro_fc8")
PIN = intrinsics(PROFILE.cameras["front"]).scaled(0.5)
Q = (0.0, 1.2, -2.4, 0.1, 0.0)
RADIUS_M, LENGTH_M = 0.125, 2.0


def base(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    """The crane's base in the plane."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return Pose(np.array([x_m, y_m, 1.5]), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


@dataclass
class Mask:
    mask: np.ndarray
    score: float


class Scene:
    """One log on level ground at z = 0 of the plane, with a camera and a segmentation of it."""

    def __init__(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        self.center = np.array([x_m, y_m, RADIUS_M])
        self.axis = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
        self.pose: Pose | None = None
        self.mask = np.zeros((PIN.height_px, PIN.width_px), bool)
        self.failure = ""
        self.count = 0
        self.score = 0.9

    def stand(self, at: Pose, articulation_rad: float) -> None:
        mount = optical_pose(PROFILE, PROFILE.cameras["front"], Q, articulation_rad)
        self.pose = Pose(at.to_base(mount.position_m), at.rotation @ mount.rotation)

    def frame(self) -> RgbdFrame | None:
        if self.failure:
            raise LinkError("camera-source.disconnected", self.failure)
        assert self.pose is not None
        self.count += 1
        u, v = np.meshgrid(np.arange(PIN.width_px), np.arange(PIN.height_px))
        ahead = np.ones(u.shape)
        rays = np.stack([(u - PIN.cx_px) / PIN.fx_px, (v - PIN.cy_px) / PIN.fy_px, ahead], axis=-1)
        rays = rays @ self.pose.rotation.T
        eye = self.pose.position_m
        depth = np.where(rays[..., 2] < -1e-3, -eye[2] / np.minimum(rays[..., 2], -1e-3), np.nan)
        across = rays - (rays @ self.axis)[..., None] * self.axis
        off = eye - self.center - ((eye - self.center) @ self.axis) * self.axis
        a, b = np.sum(across**2, axis=-1), across @ off
        root = b * b - a * (off @ off - RADIUS_M**2)
        near = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        along = (eye + near[..., None] * rays - self.center) @ self.axis
        self.mask = (root > 0.0) & (near > 0.0) & (np.abs(along) < 0.5 * LENGTH_M)
        depth = np.where(self.mask, near, np.where(depth < 20.0, depth, np.nan)).astype(np.float32)
        return RgbdFrame("front", self.count, np.full((*depth.shape, 3), 90, np.uint8), depth, PIN)

    def close(self) -> None: ...

    def segment(self, frame: RgbdFrame) -> list[Mask]:
        return [Mask(self.mask, self.score)]


def detect(field: Scene, at: Pose, articulation_rad: float, localizer, times: int = 3) -> tuple[LogObservation, ...]:
    detector = DrivingLogDetector(PROFILE, "front", field, field.segment, localizer)
    field.stand(at, articulation_rad)
    for _ in range(times):
        logs = detector.detect(at, Q, articulation_rad)
    assert logs is not None and not detector.problem
    return logs


def plane_error_m(log: LogObservation, at: Pose, field: Scene) -> float:
    return float(np.linalg.norm(at.to_base(np.array(log.center_m)) - field.center))


@pytest.mark.parametrize("articulation_rad", [0.0, 0.4])
@pytest.mark.parametrize("yaw_rad", [0.0, 1.2])
def test_the_cylinder_localizer_is_accurate_to_centimetres_in_any_direction(
    articulation_rad: float, yaw_rad: float
) -> None:
    at = base(10.0, -5.0, yaw_rad + math.pi)  # the base looks backwards
    ahead = yaw_rad + articulation_rad
    field = Scene(10.0 + 9.0 * math.cos(ahead), -5.0 + 9.0 * math.sin(ahead), ahead + 1.3)
    (log,) = detect(field, at, articulation_rad, CylinderLocalizer(PROFILE))
    assert plane_error_m(log, at, field) < 0.04
    assert abs(np.dot(at.rotation @ np.array(log.axis), field.axis)) > math.cos(math.radians(3.0))
    assert log.diameter_m == pytest.approx(0.25, abs=0.03) and log.covariance is not None


def test_the_paper_b_localizer_gives_a_point_with_the_size_of_a_mean_log() -> None:
    at = base(0.0, 0.0, math.pi)
    field = Scene(8.0, 0.5, 1.5)
    (log,) = detect(field, at, 0.0, PaperBLocalizer())
    assert plane_error_m(log, at, field) < 0.15
    assert (log.length_m, log.diameter_m) == (2.0, 0.25) and log.axis[2] == pytest.approx(0.0)
    assert (at.rotation @ np.array(log.axis))[:2] == pytest.approx((1.0, 0.0)), "a box tells no axis: that of the view"


def test_the_paper_b_localizer_falls_short_of_a_log_seen_end_on_as_in_the_paper() -> None:
    at = base(0.0, 0.0, math.pi)
    across, along = Scene(7.5, 0.0, math.pi / 2), Scene(7.5, 0.0, 0.0)
    errors = [plane_error_m(detect(f, at, 0.0, PaperBLocalizer())[0], at, f) for f in (across, along)]
    assert errors[0] < 0.1 < errors[1] < 0.5


@pytest.mark.parametrize("localizer", [PaperBLocalizer(), CylinderLocalizer(PROFILE)], ids=["paper_b", "ours"])
def test_masks_with_a_low_score_are_not_logs(localizer) -> None:
    """Sunlight between boom and stick in the machine's shadow was segmented 12 times with scores of 0.03 to 0.19."""
    at, field = base(0.0, 0.0, math.pi), Scene(8.0, 0.5, 1.5)
    field.score = 0.19
    assert detect(field, at, 0.0, localizer, 2 * MIN_HITS_WITH_HIDDEN_END) == ()


@pytest.mark.parametrize("localizer", [PaperBLocalizer(), CylinderLocalizer(PROFILE)], ids=["paper_b", "ours"])
def test_a_log_beyond_the_maximum_range_is_not_reported(localizer) -> None:
    at = base(0.0, 0.0, math.pi)
    assert detect(Scene(MAX_RANGE_M + 8.0, 0.0, 1.5), at, 0.0, localizer) == ()


def test_a_log_cut_off_by_the_edge_of_the_picture_is_reported_only_after_many_pictures() -> None:
    at = base(0.0, 0.0, math.pi)
    beside = Scene(4.9, 2.6, 0.0)
    assert detect(beside, at, 0.0, CylinderLocalizer(PROFILE), MIN_HITS_WITH_HIDDEN_END - 1) == ()
    assert beside.mask.any() and beside.mask[:, 0].any(), "the edge of the picture cuts it"
    assert len(detect(Scene(7.5, 0.5, 1.5), at, 0.0, CylinderLocalizer(PROFILE), MIN_HITS_WITH_HIDDEN_END - 1)) == 1


def test_an_end_that_no_picture_shows_stays_unknown_however_many_pictures_there_are() -> None:
    (log,) = detect(Scene(4.9, 2.6, 0.0), base(0.0, 0.0, math.pi), 0.0, CylinderLocalizer(PROFILE), 60)
    assert log.covariance is not None
    spread = unpack_covariance(log.covariance)
    seen_m, unknown_m = sorted(math.sqrt(spread[end, end]) for end in (START, END))
    assert unknown_m > HIDDEN_END_SIGMA_M > 5.0 * seen_m


def test_a_failed_camera_is_reported_and_gives_no_logs() -> None:
    field = Scene(9.0, 0.0, 1.5)
    field.failure = "the camera fell off"
    detector = DrivingLogDetector(PROFILE, "front", field, field.segment, PaperBLocalizer())
    assert detector.detect(base(0.0, 0.0, 0.0), Q, 0.0) is None and detector.problem == "the camera fell off"
    with pytest.raises(KeyError):
        DrivingLogDetector(PROFILE, "rear view", field, field.segment, PaperBLocalizer())


def test_a_picture_of_a_load_is_measured_alone_and_starts_no_track() -> None:
    at, field, localizer = base(0.0, 0.0, math.pi), Scene(8.0, 0.5, 1.5), CylinderLocalizer(PROFILE)
    detector = DrivingLogDetector(PROFILE, "front", field, field.segment, localizer)
    field.stand(at, 0.0)
    for _ in range(MIN_HITS_WITH_HIDDEN_END):
        (load,) = detector.detect(at, Q, 0.0, load=True) or ()
    assert plane_error_m(load, at, field) < 0.1 and load.covariance is None
    assert detector.detect(at, Q, 0.0) == (), "a log of one picture is none yet"
