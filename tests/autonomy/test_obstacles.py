"""Distances between what moves and what stands: exact, and named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize_scalar

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.clearance import clearances, least_clearance, motion_between_samples, segment_box, segment_segment
from autonomy.motion.obstacles import (
    Box,
    Capsule,
    CollisionScene,
    HeldLog,
    SweptCapsules,
    bunk_boxes,
    carrier_boxes,
    collision_scene,
    held_log,
    swept_capsules,
    tree_capsule,
)
from autonomy.perception.log_list import LogObservation
from machine.loading.profile_file import load_profile
from sim.wood.bunk import bunk_boxes as plant_boxes
from sim.wood.bunk import to_bunk

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")
points = arrays(float, 3, elements=st.floats(-3.0, 3.0).map(lambda x: round(x, 3)))


@settings(deadline=None, max_examples=60)
@given(points, points, points, points)
def test_the_distance_of_two_segments_is_the_least_of_their_points(a, b, c, d) -> None:
    found = float(segment_segment(a, b, c, d))

    def to_other(t: float) -> float:
        p = a + t * (b - a)
        way = d - c
        s = np.clip((p - c) @ way / max(way @ way, 1e-12), 0.0, 1.0)
        return float(np.linalg.norm(p - c - s * way))

    other = min(to_other(0.0), to_other(1.0), minimize_scalar(to_other, bounds=(0.0, 1.0), method="bounded").fun)
    assert found == pytest.approx(other, abs=1e-4)


@settings(deadline=None, max_examples=60)
@given(points, points, arrays(float, 3, elements=st.floats(0.01, 2.0)))
def test_the_distance_of_a_segment_and_a_box_is_the_least_of_its_points(a, b, half) -> None:
    found = float(segment_box(a, b, half))
    on_it = a + np.linspace(0.0, 1.0, 4001)[:, None] * (b - a)
    brute = float(np.min(np.linalg.norm(on_it - np.clip(on_it, -half, half), axis=1)))
    assert found <= brute + 1e-9 and found > brute - 1e-3 * (1.0 + np.linalg.norm(b - a))


def one(a: tuple[float, ...], b: tuple[float, ...], radius: float) -> SweptCapsules:
    return SweptCapsules(np.array([[a]]), np.array([[b]]), np.array([radius]), ("thing",), np.array([True]))


def test_ground_box_and_capsule_are_measured_to_the_surface() -> None:
    around = CollisionScene(
        -1.0,
        (Box("crate", (2.0, 0.0, 0.0), (0.5, 0.1, 0.5), np.pi / 2),),
        (Capsule("pole", (0.0, 3.0, -1.0), (0.0, 3.0, 5.0), 0.2),),
    )
    apart = clearances(around, one((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1))[0, 0]
    assert apart == pytest.approx([0.9, 2.0 - 0.1 - 1.0 - 0.1, 3.0 - 0.2 - 0.1])
    assert around.names == ("the ground", "crate", "pole")
    assert least_clearance(around, one((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1))[1:3] == ("thing", "crate")


def test_a_bound_never_claims_more_than_the_distance() -> None:
    rng = np.random.default_rng(3)
    body = SweptCapsules(
        *rng.normal(size=(2, 20, 3, 3)) * 3.0, rng.uniform(0.05, 0.3, 3), ("a", "b", "c"), np.ones(3, bool)
    )
    logs = [LogObservation(i, tuple(rng.normal(size=3) * 3), (1.0, 0.0, 0.0), 2.0, 0.2) for i in range(5)]
    around = collision_scene(AORO, logs)
    exact, quick = clearances(around, body), clearances(around, body, 0.5)
    assert np.all(quick <= exact + 1e-9)
    near = exact < 0.5
    assert near.any() and quick[near] == pytest.approx(exact[near])
    assert np.all(quick[~near] >= 0.5 - 1e-9)


def test_a_ground_may_have_a_shape() -> None:
    def slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.5 * x

    apart = clearances(CollisionScene(slope), one((0.0, 0.0, 1.0), (2.0, 0.0, 1.0), 0.1))
    assert apart[0, 0, 0] == pytest.approx(-0.1)


@pytest.mark.parametrize("profile", [PALMS, AORO])
def test_the_walls_hold_every_stake_of_the_plant(profile) -> None:
    floor, *walls = bunk_boxes(profile.bunk)
    assert floor.center_m[2] + floor.half_m[2] == pytest.approx(profile.bunk.floor_z_m)
    for size, middle in plant_boxes(profile)[1:]:
        inside = [
            all(
                abs(m - c) + s / 2 <= h + 1e-9
                for m, c, s, h in zip(middle, to_bunk(profile.bunk, wall.center_m), size, wall.half_m, strict=True)
            )
            for wall in walls
        ]
        assert any(inside)


def test_the_carrier_stands_where_the_plant_has_it() -> None:
    """Base frame: x back over the bunk, y to the machine's right, the ground 1.15 m down."""
    boxes = {box.name: box for box in carrier_boxes(AORO)}
    rear, front = boxes["the rear frame"], boxes["the front half"]
    assert rear.center_m[0] - rear.half_m[0] == pytest.approx(-0.4) and rear.center_m[0] + rear.half_m[0] > 3.5
    assert front.center_m[0] + front.half_m[0] == pytest.approx(-1.0)
    wheels = [box for box in carrier_boxes(AORO) if box.name == "a wheel"]
    assert len(wheels) == 4 and all(box.center_m[2] - box.half_m[2] == pytest.approx(-1.15) for box in wheels)
    assert carrier_boxes(PALMS) == ()


def test_a_held_log_hangs_under_the_pin_across_the_jaws() -> None:
    arm = Arm(AORO)
    pose = arm.pose_above(4.0, 3.0, 1.0, 3.0)
    q = arm.joints(np.array([pose]))
    pin = np.array([[4.0, 3.0, 1.0]])
    body = swept_capsules(AORO, q, pin, HeldLog(2.0, 0.25, along_m=0.3))
    log = body.names.index("log")
    a, b = body.a[0, log], body.b[0, log]
    assert np.linalg.norm(b - a) == pytest.approx(1.75) and a[2] == b[2] < 0.0
    assert np.linalg.norm((a + b) / 2 - pin[0] - [0.0, 0.0, a[2] - 1.0]) == pytest.approx(0.3)
    assert list(body.hangs) == [False, False, True, True, True, True]
    assert body.b[0, 1] == pytest.approx(pin[0]) and body.a[0, 2] == pytest.approx(pin[0])
    aside = body.shifted(np.array([[0.1, 0.0]]), float(np.max(body.depth(body.b))))
    assert np.all(aside.a[0, :2] == body.a[0, :2]) and aside.a[0, 2] == pytest.approx(body.a[0, 2])
    assert aside.a[0, log, 0] > body.a[0, log, 0] + 0.08


@pytest.mark.parametrize("turned", [0.0, np.pi, -np.pi])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_log_is_held_where_it_lay_whichever_way_it_is_taken(turned: float, sense: float) -> None:
    arm = Arm(AORO)
    axis = (sense * np.cos(0.4), sense * np.sin(0.4), 0.0)
    log = LogObservation(0, (4.0, 3.0, -1.0), axis, 2.0, 0.25)
    pose = arm.pose_above(4.0 + 0.2 * np.cos(0.4), 3.0 + 0.2 * np.sin(0.4), 0.3, 3.0)
    pose = pose._replace(rot_rad=0.45 - pose.slew_rad + np.pi / 2 + np.pi / 2 + turned)  # 0.05 rad askew
    body = swept_capsules(
        AORO, arm.joints(np.array([pose])), np.array([[*arm.xy(pose), pose.z_m]]), held_log(arm, pose, log)
    )
    ends = np.array([body.a[0, -1, :2], body.b[0, -1, :2]])
    expected = np.array(log.center_m[:2]) + np.array([[-1.0], [1.0]]) * 0.875 * np.array([np.cos(0.4), np.sin(0.4)])
    assert sorted(map(tuple, ends.round(6))) == sorted(map(tuple, expected.round(6)))


def test_what_moves_far_between_samples_may_be_nearer_there() -> None:
    a = np.array([[[0.0, 0.0, 1.0]], [[1.0, 0.0, 1.0]]])
    moving = SweptCapsules(a, a + np.array([0.0, 1.0, 0.0]), np.array([0.1]), ("thing",), np.array([True]))
    assert motion_between_samples(moving) == pytest.approx(np.array([[0.5], [0.5]]))
    pole = CollisionScene(-1.0, (), (tree_capsule(0.5, 0.5, 0.05, -1.0),))
    assert np.min(clearances(pole, moving) - motion_between_samples(moving)[:, :, None]) < 0.0
