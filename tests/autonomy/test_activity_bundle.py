"""Several logs in the jaws: lifted slowly while these close; logs that stay behind are dropped, fallen ones missed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phase_motions import BUNDLE_LIFT_S
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand
from can_dbc.messages.datagrams import decode
from machine.geometry.kinematics import Unreachable
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import StandIn
from tests.autonomy.grasp_scenes import PROFILE, cross, pair


class Bundle(StandIn):
    """A crane whose grapple takes the logs between its jaws; ``slips`` stay where they were."""

    slips: tuple[int, ...] = ()

    def _grip(self) -> None:
        taken = [log.id for log in self.logs if log.id not in self.slips and abs(self.pin()[1] - log.center_m[1]) < 0.5]
        if taken:
            self.held = taken[0]
        self._also = taken[1:]
        self._from = {log.id: np.array(log.center_m) - self.pin() for log in self.logs if log.id in taken}

    def _carry(self) -> None:
        if self.held is not None:
            for i, off in self._from.items():
                self._move(i, tuple(np.array(self.pin()) + off), (1.0, 0.0, 0.0))


def made(logs: list[LogObservation], slips: tuple[int, ...] = ()) -> tuple[Bundle, Activity]:
    crane = Bundle(PROFILE, logs)
    crane.slips = slips
    return crane, Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner()))


def until(crane: Bundle, planner: Activity, phase: Phase) -> list[GrappleCommand]:
    asked = []
    for _ in range(1200):
        if planner.phase is phase or planner.idle:
            break
        data = crane.step(planner)
        if data is not None and planner.phase is Phase.LIFT:
            setpoint = decode(data)
            assert isinstance(setpoint, CraneSetpoint)
            asked.append(setpoint.grapple)
    assert planner.phase is phase, planner.failure
    return asked


def test_a_bundle_is_lifted_slowly_while_the_jaws_keep_closing() -> None:
    crane, planner = made(pair())
    until(crane, planner, Phase.LIFT)
    assert planner.grasp is not None and {log.id for log in planner.grasp.logs} == {0, 1}
    begun_ns = crane.now_ns
    asked = until(crane, planner, Phase.CARRY)
    assert set(asked) == {GrappleCommand.CLOSE}
    assert crane.pin()[2] == pytest.approx(travel_height_m(PROFILE), abs=0.02)
    assert (crane.now_ns - begun_ns) * 1e-9 > BUNDLE_LIFT_S


def test_the_pin_waits_while_the_jaws_close_again() -> None:
    crane, planner = made(pair())
    until(crane, planner, Phase.LIFT)
    for _ in range(80):
        crane.step(planner)
    crane.gripped = False
    heights = []
    for _ in range(60):
        crane.gripped = False
        crane._grapple = lambda command: None  # type: ignore[method-assign]
        crane.step(planner)
        heights.append(crane.pin()[2])
    assert planner.phase is Phase.LIFT
    assert heights[-1] == pytest.approx(heights[-10], abs=2e-3) and heights[-1] > heights[0] - 1e-3


def test_a_log_that_stayed_behind_is_not_carried() -> None:
    crane, planner = made(pair(), slips=(0,))
    until(crane, planner, Phase.CARRY)
    assert planner.grasp is not None and [log.id for log in planner.grasp.logs] == [1] and planner.missed == 0


def test_a_bundle_that_slips_off_whole_is_gripped_again() -> None:
    crane, planner = made(pair(), slips=(0, 1))
    until(crane, planner, Phase.CLOSE)
    crane.slips = (0, 1)
    for _ in range(800):
        crane.step(planner)
        if planner.missed:
            break
    assert planner.missed == 1


def test_a_single_log_of_many_is_taken_from_the_top_and_laid_down() -> None:
    logs = [replace(log, center_m=(*log.center_m[:2], log.center_m[2])) for log in cross()]
    crane, planner = made(logs, slips=(0, 1))
    until(crane, planner, Phase.CARRY)
    assert planner.grasp is not None and planner.grasp.log.id == 2
    assert not any(lies_in_bunk(PROFILE.bunk, log) for log in crane.logs)


def test_a_bundle_without_a_path_on_is_released_a_little_above_where_it_lay(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise Unreachable("no way is clear")

    monkeypatch.setattr("autonomy.crane_job.cycle.carry_motion", refuse)
    crane, planner = made(pair())
    until(crane, planner, Phase.OPEN)
    assert planner.grasp is not None
    assert 0.1 < crane.pin()[2] - planner.grasp.pose.z_m < 0.3
