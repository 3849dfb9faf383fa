"""Collision-free paths: fastest where the path is free, over or around obstacles where it is not."""

from __future__ import annotations

import random
from math import cos, sin

import numpy as np
import pytest

from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion import clearance
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.clearance import clearance_reserve, clearances
from autonomy.motion.obstacles import Capsule, CollisionScene, HeldLog, collision_scene, swept_capsules, tree_capsule
from autonomy.motion.path_search import PathBlocked, plan_path
from autonomy.motion.trajectory import Trajectory, slow_line, travel_over
from autonomy.perception.log_list import LogObservation
from machine.geometry.kinematics import Unreachable
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile
from machine.profile import Profile, joint
from tests.autonomy.motion_figures import figures
from tests.codes import coded

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")
ARMS = {"palms_471": Arm(PALMS), "aoro_fc8": Arm(AORO)}
LOG = HeldLog(2.0, 0.25)


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


def fine(arm: Arm, motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Joints and true pins, every 20 ms."""
    q = np.array(motion.position)
    poses = [arm.pose(row) for row in q]
    return q, np.array([(*arm.xy(p), p.z_m) for p in poses])


def assert_kept(profile: Profile, motion: Trajectory, start: Pose, goal: Pose) -> None:
    """Rest to rest, within joints, speeds, accelerations and the pump's oil."""
    arm = ARMS[profile.name]
    q = np.array(motion.position)
    assert arm.pose(q[0]) == pytest.approx(start, abs=1e-6) and arm.pose(q[-1]) == pytest.approx(goal, abs=1e-6)
    v = np.array(motion.velocity)
    a = np.gradient(v, 0.02, axis=0)
    for j in JOINTS:
        spec = joint(profile, j)
        assert q[:, j].min() >= spec.lower and q[:, j].max() <= spec.upper
        assert np.max(np.abs(v[:, j])) < spec.speed_limit and np.max(np.abs(a[:, j])) < spec.acceleration_limit
    assert np.max(arm.pump_load(q, v)) < 1.01


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_log_goes_over_the_stakes_and_touches_nothing(profile: Profile, seed: int) -> None:
    arm, (start, goal) = ARMS[profile.name], places(profile, seed)
    around = collision_scene(profile, logs_about(profile, seed))
    path = plan_path(arm, start, goal, around, LOG)
    assert_kept(profile, path.motion, start, goal)
    q, pin = fine(arm, path.motion)
    # Looked at ten times finer than the planner did: nothing but what is near at the ends comes nearer than 5 cm.
    apart = clearances(around, swept_capsules(profile, q, pin, LOG))
    middle = np.minimum(*(np.linalg.norm(pin - pin[i], axis=1) for i in (0, -1))) > clearance.DEPARTURE_ZONE_M
    assert middle.any() and apart[middle].min() > 0.05
    assert apart.min() > min(0.05, apart[0].min(), apart[-1].min()) - clearance.CONTACT_ALLOWANCE_M - 0.01
    assert path.reserve_m >= 0.0 and clearance_reserve(arm, path.motion, around, LOG)[0] > -0.02


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_random_paths_keep_limits_and_touch_nothing(profile: Profile, seed: int) -> None:
    arm, ends = ARMS[profile.name], places(profile, seed)
    start, goal = ends if seed % 2 else reversed(ends)
    around, held = collision_scene(profile, logs_about(profile, seed)), LOG if seed % 2 else None
    found = figures(profile, plan_path(arm, start, goal, around, held).motion, around, held)
    assert max(found.stops, found.speed, found.acceleration, found.pump) < 1.0
    assert found.jerk_s > 0.05 and found.swing_rad < 0.09
    assert found.clearance_m > clearance.MARGIN_M and found.lost_m < 0.06


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
def test_it_is_no_slower_than_always_at_the_greatest_height(profile: Profile) -> None:
    arm, top = ARMS[profile.name], travel_height_m(profile)
    start, goal = places(profile, 3)
    ours = plan_path(arm, start, goal, collision_scene(profile), LOG).motion
    assert ours.duration_s < travel_over(arm, start, goal, top, 2.5).duration_s


@pytest.mark.parametrize("profile", [PALMS, AORO], ids=lambda p: p.name)
def test_where_the_path_is_free_it_goes_straight(profile: Profile) -> None:
    arm = ARMS[profile.name]
    start, _ = places(profile, 5)
    goal = start._replace(slew_rad=start.slew_rad - 0.3, z_m=start.z_m + 0.3)
    path = plan_path(arm, start, goal, collision_scene(profile))
    assert path.name == "straight" and path.tried == 1
    assert_kept(profile, path.motion, start, goal)


def test_a_hanging_log_swings_little_at_the_end() -> None:
    arm = ARMS["aoro_fc8"]
    start, goal = places(AORO, 6)
    _, pin = fine(arm, plan_path(arm, start, goal, collision_scene(AORO), LOG).motion)
    for period_s in (1.55, 1.8, 2.05):
        omega, swing, speed, most = 2.0 * np.pi / period_s, np.zeros(2), np.zeros(2), 0.0
        for push in np.gradient(np.gradient(pin[:, :2], 0.02, axis=0), 0.02, axis=0):
            for _ in range(4):  # a pendulum integrated step by step
                speed += 0.005 * (-push - omega**2 * swing)
                swing += 0.005 * speed
            most = max(most, float(np.hypot(*swing)))
        left = np.hypot(np.hypot(*swing), np.hypot(*speed) / omega) * omega**2 / 9.81
        assert left < 0.09 and left < 0.8 * most * omega**2 / 9.81


def beside() -> tuple[Pose, Pose]:
    """Two places on one side of the machine, low over the ground."""
    arm = ARMS["aoro_fc8"]
    return arm.pose_above(3.0, 4.2, 0.6, 3.0), arm.pose_above(5.4, 3.0, 0.6, 3.0)


def test_a_tree_between_two_places_is_gone_around() -> None:
    arm, (start, goal) = ARMS["aoro_fc8"], beside()
    free = plan_path(arm, start, goal, collision_scene(AORO))
    q, pin = fine(arm, free.motion)
    half = pin[len(pin) // 2]
    trunk = tree_capsule(float(half[0]) * 1.06, float(half[1]) * 1.06, 0.15, -1.15)
    assert clearance_reserve(arm, free.motion, collision_scene(AORO, trees=[trunk]))[0] < -0.1
    path = plan_path(arm, start, goal, collision_scene(AORO, trees=[trunk]))
    q, pin = fine(arm, path.motion)
    assert path.name == "drawn in"
    assert clearances(collision_scene(AORO, trees=[trunk]), swept_capsules(AORO, q, pin, None))[:, :, -1].min() > 0.08
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

    low = fine(arm, plan_path(arm, start, goal, CollisionScene(-1.15)).motion)[1]
    high = fine(arm, plan_path(arm, start, goal, CollisionScene(hill)).motion)[1]
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
