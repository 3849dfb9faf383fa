"""The rule and the search: what they take, what they leave, and when they say that nothing can be had."""

from __future__ import annotations

from dataclasses import fields, replace
from math import atan2, pi, remainder

import msgspec
import numpy as np
import pytest

from autonomy.grasp.cylinders import as_cylinders, default_covariance, sample_cylinders
from autonomy.grasp.grapple_heights import hover_height_m
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp, restricted_to
from autonomy.grasp.quality import (
    LAYER_RULE,
    STRICT_RULE,
    CaptureRule,
    blade_sections,
    jaws_of,
    rests_upon,
    score_grasps,
)
from autonomy.grasp.sampling_planner import MOST_UNDER_M, SamplingPlanner
from autonomy.grasp.selection import PlannerSelection, select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogEstimate, LogObservation
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from tests.autonomy.grasp_scenes import ARM, GROUND, PROFILE, X, Y, cross, log, pair, small_pile
from tests.codes import coded

JAWS = jaws_of(PROFILE)


def planned(logs: list[LogObservation], arm: Arm = ARM, **how) -> GraspCandidate:
    return SamplingPlanner()(GraspRequest(arm, logs, 0.0, **how))


def is_safe(
    logs: list[LogObservation],
    across_m: float,
    yaw: float = pi / 2,
    level: float = GROUND,
    rule: CaptureRule = STRICT_RULE,
) -> bool:
    world = as_cylinders(logs)
    at = blade_sections(JAWS, world, np.array([X]), np.array([Y + across_m]), np.array([yaw]))
    return bool(score_grasps(JAWS, world, rests_upon(world), at, np.array([level]), rule).safe[0])


ACROSS = log(1, 0.0, 0.2, yaw=pi / 2, along_m=0.8)
BESIDE = [log(0, -0.18, diameter=0.26), log(1, 0.16, diameter=0.24)]
LAYER = {"level": GROUND + 0.19, "rule": LAYER_RULE}
ROW, UPON = [log(0, -0.3, diameter=0.26), log(1, 0.3, diameter=0.26)], log(2, 0.0, 0.1, diameter=0.3)
CLOSE = [log(0, -0.26, diameter=0.26), log(1, 0.26, diameter=0.26)]
THICK = [log(0, -0.22, diameter=0.29), log(2, 0.22, diameter=0.29)]
RULE = {
    "one log": ([log(0)], {}, True),
    "askew": ([log(0)], {"yaw": pi / 2 + 0.6}, False),
    "a tong comes down on it": ([log(0)], {"across_m": 0.72}, False),
    "nothing between the tongs": ([log(0)], {"across_m": 1.2}, False),
    "(c): from under another that lies across it": ([log(0), ACROSS], {}, False),
    "only its end": ([log(0, along_m=1.25)], {}, False),
    "too much": ([log(i, 0.31 * (i - 1.5), diameter=0.3) for i in range(4)], {}, False),
    "a small pile": (small_pile(), {}, True),
    "two thick ones": (THICK, {}, True),
    "pinched above a thinner one": ([*THICK, log(1, 0.0, diameter=0.13)], LAYER | {"level": GROUND + 0.14}, False),
    "tips that ride up meet a high one": ([*BESIDE, log(2, 0.0, 0.22, diameter=0.1)], LAYER, True),
    "they miss one deep between": ([*BESIDE, log(2, 0.0, 0.15, diameter=0.1)], LAYER, False),
    "a row": (ROW, {}, True),
    "a row that one upon it keeps apart": ([*ROW, UPON], {}, False),
    "a close row with one upon it": ([*CLOSE, UPON], {}, True),
    "one beside and one upon": ([ROW[0], UPON], {}, True),
    "and an outer one that floats": ([ROW[0], UPON, log(1, 0.33, 0.12, diameter=0.12)], {}, False),
}


@pytest.mark.parametrize(("logs", "how", "safe"), RULE.values(), ids=RULE)
def test_the_rule(logs: list[LogObservation], how: dict, safe: bool) -> None:
    assert is_safe(logs, **{"across_m": 0.0} | how) is safe


def test_a_log_rests_upon_those_that_it_lies_on_and_not_upon_a_thin_one_beside_it() -> None:
    assert rests_upon(as_cylinders([log(0), ACROSS])).tolist() == [[False, True], [False, False]]
    assert not rests_upon(as_cylinders([log(0, diameter=0.12), log(1, 0.21, diameter=0.3)])).any()
    assert rests_upon(as_cylinders(small_pile())).tolist() == [[False, False, True], [False, False, True], [False] * 3]


def test_a_single_log_is_gripped_across_its_middle() -> None:
    turned = log(7, yaw=0.6)
    p = planned([turned])
    assert p.logs == (0,) and p.probability > 0.9
    assert np.hypot(p.x_m - turned.center_m[0], p.y_m - turned.center_m[1]) < 0.1
    assert abs(remainder(p.yaw_rad - 0.6 - pi / 2, pi)) < 0.15
    assert p.support_z_m == pytest.approx(GROUND, abs=1e-3)
    assert "(7)" in p.reason and "\n" not in p.reason


@pytest.mark.parametrize("logs", [pair(), small_pile()])
def test_what_fits_comes_up_together(logs: list[LogObservation]) -> None:
    p = planned(logs)
    assert p.logs == tuple(range(len(logs)))
    assert abs(p.y_m - Y) < 0.1, "in the middle of all"


def test_the_log_on_top_is_taken_and_those_below_are_left() -> None:
    assert planned(cross()).logs == (2,)


def test_of_logs_that_are_too_heavy_together_one_is_taken() -> None:
    both = [log(0, -0.32, diameter=0.28), log(1, 0.32, diameter=0.28)]
    assert planned(both).logs == (0, 1)
    weak = PROFILE.stability
    arm = Arm(msgspec.structs.replace(PROFILE, stability=msgspec.structs.replace(weak, stabilising_nm=21e3)))
    assert len(planned(both, arm).logs) == 1
    arm = Arm(msgspec.structs.replace(PROFILE, stability=msgspec.structs.replace(weak, stabilising_nm=12e3)))
    with pytest.raises(NoGrasp, check=coded("grasp.too-heavy")):
        planned(both, arm)


def test_from_above_a_layer_only_that_layer_is_taken() -> None:
    pile = small_pile()
    world = as_cylinders(pile)
    at = blade_sections(JAWS, world, np.array([X]), np.array([Y]), np.array([pi / 2]))
    at = replace(at, **{f.name: getattr(at, f.name)[:, None, :] for f in fields(at)})  # the same place at both levels
    found = score_grasps(JAWS, world, rests_upon(world), at, np.array([GROUND, GROUND + 0.2]))
    assert found.captured[0].tolist() == [[True, True, True], [False, False, True]]


def test_uncertain_perception_makes_a_grasp_less_probable() -> None:
    wide = LogEstimate(np.zeros(3), np.ones(3), 1.0, 0.1, np.diag([0.3, 0.05, 0.2, 0.05, 0.2, 0.2, 0.02]) ** 2)
    known = wide.observation(0).covariance
    unsure = [replace(o, covariance=known) for o in pair()]
    assert planned(unsure).probability < planned(pair()).probability - 0.1


@pytest.mark.parametrize("sunk_m", [-0.1, 0.0, 0.1])
def test_a_machine_on_wheels_takes_the_ground_from_the_logs(sunk_m: float) -> None:
    """Its frame goes up and down: what the profile says of the ground is nothing to go by."""
    arm = Arm(load_profile("aoro_fc8"))
    ground = arm.profile.workspace.ground_z_m - sunk_m
    x, y = arm.profile.workspace.pick_center_m
    places = ((0.0, 0.1), (0.21, 0.1), (0.105, 0.27))
    logs = [
        LogObservation(i, (x, y + side, ground + up), (1.0, 0.0, 0.0), 2.6, 0.2) for i, (side, up) in enumerate(places)
    ]
    p = planned(logs, arm)
    assert set(p.logs) == {0, 1, 2} and p.support_z_m == pytest.approx(ground, abs=1e-3)
    alone = planned([replace(logs[0], center_m=(x, y + 3.0, ground + 0.4))], arm)
    assert alone.support_z_m == pytest.approx(ground + 0.3, abs=1e-3), "it lies on a bank"


def test_samples_have_the_requested_spread() -> None:
    world = as_cylinders([log(0, yaw=0.8)])
    sigma = np.sqrt(np.diag(default_covariance(log(0))))
    drawn = sample_cylinders(world, np.diag(sigma**2)[None], 4000, 3)
    off = drawn.center[:, 0] - world.center
    across = off @ np.array([-np.sin(0.8), np.cos(0.8), 0.0])
    assert np.std(across) == pytest.approx(sigma[0], rel=0.05)
    assert np.std(off[:, 2]) == pytest.approx(sigma[1], rel=0.05)
    assert np.std(drawn.length) == pytest.approx(np.hypot(sigma[4], sigma[5]), rel=0.05)
    again = sample_cylinders(world, np.diag(sigma**2)[None], 4000, 3)
    assert np.array_equal(again.center, drawn.center)
    with pytest.raises(InputRefused, check=coded("grasp.covariance-not-finite")):
        sample_cylinders(world, np.full((1, 7, 7), np.nan), 2, 0)


def test_logs_that_a_camera_sees_too_high_are_gripped_at_the_ground() -> None:
    raised = [replace(o, center_m=(*o.center_m[:2], o.center_m[2] + 0.05)) for o in small_pile()]
    assert planned(raised).support_z_m == pytest.approx(GROUND, abs=1e-3)


def test_higher_logs_out_of_reach_hide_none_in_reach() -> None:
    far = [log(i, along_m=-9.0, z_m=0.3 + 0.1 * i) for i in range(12)]
    assert planned([*far, log(12)]).logs == (12,)


def test_nothing_to_grip_is_one_error() -> None:
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-in-view")):
        planned([])
    standing = replace(log(0), axis=(0.0, 0.1, 0.995))
    with pytest.raises(NoGrasp, check=coded("grasp.none-safe")):
        planned([standing])
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-in-reach")):
        planned([replace(log(0), center_m=(-6.0, 7.0, GROUND + 0.1))])


def test_a_proposal_becomes_a_grasp_of_several_logs() -> None:
    grasp = PlannerSelection(SamplingPlanner())(ARM, CraneJob(), small_pile(), 0.0, 0.0)
    assert {o.id for o in grasp.logs} == {0, 1, 2} and grasp.is_bundle and grasp.thinnest_m == 0.2
    top = GROUND + small_pile()[2].center_m[2] - GROUND + 0.1
    assert hover_height_m(PROFILE, grasp) - tip_below_pin_m(PROFILE.grapple.jaws, 0.0) > top
    rest = restricted_to(ARM, grasp, [2])
    assert rest.log.id == 2 and rest.others == () and abs(rest.along_m) < 0.2
    assert restricted_to(ARM, grasp, [0, 1, 2]) is grasp


def test_a_job_that_names_its_log_is_served_directly() -> None:
    grasp = PlannerSelection(SamplingPlanner())(ARM, CraneJob(log_id=1), pair(), 0.0, 0.0)
    assert [o.id for o in grasp.logs] == [1] and not grasp.is_bundle
    opening = grasp.pose.slew_rad + grasp.pose.rot_rad
    assert abs(remainder(opening - atan2(0.0, 1.0), pi)) == pytest.approx(pi / 2)


def test_a_log_that_must_stay_is_never_taken_and_still_an_obstacle() -> None:
    apart = [log(0, -0.3), log(1, 0.3)]
    assert planned(apart).logs == (0, 1)
    p = planned(apart, stay={0})
    assert p.logs == (1,) and p.y_m > Y + 0.3, "the tongs come down beside it"
    with pytest.raises(NoGrasp, check=coded("grasp.none-safe")):
        planned(pair(), stay=(0,))
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-in-reach")):
        planned(pair(), stay=(0, 1))


def test_nothing_is_taken_from_under_a_log_that_must_stay() -> None:
    logs = small_pile()
    assert 2 not in planned([*logs[:2], log(2, 1.0)], stay=(2,)).logs
    with pytest.raises(NoGrasp):
        planned(logs, stay=(2,))


def test_a_job_names_the_logs_that_stay_by_their_numbers() -> None:
    apart = [log(7, -0.3), log(8, 0.3)]
    grasp = PlannerSelection(SamplingPlanner())(ARM, CraneJob(leave=(7,)), apart, 0.0, 0.0)
    assert grasp.log.id == 8 and not grasp.others
    assert ARM.xy(grasp.pose)[1] > Y + 0.3, "the planner knows of the one that stays"
    assert select_direct(ARM, CraneJob(leave=(8,)), apart, 0.0, 0.0).log.id == 7
    for chooser in (select_direct, PlannerSelection(SamplingPlanner())):
        with pytest.raises(NoGrasp, check=coded("grasp.all-logs-stay")):
            chooser(ARM, CraneJob(leave=(7, 8)), apart, 0.0, 0.0)
        with pytest.raises(NoGrasp, check=coded("grasp.no-log-outside-bunk")):
            chooser(ARM, CraneJob(leave=(7, 8)), [], 0.0, 0.0)


def measured(logs: list[LogObservation]) -> list[LogObservation]:
    """As a good camera measures them."""
    well = LogEstimate(np.zeros(3), np.ones(3), 1.0, 0.1, np.diag([0.01, 0.02, 0.01, 0.02, 0.1, 0.1, 0.005]) ** 2)
    return [replace(o, covariance=well.observation(0).covariance) for o in logs]


def test_jaws_penetrate_a_pile_that_a_camera_measured_but_not_the_ground() -> None:
    heap = [*(log(i, 0.21 * i) for i in range(-3, 4)), log(9, 0.105, 0.18)]
    known, seen = planned(heap), planned(measured(heap))
    assert known.logs == seen.logs == (7,)
    assert not known.penetrates and seen.penetrates
    assert seen.support_z_m == pytest.approx(GROUND + 0.18 - MOST_UNDER_M, abs=0.01)
    whole = planned(measured(pair()))
    assert not whole.penetrates and whole.support_z_m == pytest.approx(GROUND, abs=1e-3)


def test_jaws_that_penetrate_still_pass_over_the_logs_beside_what_they_take() -> None:
    """They would clasp them, come up with the whole pile or slip off."""
    p = planned(measured([*(log(i, 0.3 * i, diameter=0.28) for i in range(-3, 4)), log(9, 0.15, 0.2)]))
    assert p.logs == (7,) and p.penetrates
    assert p.support_z_m > GROUND + 0.2 - MOST_UNDER_M + 0.01


def test_jaws_do_not_penetrate_over_a_log_that_lies_across() -> None:
    """They would take it, too, and hang askew."""
    row = [log(i, 0.24 * i, diameter=0.24) for i in range(-3, 4)]
    on_top = log(9, 0.0, 0.22)
    across = LogObservation(8, on_top.center_m, (0.0, 1.0, 0.0), 2.0, 0.2)
    beneath = measured([*row, replace(on_top, center_m=(X, Y, on_top.center_m[2] + 0.2)), across])
    p = planned(beneath)
    assert p.logs == (7,) and not p.penetrates
    assert planned(measured([*row, on_top])).penetrates


def test_a_floating_log_is_neither_gripped_nor_an_obstacle() -> None:
    """A detection of the crane's own jaws, as a camera once measured it."""
    ghost = LogObservation(9, (X, Y, GROUND + 1.6), (-0.8, 0.38, -0.46), 1.92, 0.09)
    logs = measured(pair())
    alone, haunted = planned(logs), planned([ghost, *logs])
    assert haunted.logs == tuple(i + 1 for i in alone.logs) and (haunted.x_m, haunted.y_m) == (alone.x_m, alone.y_m)
    assert planned([log(0, -0.4), ghost, log(1, 0.4)], stay=(0,)).logs == (2,)
    with pytest.raises(NoGrasp, check=coded("grasp.no-supported-log")):
        planned([ghost])


WALL = [log(i, 0.24 * i, diameter=0.24) for i in range(-3, 4)]


def test_a_log_is_extracted_from_a_row_that_is_too_wide() -> None:
    with pytest.raises(NoGrasp, check=coded("grasp.none-safe")):
        planned(WALL)
    p = planned(measured(WALL))
    assert p.penetrates and p.logs in {(0,), (6,)} and p.extracts
    end = WALL[p.logs[0]].center_m[1]
    inner, outer = sorted((p.y_m - JAWS.half_gap_m, p.y_m + JAWS.half_gap_m), key=lambda y: abs(y - Y))
    assert abs(inner - end) == pytest.approx(0.14, abs=0.001) and abs(inner - Y) < abs(end - Y), (
        "in the valley beside it"
    )
    assert abs(outer - Y) > abs(end - Y) + 1.0, "and on free ground"
    assert p.logs == (0,)
    beside = planned(measured([*WALL, log(9, -1.6)]), stay=(7,))
    assert beside.logs == (6,), "where another lies there is no room"
    laden = planned(measured([*WALL, on_top(WALL[0], WALL[1])]), stay=(7,))
    assert laden.logs == (6,), "none that another lies on, where the others are free"


def on_top(a: LogObservation, b: LogObservation) -> LogObservation:
    """A log in the valley between two."""
    (x, ya, z), yb = a.center_m, b.center_m[1]
    return replace(a, id=8, center_m=(x, 0.5 * (ya + yb), z + 0.21))


def test_without_a_safe_grasp_camera_measured_logs_are_gripped_at_the_top() -> None:
    p = planned(measured(WALL), stay=(0, 6))
    assert p.probability == 0.3 and len(p.logs) == 1 and "\n" not in p.reason
    one = WALL[p.logs[0]]
    assert np.hypot(p.x_m - one.center_m[0], p.y_m - one.center_m[1]) < 0.01


def test_on_wheels_nothing_penetrates_below_the_lowest_log() -> None:
    arm = Arm(load_profile("aoro_fc8"))
    x, y = arm.profile.workspace.pick_center_m
    logs = measured([LogObservation(i, (x, y + 0.25 * i, -1.0), (1.0, 0.0, 0.0), 2.6, 0.2) for i in range(-4, 5)])
    p = planned(logs, arm)
    assert p.support_z_m >= -1.1 - 1e-6
