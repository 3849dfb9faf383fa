"""Pinholes, mounts and resizing."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.geometry.optics import Intrinsics, pinhole, rpy_matrix
from sim.camera.geometry import look_at, mount_view, orbit, quaternion_matrix
from sim.errors import PlantError
from sim.geometry import rpy_quaternion
from tests.codes import coded

angles = st.floats(-1.5, 1.5)


@given(angles, angles, angles)
def test_the_rpy_matrix_matches_the_quaternion(roll: float, pitch: float, yaw: float) -> None:
    assert np.allclose(rpy_matrix((roll, pitch, yaw)), quaternion_matrix(rpy_quaternion(roll, pitch, yaw)), atol=1e-12)


@given(st.floats(0.0, 1279.0), st.floats(0.0, 719.0), st.floats(0.3, 20.0))
def test_deprojecting_inverts_projecting(u: float, v: float, z: float) -> None:
    pin = Intrinsics(1280, 720, 530.0, 530.0, 640.0, 360.0)
    assert np.allclose(pin.project(pin.deproject(u, v, z)[None]), [[u, v]], atol=1e-9)


@given(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(0.5, 20.0))
def test_a_letterbox_shifts_a_ray_by_its_bars(x: float, y: float, z: float) -> None:
    pin = Intrinsics(1280, 720, 530.0, 530.0, 640.0, 360.0)
    box = pin.letterbox(608)
    (native,) = pin.project(np.array([[x, y, z]]))
    (small,) = box.outer.project(np.array([[x, y, z]]))
    assert (box.outer.width_px, box.outer.height_px, box.inner.height_px) == (608, 608, 342)
    assert np.allclose((small - (0, box.top_px) + 0.5) / (native + 0.5), 608 / 1280, rtol=1e-9)


def test_letterbox_bars_are_black_above_and_below() -> None:
    box = Intrinsics(1280, 720, 530.0, 530.0, 640.0, 360.0).letterbox(608)
    square = box.pad(np.full((342, 608, 3), 9, np.uint8), 0)
    assert square.shape == (608, 608, 3)
    assert square[:133].max() == 0 and square[-133:].max() == 0 and square[133:-133].min() == 9


def test_a_square_view_keeps_the_middle() -> None:
    pin = Intrinsics(1280, 720, 530.0, 530.0, 639.5, 359.5).square(360)
    assert (pin.width_px, pin.height_px, pin.cx_px, pin.cy_px) == (360, 360, 179.5, 179.5)


def test_a_free_camera_looks_at_its_target_with_a_level_horizon() -> None:
    view = look_at((3.0, -2.0, 4.0), (0.5, 1.0, 0.2), pinhole(640, 480, 1.0))
    ((u, v),) = view.intrinsics.project(view.to_optical(np.array([[0.5, 1.0, 0.2]])))
    assert (u, v) == pytest.approx((319.5, 239.5))
    assert view.rotation[2, 0] == pytest.approx(0.0)
    assert np.linalg.det(view.rotation) == pytest.approx(1.0)
    with pytest.raises(PlantError, check=coded("camera.no-horizon")):
        look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), pinhole(640, 480, 1.0))


def test_an_orbit_view_is_placed_by_its_angles() -> None:
    view = orbit((1.0, 2.0, 0.0), 5.0, math.pi / 2, math.radians(30.0), pinhole(64, 48, 1.0))
    assert view.position_m == pytest.approx((1.0, 2.0 + 5.0 * math.cos(math.radians(30.0)), 2.5))


def test_a_positive_pitch_looks_down_and_the_mount_error_is_in_the_body_frame() -> None:
    pin = pinhole(64, 48, 1.0)
    pose = ((1.0, 2.0, 3.0), rpy_quaternion(0.0, 0.0, math.pi / 2))
    true = mount_view(pose, pin, (0.5, 0.0, 0.0), (0.0, 0.3, 0.0))
    assert true.position_m == pytest.approx((1.0, 2.5, 3.0))
    assert true.rotation[:, 2] == pytest.approx((0.0, math.cos(0.3), -math.sin(0.3)))
    off = mount_view(pose, pin, (0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.02, 0.0, 0.0), (0.0, 0.02, 0.0))
    assert off.position_m - true.position_m == pytest.approx(0.02 * true.rotation[:, 2])
    assert off.rotation[:, 2] == pytest.approx((0.0, math.cos(0.32), -math.sin(0.32)))
