"""The detector that looks while the crane rests, the one ahead of a driving machine, and paper B's vision node."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception.camera.frame import Pose, RgbdFrame, optical_pose
from autonomy.perception.driving_log_detector import (
    MAX_RANGE_M,
    MIN_HITS_WITH_HIDDEN_END,
    CylinderLocalizer,
    DrivingLogDetector,
    PaperBLocalizer,
)
from autonomy.perception.log_detector import MAX_REQUEST_GAP_NS, LogDetector
from autonomy.perception.log_list import END, HIDDEN_END_SIGMA_M, START, LogObservation, unpack_covariance
from autonomy.perception.papers import (
    BoxDetector,
    BoxSegmenter,
    RunningAverage,
    box_in_picture,
    end_on_error_m,
    position_in_box,
)
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, intrinsics
from machine.loading.profile_file import load_profile
from runtime.errors import LinkError
from tests.autonomy.mapped_logs import base

LOADER = load_profile("palms_471")
CAMERA = "stick"
JOINTS = (0.0, 0.6, -1.2, 0.3, 0.0)
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
        pin = intrinsics(LOADER.cameras[CAMERA])
        shape = (pin.height_px, pin.width_px)
        return RgbdFrame(CAMERA, self.count, np.full((*shape, 3), 90, np.uint8), np.full(shape, 4.0, np.float32), pin)

    def close(self) -> None: ...


def detector_of(source: Source) -> LogDetector:
    return LogDetector(LOADER, CAMERA, source, lambda frame: ())


def test_the_first_request_only_gives_the_joints_and_the_second_gets_a_detection() -> None:
    source = Source()
    detector = detector_of(source)
    assert detector.detect(JOINTS, STEP_NS) is None and source.count == 0
    assert detector.detect(JOINTS, 2 * STEP_NS) == () and source.count == 1
    assert not detector.problem


def test_there_is_no_detection_while_the_crane_moves_or_after_a_long_gap() -> None:
    source = Source()
    detector = detector_of(source)
    detector.detect(JOINTS, STEP_NS)
    moved = (JOINTS[0] + 0.02, *JOINTS[1:])
    assert detector.detect(moved, 2 * STEP_NS) is None
    assert detector.detect(moved, 2 * STEP_NS + MAX_REQUEST_GAP_NS) is None
    assert detector.detect(moved, 3 * STEP_NS + MAX_REQUEST_GAP_NS) == ()
    assert source.count == 1


def test_an_unmeasured_joint_prevents_detection_only_when_the_camera_pose_depends_on_it() -> None:
    blind = detector_of(Source())
    rotator_unknown, lift_unknown = (*JOINTS[:4], math.nan), (JOINTS[0], math.nan, *JOINTS[2:])
    assert [blind.detect(rotator_unknown, k * STEP_NS) for k in (1, 2)] == [None, ()]
    assert [blind.detect(lift_unknown, k * STEP_NS) for k in (3, 4)] == [None, None] and blind.problem


@pytest.mark.parametrize("source", [Source(failure="unplugged"), Source(problem="unplugged")])
def test_a_camera_without_pictures_is_reported_and_gives_no_log(source: Source) -> None:
    detector = detector_of(source)
    detector.detect(JOINTS, STEP_NS)
    assert detector.detect(JOINTS, 2 * STEP_NS) is None
    assert detector.problem == "unplugged"


# -- ahead of a driving machine
PROFILE = load_profile("aoro_fc8")
PIN = intrinsics(PROFILE.cameras["front"]).scaled(0.5)
Q = (0.0, 1.2, -2.4, 0.1, 0.0)
RADIUS_M, LENGTH_M = 0.125, 2.0


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
def test_the_cylinder_localizer_is_accurate_to_centimetres_in_any_direction(articulation_rad, yaw_rad) -> None:
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
def test_masks_with_a_low_score_and_logs_out_of_range_are_not_reported(localizer) -> None:
    """Sunlight between boom and stick in the machine's shadow was segmented 12 times with scores of 0.03 to 0.19."""
    at, field = base(0.0, 0.0, math.pi), Scene(8.0, 0.5, 1.5)
    field.score = 0.19
    assert detect(field, at, 0.0, localizer, 2 * MIN_HITS_WITH_HIDDEN_END) == ()
    assert detect(Scene(MAX_RANGE_M + 8.0, 0.0, 1.5), at, 0.0, localizer) == ()


def test_a_log_cut_off_by_the_edge_of_the_picture_is_reported_only_after_many_pictures() -> None:
    at = base(0.0, 0.0, math.pi)
    beside = Scene(4.9, 2.6, 0.0)
    assert detect(beside, at, 0.0, CylinderLocalizer(PROFILE), MIN_HITS_WITH_HIDDEN_END - 1) == ()
    assert beside.mask.any() and beside.mask[:, 0].any(), "the edge of the picture cuts it"
    assert len(detect(Scene(7.5, 0.5, 1.5), at, 0.0, CylinderLocalizer(PROFILE), MIN_HITS_WITH_HIDDEN_END - 1)) == 1


def test_an_end_that_no_picture_shows_stays_unknown_however_many_pictures_there_are() -> None:
    (log,) = detect(Scene(4.9, 2.6, 0.0), base(0.0, 0.0, math.pi), 0.0, CylinderLocalizer(PROFILE), 60)
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


# -- paper B: box, 8 x 8 mean, pinhole, running average; its miss end-on in closed form
WIDE = Intrinsics(1280, 720, 530.0, 530.0, 640.0, 360.0)
FRAME = RgbdFrame("front", 0, np.zeros((720, 1280, 3), np.uint8), np.full((720, 1280), 5.0, np.float32), WIDE)
STILL = Pose(np.array([1.0, 2.0, 3.0]), BODY_FROM_OPTICAL)
MIDDLE = (636.5, 356.5, 644.5, 364.5)
"""A box around the middle of the picture."""


def test_the_corners_of_the_letterbox_are_those_of_the_picture() -> None:
    assert box_in_picture((0, 133, 608, 475), WIDE) == pytest.approx((0.0, 0.0, 1280.0, 720.0))
    assert box_in_picture((304, 304, 304, 304), WIDE) == pytest.approx((640.0, 360.0, 640.0, 360.0))


def test_depth_is_the_mean_of_eight_by_eight_pixels_in_the_middle_of_the_box() -> None:
    depth_m = np.full((720, 1280), 9.0, np.float32)
    depth_m[296:304, 496:504] = np.square(np.arange(64, dtype=np.float32)).reshape(8, 8) / 4096.0 + 4.0
    point = position_in_box(replace(FRAME, depth_m=depth_m), (450.0, 280.0, 550.0, 320.0))
    assert point is not None and point[2] == pytest.approx(4.0 + np.mean(np.arange(64) ** 2) / 4096.0)
    assert point[:2] == pytest.approx(((499.5 - 640.0) / 530.0 * point[2], (299.5 - 360.0) / 530.0 * point[2]))


def test_unknown_pixels_are_ignored_and_without_known_ones_there_is_no_position() -> None:
    depth_m = np.full((720, 1280), np.nan, np.float32)
    box = (450.0, 280.0, 550.0, 320.0)
    assert position_in_box(replace(FRAME, depth_m=depth_m), box) is None
    depth_m[300, 500] = 4.0
    point = position_in_box(replace(FRAME, depth_m=depth_m), box)
    assert point is not None and point[2] == 4.0
    assert position_in_box(FRAME, (1400.0, 280.0, 1500.0, 320.0)) is None


def test_estimates_of_a_log_are_averaged_in_the_machines_frame() -> None:
    average = RunningAverage()
    for z in (4.9, 5.0, 5.1, 8.0):
        average.add(replace(FRAME, depth_m=np.full((720, 1280), z, np.float32)), STILL, [MIDDLE])
    first, second = average.positions_m()
    assert first == pytest.approx((6.0, 2.0, 3.0), abs=1e-6) and second == pytest.approx((9.0, 2.0, 3.0), abs=1e-6)


def test_a_radius_is_added_along_the_line_of_sight() -> None:
    average = RunningAverage(radius_m=0.125)
    average.add(FRAME, STILL, [MIDDLE])
    assert average.positions_m()[0] == pytest.approx((6.125, 2.0, 3.0), abs=1e-6)


@given(st.floats(3.0, 6.0), st.floats(1.0, 3.0), st.floats(2.0, 3.0), st.floats(0.1, 0.4), st.floats(0.0, 0.6))
def test_the_closed_form_agrees_with_a_ray_through_the_middle_of_the_box(near, length, height, diameter, pitch) -> None:
    """The same by brute force: project the rims, take the middle, follow the ray to the log."""
    far = near + length

    def row(ahead: float, up: float) -> float:
        c, s = math.cos(pitch), math.sin(pitch)
        down = height - up
        return (down * c - ahead * s) / (ahead * c + down * s)

    middle = 0.5 * (row(near, 0.0) + row(far, diameter))
    c, s = math.cos(pitch), math.sin(pitch)
    way, fall = c - middle * s, s + middle * c  # ahead and down of the ray
    ahead = (height - diameter) / fall * way
    if ahead < near:
        ahead = near
    up = height - ahead * fall / way
    back, high = end_on_error_m(near, far, height, diameter, pitch)
    assert back == pytest.approx(0.5 * (near + far) - ahead, abs=1e-9)
    assert high == pytest.approx(up - 0.5 * diameter, abs=1e-9)


def test_the_boxes_of_a_detector_become_masks_in_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """The letterbox shrinks a picture of 1280 px by 608 / 1280 and puts 133 px of bar above it."""
    shown = []

    def detect(self: BoxDetector, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shown.append(rgb)
        return np.array([[152.0, 209.0, 304.0, 304.0], [0.0, 133.0, 19.0, 152.0]]), np.array([0.9, 0.3])

    monkeypatch.setattr(BoxDetector, "detect", detect)
    rgb = np.zeros((720, 1280, 3), np.uint8)
    rgb[:, 640:] = 200
    (found,) = BoxSegmenter().segment(replace(FRAME, rgb=rgb))
    rows, columns = np.nonzero(found.mask)
    assert found.score == 0.9 and found.mask.shape == (720, 1280)
    assert (columns.min(), columns.max() + 1, rows.min(), rows.max() + 1) == (320, 640, 160, 360)
    assert shown[0].shape == (608, 608, 3) and not shown[0][:133].any() and shown[0][300, 400].tolist() == [200] * 3
