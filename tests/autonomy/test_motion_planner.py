"""Whose motions the crane makes, and what is done where there is none that is clear."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.crane_job.phase_motions import MACHINE_LEAN_M, approach_motion, carry_motion
from autonomy.grasp.bunk_load import plan_place
from autonomy.grasp.grapple_heights import hover_height_m, travel_height_m
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion import motion_planner
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.clearance import MARGIN_M, clearance_reserve
from autonomy.motion.motion_planner import MovementPrimitivePlanner, TimeOptimalPlanner
from autonomy.motion.movement_primitives import load
from autonomy.motion.obstacles import CollisionScene, collision_scene, held_log, tree_capsule
from autonomy.motion.path_search import PathBlocked, plan_path
from autonomy.motion.trajectory import Trajectory, travel_over
from autonomy.perception.log_list import LogObservation
from machine.loading.profile_file import load_profile
from tests.codes import coded

PROFILE = load_profile("aoro_fc8")
ARM, HIGH = Arm(PROFILE), travel_height_m(PROFILE)
GROUND = PROFILE.workspace.ground_z_m
LOG = LogObservation(0, (3.6, 3.2, GROUND + 0.12), (1.0, 0.0, 0.0), 2.0, 0.24)
GRASP = plan_single_log_grasp(ARM, LOG, 0.0)
PLACE = plan_place(ARM, CraneJob(), GRASP, [LOG])
OVER = GRASP.pose.at_height(hover_height_m(PROFILE, GRASP))


def pins(motion: Trajectory) -> np.ndarray:
    return np.array([ARM.pose(q)[:3] for q in motion.position])


def blocked(*_: object) -> None:
    raise PathBlocked("no path is clear: as requested", "motion.path-blocked")


def test_the_time_optimal_planner_goes_down_to_the_log_and_into_the_bunk_in_one_motion() -> None:
    """On tyres to just above it: the machine leans, and the rest of the descent is vertical."""
    out = approach_motion(ARM, TimeOptimalPlanner(), PLACE, GRASP, [LOG])
    back = carry_motion(ARM, TimeOptimalPlanner(), GRASP.pose, PLACE, GRASP, [LOG], hangs=False)
    assert pins(out)[-1] == pytest.approx(GRASP.pose.at_height(GRASP.pose.z_m + MACHINE_LEAN_M)[:3], abs=1e-3)
    assert pins(back)[-1] == pytest.approx(PLACE[:3], abs=1e-3)
    assert max(out.duration_s, back.duration_s) < 10.5
    held = held_log(ARM, GRASP.pose, LOG)
    assert clearance_reserve(ARM, back, collision_scene(PROFILE), held)[0] >= -0.01


def test_a_place_only_reachable_from_above_is_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_high(arm: Arm, start: Pose, goal: Pose, *more: object) -> object:
        if goal.z_m < HIGH:
            raise PathBlocked("too near to the stakes", "motion.path-blocked")
        return plan_path(arm, start, goal, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(motion_planner, "plan_path", only_high)
    monkeypatch.setattr(motion_planner, "clearance_reserve", lambda *_: (-1.0, ""))
    motion = carry_motion(ARM, TimeOptimalPlanner(), GRASP.pose, PLACE, GRASP, [LOG], hangs=False)
    assert pins(motion)[-1] == pytest.approx((PLACE.slew_rad, PLACE.r_m, HIGH), abs=2e-3)


def test_the_end_of_the_descent_is_above_the_log() -> None:
    pin = pins(approach_motion(ARM, TimeOptimalPlanner(), PLACE, GRASP, [LOG]))
    aside = np.abs(pin[:, 1] - GRASP.pose.r_m)
    assert np.max(aside[pin[:, 2] < GRASP.pose.z_m + 0.3]) < 0.25


def test_among_other_logs_it_stops_above() -> None:
    beside = LogObservation(1, (3.6, 3.55, GROUND + 0.12), (1.0, 0.0, 0.0), 2.0, 0.24)
    gathered = GRASP.__class__(LOG, GRASP.pose, GRASP.support_z_m, 0.0, (), GROUND + 0.24)
    out = approach_motion(ARM, TimeOptimalPlanner(), PLACE, gathered, [LOG, beside])
    assert pins(out)[-1, 2] == pytest.approx(hover_height_m(PROFILE, gathered), abs=1e-3)


def test_where_no_fast_path_is_clear_the_one_at_full_height_replaces_it_only_if_clear(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(motion_planner, "plan_path", blocked)
    free = CollisionScene(GROUND)
    slow = TimeOptimalPlanner()(ARM, PLACE, OVER, free, None, HIGH, 0.0)
    assert slow == travel_over(ARM, PLACE, OVER, HIGH, 0.0)
    x, y = (0.5 * (a + b) for a, b in zip(ARM.xy(PLACE), ARM.xy(OVER), strict=True))
    stands = collision_scene(PROFILE, trees=[tree_capsule(x, y, 0.2, GROUND)])
    with pytest.raises(PathBlocked, check=coded("motion.path-blocked")):
        TimeOptimalPlanner()(ARM, PLACE, OVER, stands, None, HIGH, 0.0)


def test_a_path_search_ends() -> None:
    wall = [tree_capsule(2.0 + 0.3 * k, 2.2, 0.15, GROUND) for k in range(12)]
    with pytest.raises(PathBlocked):
        plan_path(ARM, PLACE, GRASP.pose, collision_scene(PROFILE, trees=wall))


def test_paper_bs_planner_uses_the_primitive_unless_it_would_touch_something() -> None:
    shown = MovementPrimitivePlanner(load(PROFILE))
    free = collision_scene(PROFILE)
    start = PLACE.at_height(PLACE.z_m + 0.9)
    motion = shown(ARM, start, OVER, free, None, HIGH, 0.0)
    assert not shown.direct and clearance_reserve(ARM, motion, free)[0] >= -MARGIN_M
    assert motion != travel_over(ARM, start, OVER, HIGH, 0.0)
    z = pins(motion)[len(motion.position) // 2][2]
    middle = ARM.xy(ARM.pose(motion.position[len(motion.position) // 2]))
    in_the_way = collision_scene(PROFILE, trees=[tree_capsule(*middle, 0.1, GROUND, z - GROUND - 0.3)])
    assert shown(ARM, start, OVER, in_the_way, None, HIGH, 0.0) == travel_over(ARM, start, OVER, HIGH, 0.0)
