"""Frames that cannot be one are refused with a sentence; estimates keep their meaning when turned round."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.perception.log_list.estimate import END, START, LogEstimate, across
from autonomy.perception.camera.frame import RgbdFrame, RgbdFrameError, Pose, check, rescaled
from machine.geometry.optics import Intrinsics, rpy_matrix

PIN = Intrinsics(64, 48, 40.0, 40.0, 31.5, 23.5)
GOOD = RgbdFrame("front", 1, np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 3.0, np.float32), PIN)


def test_a_good_frame_passes_and_its_depth_can_be_rescaled() -> None:
    check(GOOD)
    assert rescaled(GOOD, 1.5).depth_m[0, 0] == pytest.approx(2.0)
    assert rescaled(GOOD, 1.5).depth_m.dtype == np.float32


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth_m": np.zeros((0, 0), np.float32), "rgb": np.zeros((0, 0, 3), np.uint8)}, "is empty"),
        ({"depth_m": np.full((48, 64), np.nan, np.float32)}, "no depth anywhere"),
        ({"depth_m": np.zeros((48, 64), np.float32)}, "unknown depth must be NaN"),
        ({"depth_m": np.full((48, 64), 3000, np.uint16)}, "not floating metres"),
        ({"rgb": np.zeros((24, 32, 3), np.uint8)}, "register depth"),
        ({"rgb": np.zeros((48, 64, 3), np.float32)}, "uint8"),
        ({"intrinsics": replace(PIN, width_px=1280)}, "intrinsics are for 1280"),
        ({"intrinsics": replace(PIN, fx_px=0.0)}, "no pinhole's"),
        ({"intrinsics": replace(PIN, fy_px=float("nan"))}, "no pinhole's"),
        ({"intrinsics": replace(PIN, fx_px=4000.0, fy_px=4000.0)}, "fit no picture"),
        ({"intrinsics": replace(PIN, cx_px=640.0)}, "outside the picture"),
    ],
)
def test_what_cannot_be_a_frame_is_refused_with_a_sentence(change: dict, words: str) -> None:
    with pytest.raises(RgbdFrameError, match=words):
        check(replace(GOOD, **change))


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0))
def test_a_pose_goes_there_and_back(roll: float, pitch: float, yaw: float) -> None:
    pose = Pose(np.array([1.0, -2.0, 0.5]), rpy_matrix((roll, pitch, yaw)))
    points = np.array([[0.3, 0.2, 4.0], [0.0, 0.0, 0.0]])
    assert np.allclose(pose.to_optical(pose.to_base(points)), points, atol=1e-12)


def test_turning_a_log_round_changes_nothing_that_can_be_seen() -> None:
    axis = np.array([0.6, 0.7, 0.2])
    axis /= np.linalg.norm(axis)
    rng = np.random.default_rng(1)
    root = rng.normal(size=(7, 7))
    log = LogEstimate(np.array([3.0, 1.0, 0.2]), axis, 2.0, 0.25, root @ root.T, (True, False), 0.9)
    turned = log.reversed()
    assert np.allclose(turned.ends_m, log.ends_m[::-1]) and turned.ends_seen == (False, True)
    assert turned.length_sigma_m() == pytest.approx(log.length_sigma_m())
    assert np.allclose(turned.position_sigma_m(), log.position_sigma_m())
    assert turned.covariance[START, START] == pytest.approx(log.covariance[END, END])
    # A point beside the end, moved by the same seven errors, is as uncertain either way round.
    spread = []
    for one in (log, turned):
        e1, _ = one.frame()
        sign = 1.0 if e1 @ log.frame()[0] > 0 else -1.0
        reach = one.axis @ (log.ends_m[1] - one.center_m)
        row = np.zeros(7)
        row[0], row[2] = sign, sign * reach
        spread.append(row @ one.covariance @ row)
    assert spread[0] == pytest.approx(spread[1])
    assert np.allclose(turned.reversed().covariance, log.covariance)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_directions_across_are_square_to_the_axis(x: float, y: float, z: float) -> None:
    axis = np.array([x, y, z + 1e-3])
    if np.linalg.norm(axis) < 1e-2:
        return
    axis /= np.linalg.norm(axis)
    first, second = across(axis)
    assert np.allclose(np.stack([first, second, axis]) @ np.stack([first, second, axis]).T, np.eye(3), atol=1e-9)
    assert np.linalg.det(np.stack([axis, first, second])) == pytest.approx(1.0)


def test_an_estimate_becomes_what_the_planner_takes() -> None:
    log = LogEstimate(np.array([3.0, 1.0, 0.2]), np.array([1.0, 0.0, 0.0]), 2.0, 0.25, np.eye(7))
    seen = log.observation(4)
    assert (seen.id, seen.center_m, seen.axis) == (4, (3.0, 1.0, 0.2), (1.0, 0.0, 0.0))
    assert (seen.length_m, seen.diameter_m) == (2.0, 0.25)
