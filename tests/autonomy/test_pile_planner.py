"""Grasps that penetrate a pile: where, how deep, and what happens when nothing comes up."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, pi, remainder

import numpy as np
import pytest

from autonomy.crane_job.grasp_verification import is_at_target
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.pile_planner import DEPTHS_M, FAILED_RADIUS_M, PilePlanner
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.quality import jaws_of
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.loading.profile_file import load_profile
from machine.profile import Bunk
from tests.autonomy.crane_stand_in import StandIn, activity
from tests.autonomy.grasp_scenes import PROFILE as PALMS
from tests.codes import coded

AORO = load_profile("aoro_fc8")
ARM, BUNK, JAWS = Arm(AORO), AORO.bunk, jaws_of(AORO)
THICK = 0.25


def row(first: int, count: int, layer: int, shift_m: float = 0.0) -> list[LogObservation]:
    """Logs side by side along the bunk, a third of a metre apart, in a layer."""
    z = BUNK.floor_z_m + THICK / 2 + layer * 0.2
    across = [shift_m + 0.33 * (i - (count - 1) / 2) for i in range(count)]
    return [
        LogObservation(first + i, (BUNK.center_m[0], y, z), (1.0, 0.0, 0.0), 2.0, THICK) for i, y in enumerate(across)
    ]


def heap() -> list[LogObservation]:
    """Two layers, one in the valleys of the other."""
    return row(0, 6, 0) + row(6, 5, 1)


def planner() -> PilePlanner:
    return PilePlanner(SamplingPlanner())


def asked(logs: list[LogObservation], **how) -> GraspRequest:
    return GraspRequest(ARM, logs, 0.0, **how)


def test_a_pile_is_penetrated_and_several_logs_are_between_the_jaws() -> None:
    logs = heap()
    p = planner()(asked(logs))
    assert p.penetrates and len(p.logs) >= 2 and "\n" not in p.reason
    assert abs(remainder(p.yaw_rad - pi / 2, pi)) < 0.15, "across the logs"
    wood = sum(pi * (logs[i].diameter_m / 2) ** 2 for i in p.logs)
    assert wood < 1.1 * JAWS.capacity_m2
    top = max(log.center_m[2] + log.diameter_m / 2 for log in logs)
    assert BUNK.floor_z_m <= p.support_z_m < top - DEPTHS_M[0] + 1e-6


def test_no_tip_comes_down_on_the_middle_of_a_log() -> None:
    logs = heap()
    p = planner()(asked(logs))
    for side in (-1.0, 1.0):
        tip = p.y_m + side * (JAWS.half_gap_m + JAWS.plate_m / 2)
        met = [log for log in logs if log.center_m[2] > p.support_z_m]
        assert all(abs(log.center_m[1] - tip) > 0.1 * log.diameter_m for log in met)


def test_logs_that_lie_on_no_others_are_left_to_the_other_planner() -> None:
    p = planner()(asked(row(0, 3, 0)))
    assert not p.penetrates and p == SamplingPlanner()(asked(row(0, 3, 0)))


def test_a_row_without_a_safe_grasp_is_penetrated() -> None:
    def never(request: GraspRequest) -> GraspCandidate:
        raise NoGrasp("grasp.none-safe", "no grasp of the 6 logs is safe")

    p = PilePlanner(never)(asked(row(0, 6, 0)))
    assert p.penetrates and p.logs and p.support_z_m >= BUNK.floor_z_m


def test_nothing_in_view_is_no_grasp() -> None:
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-in-view")):
        planner()(asked([]))


def test_a_place_where_nothing_came_up_is_not_tried_again_until_something_did() -> None:
    press, logs = planner(), heap()
    first, second, third = (press(asked(logs)) for _ in range(3))
    places = [(p.x_m, p.y_m) for p in (first, second, third)]
    for i, a in enumerate(places):
        assert all(hypot(a[0] - b[0], a[1] - b[1]) >= FAILED_RADIUS_M - 1e-9 for b in places[:i])
    press(asked([log for i, log in enumerate(logs) if i not in third.logs]))
    assert press(asked(logs)) == first, "something came up: every place is as good as before"


def test_a_place_that_was_not_tried_has_not_failed() -> None:
    """A crane that selects again from above, before its jaws close, marked its own choice as failed."""
    press, logs = planner(), heap()
    assert press(asked(logs)) == press(asked(logs, untried=True)) != press(asked(logs))


def test_a_log_that_only_rolled_has_not_come_up() -> None:
    press, logs = planner(), heap()
    first = press(asked(logs))
    moved = [replace(log, center_m=(log.center_m[0] + 0.02, *log.center_m[1:])) for log in logs]
    second = press(asked(moved))
    assert hypot(first.x_m - second.x_m, first.y_m - second.y_m) > FAILED_RADIUS_M / 2


class Resisting(StandIn):
    """A crane that a pile stops at ``floor_z_m``."""

    floor_z_m = -inf

    def report(self) -> StateReport:
        said, arm = super().report(), Arm(self.profile)
        pose = arm.pose(said.position)
        held_up = arm.joints(np.array([pose.at_height(max(pose.z_m, self.floor_z_m))]))[0]
        return replace(said, position=tuple(float(v) for v in held_up))


@pytest.mark.parametrize(("pressed", "short_m"), [(True, 0.12), (True, 0.4), (False, 0.12)])
def test_penetrating_jaws_that_rest_on_wood_close_there(pressed: bool, short_m: float) -> None:
    logs = [LogObservation(0, (-1.8, 4.4, -1.29), (0.6, 0.8, 0.0), 2.6, 0.2)]

    def chooser(arm, mission, seen, slew, rot):
        return replace(PlannerSelection(SamplingPlanner())(arm, mission, seen, slew, rot), penetrates=pressed)

    crane = Resisting(PALMS, logs)
    job = activity(grasp_selector=chooser)
    crane.until(job, Phase.DESCEND)
    begun_ns = crane.now_ns
    crane.floor_z_m = job.grasp.pose.z_m + short_m
    for _ in range(400):
        crane.step(job)
        if job.phase is not Phase.DESCEND:
            break
    begun_s = (crane.now_ns - begun_ns) * 1e-9
    assert not pressed or begun_s < 3.0, "before the controller takes the joint for stuck"
    assert job.phase is (Phase.CLOSE if pressed else Phase.FAILED), job.failure


def test_a_log_that_rolls_beside_a_landing_is_laid_down_but_not_one_that_still_hangs() -> None:
    pile = Bunk((0.4, -2.9), 0.0, 3.0, 2.6, -1.4, 1.5)
    unloading, loading = CraneJob(source=BUNK, target=pile), CraneJob(target=pile)
    rolled = LogObservation(0, (0.4, -4.6, -1.3), (1.0, 0.0, 0.0), 2.0, 0.2)
    hanging = replace(rolled, center_m=(0.4, -4.6, 0.9))
    assert not lies_in_bunk(pile, rolled) and is_at_target(unloading, pile, rolled)
    assert not is_at_target(unloading, pile, hanging) and not is_at_target(loading, pile, rolled)
    assert not is_at_target(unloading, pile, replace(rolled, center_m=(*BUNK.center_m, 0.6)))


def test_no_place_with_a_log_that_must_stay_between_the_jaws_is_penetrated() -> None:
    logs = heap()
    taken = planner()(asked(logs)).logs
    other = planner()(asked(logs, stay=taken[:1]))
    assert other.penetrates and taken[0] not in other.logs and other.logs
    with pytest.raises(NoGrasp):
        planner()(asked(logs, stay=range(len(logs))))
