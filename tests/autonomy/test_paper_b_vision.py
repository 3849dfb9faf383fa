"""Paper B's vision node: box, 8 x 8 mean, pinhole, running average; its miss end-on in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.papers import (
    BoxDetector,
    BoxSegmenter,
    RunningAverage,
    box_in_picture,
    end_on_error_m,
    position_in_box,
)
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics

PIN = Intrinsics(1280, 720, 530.0, 530.0, 640.0, 360.0)
FRAME = RgbdFrame("front", 0, np.zeros((720, 1280, 3), np.uint8), np.full((720, 1280), 5.0, np.float32), PIN)
STILL = Pose(np.array([1.0, 2.0, 3.0]), BODY_FROM_OPTICAL)


def test_the_corners_of_the_letterbox_are_those_of_the_picture() -> None:
    assert box_in_picture((0, 133, 608, 475), PIN) == pytest.approx((0.0, 0.0, 1280.0, 720.0))
    assert box_in_picture((304, 304, 304, 304), PIN) == pytest.approx((640.0, 360.0, 640.0, 360.0))


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
    box = (636.5, 356.5, 644.5, 364.5)  # around the middle of the picture
    for z in (4.9, 5.0, 5.1):
        average.add(replace(FRAME, depth_m=np.full((720, 1280), z, np.float32)), STILL, [box])
    average.add(replace(FRAME, depth_m=np.full((720, 1280), 8.0, np.float32)), STILL, [box])
    first, second = average.positions_m()
    assert first == pytest.approx((6.0, 2.0, 3.0), abs=1e-6) and second == pytest.approx((9.0, 2.0, 3.0), abs=1e-6)


def test_a_radius_is_added_along_the_line_of_sight() -> None:
    average = RunningAverage(radius_m=0.125)
    average.add(FRAME, STILL, [(636.5, 356.5, 644.5, 364.5)])
    assert average.positions_m()[0] == pytest.approx((6.125, 2.0, 3.0), abs=1e-6)


@given(st.floats(3.0, 6.0), st.floats(1.0, 3.0), st.floats(2.0, 3.0), st.floats(0.1, 0.4), st.floats(0.0, 0.6))
def test_the_closed_form_agrees_with_a_ray_through_the_middle_of_the_box(
    near: float, length: float, height: float, diameter: float, pitch: float
) -> None:
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


def test_the_error_for_a_two_metre_log_end_on_is_decimetres() -> None:
    back, high = end_on_error_m(4.2, 6.2, 2.4, 0.25)
    harmonic = 0.5 * (4.2 + 6.2) - 2.0 / (1.0 / 4.2 + 1.0 / 6.2)
    assert harmonic == pytest.approx(0.19, abs=0.005)
    assert back > harmonic and 0.3 < math.hypot(back, high) < 0.6


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
