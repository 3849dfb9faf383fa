"""A log that is seen elsewhere, and no longer where it was, is the same one."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.cylinder import Cylinder
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list import LogEstimate
from autonomy.perception.tracking.log_tracker import is_displaced
from machine.geometry.optics import Intrinsics

HEIGHT_M = 4.0
LENGTH_M, RADIUS_M = 2.0, 0.1
PIN = Intrinsics(320, 240, 220.0, 220.0, 159.5, 119.5)
DOWN = Pose(np.array([0.0, 0.0, HEIGHT_M]), np.diag([1.0, -1.0, -1.0]))
"""A camera that looks straight down on a level ground."""

Place = tuple[float, float]
"""Across its axis, and up, of a log along x."""


def picture(*logs: Place, tongs: slice | None = None, length_m: float = LENGTH_M) -> RgbdFrame:
    """Depth of logs over the ground, and of tongs close to the camera in some of the picture's columns."""
    v, u = np.mgrid[: PIN.height_px, : PIN.width_px]
    depth = np.full(u.shape, HEIGHT_M)
    for across, up in logs:
        z = HEIGHT_M - up
        off = -(v - PIN.cy_px) / PIN.fy_px * z - across
        inside = (np.abs(off) < RADIUS_M) & (np.abs((u - PIN.cx_px) / PIN.fx_px * z) < 0.5 * length_m)
        surface = z - np.sqrt(np.maximum(RADIUS_M**2 - off**2, 0.0))
        depth = np.where(inside, np.minimum(depth, surface), depth)
    if tongs is not None:
        depth[:, tongs] = 2.0
    rgb = np.full((*depth.shape, 3), 90, np.uint8)
    return RgbdFrame("stick", 1, rgb, depth.astype(np.float32), PIN)


def log_at(place: Place, x_m: float = 0.0) -> LogEstimate:
    return LogEstimate(np.array([x_m, *place]), np.array([1.0, 0.0, 0.0]), LENGTH_M, 2.0 * RADIUS_M, np.eye(7) * 1e-4)


def fit_at(place: Place, length_m: float = LENGTH_M, radius_m: float = RADIUS_M, x_m: float = 0.0) -> CylinderFit:
    middle, half = DOWN.to_optical(np.array([x_m, *place])), length_m / 2
    body = Cylinder(middle, np.array([1.0, 0.0, 0.0]), -half, half, radius_m)
    return CylinderFit(body, np.eye(7) * 1e-4, (True, True), 1.0, 0.5, np.zeros(7))


LAY = (0.0, RADIUS_M)


@pytest.mark.parametrize("now", [(0.0, 0.6), (0.3, 0.5), (0.6, RADIUS_M)], ids=["lifted", "carried", "rolled away"])
def test_a_log_seen_elsewhere_and_not_in_its_place_is_displaced(now: Place) -> None:
    assert is_displaced(picture(now), DOWN, log_at(LAY), fit_at(now))


def test_a_grapple_over_its_middle_does_not_hide_that_it_is_gone() -> None:
    now = (0.0, 0.6)
    assert is_displaced(picture(now, tongs=slice(140, 180)), DOWN, log_at(LAY), fit_at(now))


def test_a_log_in_its_place_is_not_the_similar_one_beside_it() -> None:
    beside = (0.5, RADIUS_M)
    assert not is_displaced(picture(LAY, beside), DOWN, log_at(LAY), fit_at(beside))


def test_a_hidden_log_is_not_displaced() -> None:
    now = (0.5, 0.6)
    assert not is_displaced(picture(now, tongs=slice(0, 320)), DOWN, log_at(LAY), fit_at(now))


@pytest.mark.parametrize(
    "other",
    [fit_at((0.0, 0.6), length_m=1.2), fit_at((0.0, 0.6), radius_m=0.2), fit_at((0.0, 1.8))],
    ids=["a shorter log", "a thicker log", "far away"],
)
def test_a_fit_of_another_shape_is_another_log(other: CylinderFit) -> None:
    assert not is_displaced(picture(), DOWN, log_at(LAY), other)


def test_a_log_that_is_half_visible_in_its_place_is_not_displaced() -> None:
    frame = picture(LAY, length_m=0.4 * LENGTH_M)
    assert not is_displaced(frame, DOWN, log_at(LAY), fit_at((0.6, RADIUS_M)))


def test_a_log_outside_the_picture_is_not_displaced() -> None:
    outside = log_at((4.0, RADIUS_M))
    assert not is_displaced(picture((3.0, 0.6)), DOWN, outside, fit_at((3.0, 0.6)))


def test_half_a_log_in_the_picture_suffices() -> None:
    half_outside = log_at(LAY, x_m=2.4)
    assert is_displaced(picture(), DOWN, half_outside, fit_at((0.6, 0.6), x_m=1.6)), "what is in view is the ground"


def test_without_depth_a_log_is_not_displaced() -> None:
    frame = picture((0.0, 0.6))
    frame.depth_m[:] = np.nan
    assert not is_displaced(frame, DOWN, log_at(LAY), fit_at((0.0, 0.6)))
