"""Logs over time: identities, honest uncertainty, what motion tells, and which log is one that was displaced."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.cylinder import Cylinder, across_view
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.fitting.measure import fragment_groups, joined_cylinder, same_log
from autonomy.perception.log_list import END, START, LogEstimate
from autonomy.perception.tracking.log_filter import CameraErrors
from autonomy.perception.tracking.log_tracker import LOST_MISSES, LogTracker, is_displaced
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, rpy_matrix

QUIET = CameraErrors(scale=1e-5, mount_rad=1e-5, mount_m=1e-5, pose_rad=1e-6, pose_m=1e-6)
TRUTH = (5.0, 0.0, 0.12)
SIGMA = np.array([0.01, 0.03, 0.01, 0.02, 0.03, 0.03, 0.005])


def pose_at(x: float = 0.0, yaw: float = 0.0) -> Pose:
    """A camera 2.4 m up that looks ahead and down."""
    return Pose(np.array([x, 0.0, 2.4]), rpy_matrix((0.0, 0.5, yaw)) @ BODY_FROM_OPTICAL)


def fit_of(pose: Pose, center, yaw: float = 1.5, length: float = 2.0, scale: float = 1.0, noise=None) -> CylinderFit:
    """What a camera would make of a level log; ``noise`` (7,) in standard deviations."""
    axis = pose.rotation.T @ np.array([math.cos(yaw), math.sin(yaw), 0.0])
    at = pose.to_optical(np.asarray(center, float)) * scale
    n = np.zeros(7) if noise is None else noise * SIGMA
    e1, e2 = across_view(axis, at)
    at = at + n[0] * e1 + n[1] * e2
    axis = axis + n[2] * e1 + n[3] * e2
    axis /= np.linalg.norm(axis)
    half = 0.5 * length * scale
    start, end = -half + n[4], half + n[5]
    body = Cylinder(at, axis, start, end, 0.125 * scale + n[6]).centered()
    return CylinderFit(body, np.diag(SIGMA**2), (True, True), 1.0, 0.5, np.full(7, 1e-4))


def tracked(pictures: int = 3) -> tuple[LogTracker, Pose]:
    """A tracker that has seen one log in so many pictures, and where from."""
    tracks, pose = LogTracker(QUIET), pose_at()
    for k in range(pictures):
        tracks.step([fit_of(pose, TRUTH)], pose, k)
    return tracks, pose


def length_sigma_m(estimate: LogEstimate) -> float:
    c = estimate.covariance
    return math.sqrt(c[START, START] + c[END, END] - 2.0 * c[START, END])


def test_what_is_thinner_than_any_log_is_not_reported() -> None:
    tracks, pose = LogTracker(QUIET), pose_at()
    thin = np.zeros(7)
    thin[6] = (0.02 - 0.125) / SIGMA[6]
    for k in range(4):
        assert not tracks.step([fit_of(pose, TRUTH, noise=thin)], pose, k)


def test_a_log_is_confirmed_by_its_second_picture_and_keeps_its_number() -> None:
    tracks, pose = LogTracker(QUIET), pose_at()
    places = [(5.0, -1.0, 0.12), (6.0, 1.0, 0.12)]
    assert tracks.step([fit_of(pose, p) for p in places], pose, 0) == ()
    for k in range(1, 6):
        order = places if k % 2 else places[::-1]
        found = tracks.step([fit_of(pose, p) for p in order], pose, k)
        assert [t.id for t in found] == [1, 2] and found[0].hits == k + 1 and found[0].last_seen_ns == k
        assert np.allclose([t.estimate.center_m for t in found], places, atol=1e-6)


def test_a_fit_with_a_reversed_axis_is_of_the_same_log() -> None:
    tracks, pose = LogTracker(QUIET), pose_at()
    fit = fit_of(pose, TRUTH)
    turned = replace(fit, body=replace(fit.body, axis=-fit.body.axis), ends_seen=(False, True))
    fit = replace(fit, ends_seen=(True, False))
    for k, one in enumerate((fit, turned, fit, turned)):
        found = tracks.step([one], pose, k)
    assert len(found) == 1 and found[0].estimate.ends_seen == (True, False)
    assert found[0].estimate.length_m == pytest.approx(2.0, abs=1e-4)
    assert np.allclose(found[0].estimate.center_m, (5.0, 0.0, 0.12), atol=1e-6)


def test_noise_averages_and_the_covariance_is_consistent() -> None:
    rng, squares = np.random.default_rng(1), []
    for _ in range(25):
        tracks, pose = LogTracker(QUIET), pose_at()
        for k in range(12):
            found = tracks.step([fit_of(pose, (5.0, 0.3, 0.12), noise=rng.normal(size=7))], pose, k)
        estimate = found[0].estimate
        miss = estimate.center_m - (5.0, 0.3, 0.12)
        parts = np.array([miss @ e for e in (*estimate.frame(), estimate.axis)])
        squares.append((parts / estimate.position_sigma_m()) ** 2)
        assert np.linalg.norm(miss) < 0.06
    assert 0.5 < np.mean(squares) < 1.8


def test_a_scale_error_remains_while_the_camera_stands_and_shrinks_when_it_drives() -> None:
    center, errors = (
        (8.0, 0.2, 0.12),
        CameraErrors(scale=0.01, mount_rad=1e-5, mount_m=1e-5, pose_rad=1e-6, pose_m=1e-6),
    )
    claims, misses = [], []
    for drive in (0.0, 4.0):
        tracks = LogTracker(errors)
        for k in range(120):
            pose = pose_at(drive * k / 119)
            found = tracks.step([fit_of(pose, center, scale=1.01)], pose, k)
        estimate = found[0].estimate
        claims.append(float(np.linalg.norm(estimate.position_sigma_m())))
        misses.append(float(np.linalg.norm(estimate.center_m - center)))
    assert claims[0] > 0.06 and claims[1] < 0.5 * claims[0]
    assert misses[0] > 0.06 and misses[1] < 0.4 * misses[0]


def test_similar_pictures_do_not_reduce_their_common_errors() -> None:
    shared = np.array([0.01, 0.02, 0.01, 0.02, 0.05, 0.05, 0.004])
    tracks, pose = LogTracker(QUIET), pose_at()
    fit = replace(fit_of(pose, TRUTH), systematic=shared, covariance=np.diag(SIGMA**2 + shared**2))
    for k in range(200):
        found = tracks.step([fit], pose, k)
    assert length_sigma_m(found[0].estimate) > 0.06


def test_many_pictures_from_one_place_do_not_outweigh_few_from_others() -> None:
    shared = np.array([0.01, 0.02, 0.01, 0.02, 0.1, 0.1, 0.004])
    tracks = LogTracker(QUIET)
    places = [(0.0, 2.2)] * 60 + [(x, 2.0) for x in (1.0, 2.0, 2.8, 3.5)]
    for k, (x, length) in enumerate(places):
        pose = pose_at(x)
        fit = fit_of(pose, (8.0, 0.0, 0.12), length=length)
        fit = replace(fit, systematic=shared, covariance=np.diag(SIGMA**2 + shared**2))
        found = tracks.step([fit], pose, k)
    assert found[0].estimate.length_m < 2.1


def test_an_outlier_changes_nothing_but_a_wrong_start_is_corrected() -> None:
    tracks, pose = tracked(6)
    found = tracks.step([fit_of(pose, TRUTH, length=3.5)], pose, 6)
    assert found[0].estimate.length_m == pytest.approx(2.0, abs=1e-3) and len(found) == 1
    tracks = LogTracker(QUIET)
    for k in range(2):
        tracks.step([fit_of(pose, TRUTH, length=3.5)], pose, k)
    for k in range(2, 9):
        found = tracks.step([fit_of(pose, TRUTH)], pose, k)
    assert [t.id for t in found] == [1] and found[0].estimate.length_m == pytest.approx(2.0, abs=0.01)


def test_a_log_with_a_wrong_first_fit_is_confirmed_nevertheless() -> None:
    tracks, pose = LogTracker(QUIET), pose_at()
    tracks.step([fit_of(pose, TRUTH, length=3.5)], pose, 0)
    assert tracks.step([fit_of(pose, TRUTH)], pose, 1) == (), "two pictures that do not agree tell of no log"
    found = tracks.step([fit_of(pose, TRUTH)], pose, 2)
    assert [t.id for t in found] == [1] and found[0].estimate.length_m == pytest.approx(2.0, abs=0.01)


def test_a_log_that_is_gone_is_deleted_and_a_new_one_gets_a_new_number() -> None:
    tracks, pose = tracked()
    for k in range(LOST_MISSES - 1):
        assert len(tracks.step([], pose, 3 + k)) == 1
    assert tracks.step([], pose, 20) == ()
    for k in range(2):
        found = tracks.step([fit_of(pose, TRUTH)], pose, 30 + k)
    assert [t.id for t in found] == [2]


def test_a_displaced_log_keeps_its_number() -> None:
    tracks, pose = tracked()
    for k, up in enumerate((0.5, 0.9, 1.3)):
        found = tracks.step([fit_of(pose, (5.0, 0.0, 0.12 + up))], pose, 3 + k, displaced=lambda log, fit: True)
        assert [t.id for t in found] == [1]
        assert found[0].estimate.center_m[2] == pytest.approx(0.12 + up, abs=1e-3)


def test_two_numbers_for_one_log_merge_into_the_older_one() -> None:
    """A wrong fit took a log's number, a new number began where it is, and then the picture is clear again."""
    tracks, pose = tracked()
    tracks.step([fit_of(pose, TRUTH, length=2.1), fit_of(pose, (5.0, 0.0, 0.2))], pose, 3)
    for k in range(2):
        found = tracks.step([fit_of(pose, (5.0, 0.0, 0.2))], pose, 4 + k)
    assert [t.id for t in found] == [1] and found[0].estimate.center_m[2] == pytest.approx(0.2, abs=0.01)


def test_a_fragment_of_a_log_does_not_delete_the_whole_log() -> None:
    tracks, pose = tracked()
    pieces = [fit_of(pose, (5.0, y, 0.12), length=0.7) for y in (0.3, -0.3)]
    for k in range(3):
        found = tracks.step(pieces, pose, 3 + k)
    whole = next(t.estimate for t in found if t.id == 1)
    assert whole.length_m == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize(
    ("center", "length", "count"),
    [
        ((5.0, 0.3, 0.12), 1.4, 1),  # a piece of it
        ((5.0, 0.3, 0.32), 1.4, 2),  # on it, seen a little too low
        ((5.25, 0.3, 0.12), 1.4, 2),  # beside it
        ((5.0, 1.8, 0.12), 1.4, 2),  # before its end
    ],
)
def test_a_fragment_beside_the_whole_log_is_not_reported(center, length: float, count: int) -> None:
    tracks, pose = LogTracker(QUIET), pose_at()
    for k in range(3):
        found = tracks.step([fit_of(pose, TRUTH), fit_of(pose, center, length=length)], pose, k)
    assert [t.id for t in found] == [1, 2][:count]


@settings(max_examples=40)
@given(st.floats(-0.4, 0.4), st.floats(-3.1, 3.1), st.floats(0.0, 2.0))
def test_an_exact_fit_does_not_depend_on_the_camera_pose(yaw: float, log_yaw: float, moved: float) -> None:
    tracks, center = LogTracker(QUIET), (6.0, 0.4, 0.12)
    for k in range(3):
        pose = pose_at(moved * k / 2, yaw)
        found = tracks.step([fit_of(pose, center, yaw=log_yaw)], pose, k)
    assert len(found) == 1 and np.allclose(found[0].estimate.center_m, center, atol=1e-5)


def fragment(start: float, end: float, seen: tuple[bool, bool], radius: float = 0.12, y: float = 0.0) -> CylinderFit:
    """A piece of a log along x, 5 m away."""
    body = Cylinder(np.array([0.0, y, 5.0]), np.array([1.0, 0.0, 0.0]), start, end, radius).centered()
    return CylinderFit(body, np.diag(np.full(7, 1e-4)), seen, 1.0, 0.5, np.zeros(7))


def test_fragments_that_miss_the_ends_facing_each_other_are_one_log() -> None:
    a, b = fragment(-1.0, -0.2, (True, False)), fragment(0.3, 1.0, (False, True))
    assert same_log(a, b) and same_log(b, a) and fragment_groups({0: a, 2: b}) == [[0, 2]]
    whole = joined_cylinder(a.body, b.body)
    assert whole.length_m == pytest.approx(2.0) and np.allclose(whole.center_m, (0.0, 0.0, 5.0))


@pytest.mark.parametrize(
    "other",
    [
        fragment(0.3, 1.0, (True, True)),
        fragment(0.3, 1.0, (False, True), radius=0.2),
        fragment(0.3, 1.0, (False, True), y=0.4),
        fragment(2.0, 3.0, (False, True)),
    ],
    ids=["its own end", "another width", "beside", "far away"],
)
def test_other_fits_are_not_merged(other: CylinderFit) -> None:
    a = fragment(-1.0, -0.2, (True, False))
    assert not same_log(a, other) and fragment_groups({0: a, 1: other}) == [[0], [1]]


# -- a log that is seen elsewhere, and no longer where it was
HEIGHT_M = 4.0
LENGTH_M, RADIUS_M = 2.0, 0.1
PIN = Intrinsics(320, 240, 220.0, 220.0, 159.5, 119.5)
DOWN = Pose(np.array([0.0, 0.0, HEIGHT_M]), np.diag([1.0, -1.0, -1.0]))
"""A camera that looks straight down on a level ground."""

Place = tuple[float, float]
"""Across its axis, and up, of a log along x."""


def picture(*logs: Place, tongs: slice | None = None, length_m: float = LENGTH_M, known: bool = True) -> RgbdFrame:
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
    depth = depth if known else np.full_like(depth, np.nan)
    return RgbdFrame("stick", 1, rgb, depth.astype(np.float32), PIN)


def log_at(place: Place, x_m: float = 0.0) -> LogEstimate:
    return LogEstimate(np.array([x_m, *place]), np.array([1.0, 0.0, 0.0]), LENGTH_M, 2.0 * RADIUS_M, np.eye(7) * 1e-4)


def fit_at(place: Place, length_m: float = LENGTH_M, radius_m: float = RADIUS_M, x_m: float = 0.0) -> CylinderFit:
    middle, half = DOWN.to_optical(np.array([x_m, *place])), length_m / 2
    body = Cylinder(middle, np.array([1.0, 0.0, 0.0]), -half, half, radius_m)
    return CylinderFit(body, np.eye(7) * 1e-4, (True, True), 1.0, 0.5, np.zeros(7))


LAY = (0.0, RADIUS_M)


NOW, ASIDE = (0.0, 0.6), (0.6, RADIUS_M)
HIDDEN = slice(0, PIN.width_px)
SEEN = {
    "lifted": (picture(NOW), log_at(LAY), fit_at(NOW), True),
    "carried": (picture((0.3, 0.5)), log_at(LAY), fit_at((0.3, 0.5)), True),
    "rolled away": (picture(ASIDE), log_at(LAY), fit_at(ASIDE), True),
    "a grapple over its middle": (picture(NOW, tongs=slice(140, 180)), log_at(LAY), fit_at(NOW), True),
    "half of it in the picture": (picture(), log_at(LAY, x_m=2.4), fit_at((0.6, 0.6), x_m=1.6), True),
    "a similar one beside it": (picture(LAY, (0.5, RADIUS_M)), log_at(LAY), fit_at((0.5, RADIUS_M)), False),
    "hidden": (picture((0.5, 0.6), tongs=HIDDEN), log_at(LAY), fit_at((0.5, 0.6)), False),
    "a shorter log": (picture(), log_at(LAY), fit_at(NOW, length_m=1.2), False),
    "a thicker log": (picture(), log_at(LAY), fit_at(NOW, radius_m=0.2), False),
    "far away": (picture(), log_at(LAY), fit_at((0.0, 1.8)), False),
    "half visible in its place": (picture(LAY, length_m=0.4 * LENGTH_M), log_at(LAY), fit_at(ASIDE), False),
    "outside the picture": (picture((3.0, 0.6)), log_at((4.0, RADIUS_M)), fit_at((3.0, 0.6)), False),
    "without depth": (picture(NOW, known=False), log_at(LAY), fit_at(NOW), False),
}


@pytest.mark.parametrize(("frame", "log", "fit", "displaced"), SEEN.values(), ids=SEEN)
def test_a_log_seen_elsewhere_and_not_in_its_place_is_displaced(frame, log, fit, displaced) -> None:
    assert is_displaced(frame, DOWN, log, fit) is displaced
