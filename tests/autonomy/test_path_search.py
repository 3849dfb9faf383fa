"""Collision-free paths: fastest where the path is free, over or around what is not; and distances, exact and named."""

from __future__ import annotations

import random
from math import cos, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize_scalar

from autonomy.crane_job.phase_motions import MACHINE_LEAN_M, approach_motion, carry_motion
from autonomy.grasp.bunk_load import plan_place
from autonomy.grasp.grapple_heights import hover_height_m, travel_height_m
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion import clearance, motion_planner
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.clearance import (
    MARGIN_M,
    clearance_reserve,
    clearances,
    least_clearance,
    motion_between_samples,
    segment_box,
    segment_segment,
)
from autonomy.motion.motion_planner import MovementPrimitivePlanner, TimeOptimalPlanner
from autonomy.motion.movement_primitives import load
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
from autonomy.motion.path_search import PathBlocked, plan_path
from autonomy.motion.trajectory import Trajectory, slow_line, travel_over
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable, pin_position
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from sim.wood.bunk import bunk_boxes as plant_boxes
from sim.wood.bunk import to_bunk
from tests.autonomy.crane_stand_in import refusing
from tests.autonomy.motion_figures import assert_within_limits, figures, pins
from tests.codes import coded

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")
ARMS = {"palms_471": Arm(PALMS), "aoro_fc8": Arm(AORO)}
HELD = HeldLog(2.0, 0.25)


def places(profile: Profile, seed: int) -> tuple[Pose, Pose]:
    """Over a log on the ground, the grapple at any yaw, and in the bunk with the log along it."""
    rng, arm, work = random.Random(seed), ARMS[profile.name], profile.workspace
    top = travel_height_m(profile)
    x, y = (c + rng.uniform(-1.0, 1.0) * work.pick_half_size_m for c in work.pick_center_m)
    log = arm.pose_above(x, y, work.ground_z_m + 1.9, top)._replace(rot_rad=rng.uniform(-1.5, 1.5))
    bunk = arm.pose_above(*profile.bunk.center_m, profile.bunk.floor_z_m + 1.8, top)
    return log, bunk._replace(rot_rad=profile.bunk.yaw_rad - bunk.slew_rad - profile.kinematics.theta1_offset_rad)


def logs_about(profile: Profile, seed: int, count: int = 6) -> list[LogObservation]:
    rng, work = random.Random(seed + 100), profile.workspace
    found = []
    for i in range(count):
        x, y = (c + rng.uniform(-1.0, 1.0) for c in work.pick_center_m)
        yaw, thick = rng.uniform(-1.5, 1.5), rng.uniform(0.12, 0.3)
        found.append(LogObservation(i, (x, y, work.ground_z_m + thick / 2), (cos(yaw), sin(yaw), 0.0), 2.2, thick))
    return found


def poses_of(motion: Trajectory) -> np.ndarray:
    return np.array([ARMS["aoro_fc8"].pose(q)[:3] for q in motion.position])


def assert_kept(profile: Profile, motion: Trajectory, start: Pose, goal: Pose) -> None:
    """Rest to rest, within all limits."""
    arm = ARMS[profile.name]
    assert arm.pose(motion.position[0]) == pytest.approx(start, abs=1e-6)
    assert arm.pose(motion.position[-1]) == pytest.approx(goal, abs=1e-6)
    assert_within_limits(profile, motion, pump=1.01)


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_random_paths_over_the_stakes_keep_limits_and_touch_nothing(profile: Profile, seed: int) -> None:
    arm, ends = ARMS[profile.name], places(profile, seed)
    start, goal = ends if seed % 2 else reversed(ends)
    around, held = collision_scene(profile, logs_about(profile, seed)), HELD if seed % 2 else None
    path = plan_path(arm, start, goal, around, held)
    assert path.reserve_m >= 0.0 and clearance_reserve(arm, path.motion, around, held)[0] > -0.02
    assert_kept(profile, path.motion, start, goal)
    found = figures(profile, path.motion, around, held)
    assert max(found.stops, found.speed, found.acceleration, found.pump) < 1.0
    assert found.jerk_s > 0.05 and found.swing_rad < 0.09
    assert found.clearance_m > clearance.MARGIN_M and found.lost_m < 0.06


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
def test_it_is_no_slower_than_always_at_the_greatest_height(profile: Profile) -> None:
    arm, top = ARMS[profile.name], travel_height_m(profile)
    start, goal = places(profile, 3)
    ours = plan_path(arm, start, goal, collision_scene(profile), HELD).motion
    assert ours.duration_s < travel_over(arm, start, goal, top, 2.5).duration_s


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
def test_where_the_path_is_free_it_goes_straight(profile: Profile) -> None:
    arm = ARMS[profile.name]
    start, _ = places(profile, 5)
    goal = start._replace(slew_rad=start.slew_rad - 0.3, z_m=start.z_m + 0.3)
    path = plan_path(arm, start, goal, collision_scene(profile))
    assert path.name == "straight" and path.tried == 1
    assert_kept(profile, path.motion, start, goal)


def beside() -> tuple[Pose, Pose]:
    """Two places on one side of the machine, low over the ground."""
    arm = ARMS["aoro_fc8"]
    return arm.pose_above(3.0, 4.2, 0.6, 3.0), arm.pose_above(5.4, 3.0, 0.6, 3.0)


def test_a_tree_between_two_places_is_gone_around() -> None:
    arm, (start, goal) = ARMS["aoro_fc8"], beside()
    free = plan_path(arm, start, goal, collision_scene(AORO))
    half = pin_position(AORO.kinematics, free.motion.position[len(free.motion.position) // 2])
    around = collision_scene(AORO, trees=[tree_capsule(half[0] * 1.06, half[1] * 1.06, 0.15, -1.15)])
    assert clearance_reserve(arm, free.motion, around)[0] < -0.1
    path = plan_path(arm, start, goal, around)
    q = np.array(path.motion.position)
    assert path.name == "drawn in"
    assert clearances(around, swept_capsules(AORO, q, pins(AORO, q), None))[:, :, -1].min() > 0.08
    assert_kept(AORO, path.motion, start, goal)


def test_an_obstacle_that_cannot_be_passed_is_named() -> None:
    arm, (start, goal) = ARMS["aoro_fc8"], beside()
    wall = [
        Capsule(f"tree {i}", (r * cos(0.75), r * sin(0.75), -1.15), (r * cos(0.75), r * sin(0.75), 12.0), 0.3)
        for i, r in enumerate(np.arange(0.6, 9.0, 0.4))
    ]
    with pytest.raises(PathBlocked, check=coded("motion.path-blocked")) as blocked:
        plan_path(arm, start, goal, collision_scene(AORO, trees=wall))
    assert "(3.00, 4.20, 0.60)" in str(blocked.value) and "tree" in str(blocked.value)


def test_an_end_out_of_reach_is_refused_as_such() -> None:
    arm, (start, goal) = ARMS["aoro_fc8"], beside()
    with pytest.raises(Unreachable, check=coded("reach.too-far")) as refused:
        plan_path(arm, start, goal._replace(r_m=12.0), collision_scene(AORO))
    assert not isinstance(refused.value, PathBlocked)


def test_higher_ground_lifts_the_path() -> None:
    arm, (start, goal) = ARMS["aoro_fc8"], beside()

    def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        along = np.arctan2(y, x) - 0.75
        return -1.15 + 1.2 * np.exp(-((along / 0.08) ** 2))

    low, high = (poses_of(plan_path(arm, start, goal, CollisionScene(ground)).motion) for ground in (-1.15, hill))
    assert high[:, 2].max() > low[:, 2].max() + 0.3


def test_standing_still_is_a_path() -> None:
    arm, (start, _) = ARMS["palms_471"], places(PALMS, 8)
    path = plan_path(arm, start, start, collision_scene(PALMS))
    assert np.ptp(np.array(path.motion.position), axis=0) == pytest.approx(np.zeros(5))


def test_from_a_landing_into_a_full_bunk_the_path_is_over_the_stakes_not_around_them() -> None:
    # Begun before the tongs are up, this way is too near to the load: it is the rise that must be done first.
    bunk = AORO.bunk
    heap = [(0.33 * i - 0.8, bunk.floor_z_m + 0.13 + 0.2 * row) for row in range(4) for i in range(5)]
    logs = [LogObservation(n, (bunk.center_m[0], y, z), (1.0, 0.0, 0.0), 2.0, 0.25) for n, (y, z) in enumerate(heap)]
    arm = ARMS["aoro_fc8"]
    start, goal = Pose(-1.425, 2.852, 0.272, 0.05, -1.585), Pose(-0.295, 2.611, 2.67, 0.408, -2.842)
    path = plan_path(arm, start, goal, collision_scene(AORO, logs))
    assert_kept(AORO, path.motion, start, goal)
    assert path.name == "over" and path.motion.duration_s < 12.0


def test_a_slow_lift_keeps_the_arms_limits_however_short_its_requested_time() -> None:
    arm = ARMS["aoro_fc8"]
    start = arm.pose_above(2.4, 0.3, 0.4, travel_height_m(AORO))
    goal = start.at_height(travel_height_m(AORO))
    hasty, slow = (slow_line(arm, start, goal, seconds) for seconds in (2.0, 20.0))
    assert_kept(AORO, hasty, start, goal)
    assert hasty.duration_s > 4.0 and slow.duration_s == pytest.approx(20.0, abs=0.05)


# -- planners
ARM, HIGH, GROUND = ARMS["aoro_fc8"], travel_height_m(AORO), AORO.workspace.ground_z_m
LOG = LogObservation(0, (3.6, 3.2, GROUND + 0.12), (1.0, 0.0, 0.0), 2.0, 0.24)
GRASP = plan_single_log_grasp(ARM, LOG, 0.0)
PLACE = plan_place(ARM, CraneJob(), GRASP, [LOG])
OVER = GRASP.pose.at_height(hover_height_m(AORO, GRASP))


def test_the_time_optimal_planner_goes_down_to_the_log_and_into_the_bunk_in_one_motion() -> None:
    """On tyres to just above it: the machine leans, and the rest of the descent is vertical."""
    out = approach_motion(ARM, TimeOptimalPlanner(), PLACE, GRASP, [LOG])
    back = carry_motion(ARM, TimeOptimalPlanner(), GRASP.pose, PLACE, GRASP, [LOG], hangs=False)
    assert poses_of(out)[-1] == pytest.approx(GRASP.pose.at_height(GRASP.pose.z_m + MACHINE_LEAN_M)[:3], abs=1e-3)
    assert poses_of(back)[-1] == pytest.approx(PLACE[:3], abs=1e-3)
    assert max(out.duration_s, back.duration_s) < 10.5
    held = held_log(ARM, GRASP.pose, LOG)
    assert clearance_reserve(ARM, back, collision_scene(AORO), held)[0] >= -0.01


def test_a_place_only_reachable_from_above_is_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_high(arm: Arm, start: Pose, goal: Pose, *more: object) -> object:
        if goal.z_m < HIGH:
            raise PathBlocked("too near to the stakes", "motion.path-blocked")
        return plan_path(arm, start, goal, *more)

    monkeypatch.setattr(motion_planner, "plan_path", only_high)
    monkeypatch.setattr(motion_planner, "clearance_reserve", lambda *_: (-1.0, ""))
    motion = carry_motion(ARM, TimeOptimalPlanner(), GRASP.pose, PLACE, GRASP, [LOG], hangs=False)
    assert poses_of(motion)[-1] == pytest.approx((PLACE.slew_rad, PLACE.r_m, HIGH), abs=2e-3)


def test_the_end_of_the_descent_is_above_the_log() -> None:
    pin = poses_of(approach_motion(ARM, TimeOptimalPlanner(), PLACE, GRASP, [LOG]))
    aside = np.abs(pin[:, 1] - GRASP.pose.r_m)
    assert np.max(aside[pin[:, 2] < GRASP.pose.z_m + 0.3]) < 0.25


def test_among_other_logs_it_stops_above() -> None:
    beside = LogObservation(1, (3.6, 3.55, GROUND + 0.12), (1.0, 0.0, 0.0), 2.0, 0.24)
    gathered = GRASP.__class__(LOG, GRASP.pose, GRASP.support_z_m, 0.0, (), GROUND + 0.24)
    out = approach_motion(ARM, TimeOptimalPlanner(), PLACE, gathered, [LOG, beside])
    assert poses_of(out)[-1, 2] == pytest.approx(hover_height_m(AORO, gathered), abs=1e-3)


def test_where_no_fast_path_is_clear_the_one_at_full_height_replaces_it_only_if_clear(monkeypatch) -> None:
    blocked = PathBlocked("no path is clear: as requested", "motion.path-blocked")
    monkeypatch.setattr(motion_planner, "plan_path", refusing(blocked))
    free = CollisionScene(GROUND)
    slow = TimeOptimalPlanner()(ARM, PLACE, OVER, free, None, HIGH, 0.0)
    assert slow == travel_over(ARM, PLACE, OVER, HIGH, 0.0)
    x, y = (0.5 * (a + b) for a, b in zip(ARM.xy(PLACE), ARM.xy(OVER), strict=True))
    stands = collision_scene(AORO, trees=[tree_capsule(x, y, 0.2, GROUND)])
    with pytest.raises(PathBlocked, check=coded("motion.path-blocked")):
        TimeOptimalPlanner()(ARM, PLACE, OVER, stands, None, HIGH, 0.0)


def test_paper_bs_planner_uses_the_primitive_unless_it_would_touch_something() -> None:
    shown = MovementPrimitivePlanner(load(AORO))
    free = collision_scene(AORO)
    start = PLACE.at_height(PLACE.z_m + 0.9)
    motion = shown(ARM, start, OVER, free, None, HIGH, 0.0)
    assert not shown.direct and clearance_reserve(ARM, motion, free)[0] >= -MARGIN_M
    assert motion != travel_over(ARM, start, OVER, HIGH, 0.0)
    z = poses_of(motion)[len(motion.position) // 2][2]
    middle = ARM.xy(ARM.pose(motion.position[len(motion.position) // 2]))
    in_the_way = collision_scene(AORO, trees=[tree_capsule(*middle, 0.1, GROUND, z - GROUND - 0.3)])
    assert shown(ARM, start, OVER, in_the_way, None, HIGH, 0.0) == travel_over(ARM, start, OVER, HIGH, 0.0)


# -- distances between what moves and what stands
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
