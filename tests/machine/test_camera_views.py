"""The cameras see their work area: projection of the relevant points into their pictures."""

from __future__ import annotations

import numpy as np
import pytest

from machine.geometry.carrier import pivot_height_m
from machine.geometry.optics import BODY_FROM_OPTICAL, rpy_matrix
from machine.loading.profile_file import load_profile
from machine.profile import Camera

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")


def pixel(camera: Camera, point: tuple[float, ...], origin=(0.0, 0.0, 0.0), link=None) -> tuple[float, float, float]:
    """(u, v, depth) of a point; ``origin`` and ``link`` (rotation) place the camera's link."""
    link = np.eye(3) if link is None else link
    optical = link @ rpy_matrix(camera.rpy_rad) @ BODY_FROM_OPTICAL
    eye = np.array(origin) + link @ np.array(camera.position_m)
    x, y, z = optical.T @ (np.array(point) - eye)
    return camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px, z


def is_seen(camera: Camera, seen: tuple[float, float, float], margin_px: float = 0.0) -> bool:
    u, v, z = seen
    across = margin_px <= u <= camera.width_px - margin_px and margin_px <= v <= camera.height_px - margin_px
    return across and camera.depth_min_m < z < camera.depth_max_m


def stick_frame(q: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(origin, rotation) of the stick of palms_471 in the base frame (docs/reference/machines.md section 1.1)."""
    mast, boom = rpy_matrix((0.0, 0.0, q[0])), rpy_matrix((q[1], 0.0, q[0]))
    origin = mast @ np.array([0.0, -0.0601374, 0.26881 + 1.09553]) + boom @ np.array([0.0, 3.04904, -0.00649])
    return origin, boom @ rpy_matrix((q[2], 0.0, 0.0))


def test_from_home_the_stick_camera_sees_the_whole_pick_area():
    camera = PALMS.cameras["stick"]
    (x, y), half = PALMS.workspace.pick_center_m, PALMS.workspace.pick_half_size_m
    place = stick_frame((0.0, 0.75, -1.6))
    for dx in (-half, 0.0, half):
        for dy in (-half, 0.0, half):
            assert is_seen(camera, pixel(camera, (x + dx, y + dy, PALMS.workspace.ground_z_m), *place), 40)
    # What is farther off is higher in the picture, what is to the left is further left.
    near, far = (pixel(camera, (0.0, d, -1.39), *place) for d in (4.0, 5.0))
    left = pixel(camera, (-1.0, 4.0, -1.39), *place)
    assert far[1] < near[1] and left[0] < near[0]


@pytest.mark.parametrize("q", [(0.4, 0.35, -1.5), (0.4, 0.55, -1.75), (0.0, 0.2, -1.2)])
def test_at_work_the_stick_camera_sees_the_ground_under_the_grapple_and_ahead_of_it(q):
    camera, place = PALMS.cameras["stick"], stick_frame(q)
    pin = place[0] + place[1] @ np.array([0.0, 2.8, 0.0])  # hanger pin, telescope half a metre out
    under = (pin[0], pin[1], PALMS.workspace.ground_z_m)
    assert is_seen(camera, pixel(camera, under, *place), 40)


def test_the_virtual_camera_looks_straight_down_from_3_m_with_y_up_in_the_picture():
    camera = PALMS.cameras["d435"]
    x, y = PALMS.workspace.pick_center_m
    height = camera.position_m[2] - PALMS.workspace.ground_z_m
    assert 3.0 < height < 3.3
    u, v, depth = pixel(camera, (x, y, PALMS.workspace.ground_z_m))
    assert (u, v, depth) == pytest.approx((camera.cx_px, camera.cy_px, height))
    right, up = pixel(camera, (x + 1, y, -1.39)), pixel(camera, (x, y + 1, -1.39))
    assert right[0] > u and right[1] == pytest.approx(v)
    assert up[1] < v and up[0] == pytest.approx(u)


@pytest.mark.parametrize("ahead_m", [4.0, 5.0, 6.0, 8.0])
def test_the_front_camera_sees_a_log_4_to_8_m_ahead_of_the_front_axle(ahead_m):
    camera, carrier = AORO.cameras["front"], AORO.carrier
    assert carrier is not None
    ground = -pivot_height_m(carrier, carrier.arm_transport_m)
    for y in (-1.0, 0.0, 1.0):
        seen = pixel(camera, (carrier.front_axle_m + ahead_m, y, ground + 0.12))
        assert is_seen(camera, seen, 60), "a 2 m log across the way"
        # A log of 0.25 m is some 20 pixels thick at least.
        assert camera.fx_px * 0.25 / seen[2] > 15.0
    # The strip beside the way, where the crane picks, is seen from farther off.
    side = pixel(camera, (carrier.front_axle_m + 6.0, AORO.workspace.pick_center_m[1], ground))
    assert is_seen(camera, side)
