"""Invalid frames are refused; poses and estimates are consistent."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception.camera.frame import Pose, RgbdFrame, check_frame, rescaled
from autonomy.perception.log_list import LogEstimate, across
from machine.geometry.optics import Intrinsics, rpy_matrix
from runtime.errors import InputRefused
from tests.codes import coded

PIN = Intrinsics(64, 48, 40.0, 40.0, 31.5, 23.5)
GOOD = RgbdFrame("front", 1, np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 3.0, np.float32), PIN)


def test_a_good_frame_passes_and_its_depth_can_be_rescaled() -> None:
    check_frame(GOOD)
    assert rescaled(GOOD, 1.5).depth_m[0, 0] == pytest.approx(2.0)
    assert rescaled(GOOD, 1.5).depth_m.dtype == np.float32


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"depth_m": np.zeros((0, 0), np.float32), "rgb": np.zeros((0, 0, 3), np.uint8)}, "no-depth-array"),
        ({"depth_m": np.full((48, 64), np.nan, np.float32)}, "depth-unknown"),
        ({"depth_m": np.zeros((48, 64), np.float32)}, "depth-not-positive"),
        ({"depth_m": np.full((48, 64), 3000, np.uint16)}, "bad-depth-type"),
        ({"rgb": np.zeros((24, 32, 3), np.uint8)}, "bad-colour"),
        ({"rgb": np.zeros((48, 64, 3), np.float32)}, "bad-colour"),
        ({"intrinsics": replace(PIN, width_px=1280)}, "bad-size"),
        ({"intrinsics": replace(PIN, fx_px=0.0)}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, fy_px=float("nan"))}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, fx_px=4000.0, fy_px=4000.0)}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, cx_px=640.0)}, "bad-intrinsics"),
    ],
)
def test_an_invalid_frame_is_refused(change: dict, code: str) -> None:
    with pytest.raises(InputRefused, check=coded(f"frame.{code}")):
        check_frame(replace(GOOD, **change))


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0))
def test_a_pose_transforms_there_and_back(roll: float, pitch: float, yaw: float) -> None:
    pose = Pose(np.array([1.0, -2.0, 0.5]), rpy_matrix((roll, pitch, yaw)))
    points = np.array([[0.3, 0.2, 4.0], [0.0, 0.0, 0.0]])
    assert np.allclose(pose.to_optical(pose.to_base(points)), points, atol=1e-12)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_directions_across_are_orthogonal_to_the_axis(x: float, y: float, z: float) -> None:
    axis = np.array([x, y, z + 1e-3])
    if np.linalg.norm(axis) < 1e-2:
        return
    axis /= np.linalg.norm(axis)
    first, second = across(axis)
    assert np.allclose(np.stack([first, second, axis]) @ np.stack([first, second, axis]).T, np.eye(3), atol=1e-9)
    assert np.linalg.det(np.stack([axis, first, second])) == pytest.approx(1.0)


def test_an_estimate_becomes_an_observation() -> None:
    log = LogEstimate(np.array([3.0, 1.0, 0.2]), np.array([1.0, 0.0, 0.0]), 2.0, 0.25, np.eye(7))
    seen = log.observation(4)
    assert (seen.id, seen.center_m, seen.axis) == (4, (3.0, 1.0, 0.2), (1.0, 0.0, 0.0))
    assert (seen.length_m, seen.diameter_m) == (2.0, 0.25)
