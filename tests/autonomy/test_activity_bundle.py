"""Several logs in the jaws: lifted slowly while these close; and a pile too wide for them to close."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.grasp_verification import MAX_RESTARTS
from autonomy.crane_job.phase_motions import BUNDLE_LIFT_S
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.weight import bearable_kg
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.grapple import tip_below_pin_m
from machine.geometry.kinematics import Unreachable, pin_position
from tests.autonomy.crane_stand_in import StandIn, activity, refusing
from tests.autonomy.grasp_scenes import GROUND, PROFILE, cross, measured, pair, small_pile
from tests.codes import numbers_in


class Bundle(StandIn):
    """A crane whose grapple takes the logs between its jaws; ``slips`` stay where they were."""

    slips: tuple[int, ...] = ()

    def _grip(self) -> None:
        taken = [log.id for log in self.logs if log.id not in self.slips and abs(self.pin()[1] - log.center_m[1]) < 0.5]
        if taken:
            self.held = taken[0]
        self._from = {log.id: np.array(log.center_m) - self.pin() for log in self.logs if log.id in taken}

    def _carry(self) -> None:
        if self.held is not None:
            for i, off in self._from.items():
                self._move(i, tuple(np.array(self.pin()) + off), (1.0, 0.0, 0.0))


def made(logs: list[LogObservation], slips: tuple[int, ...] = ()) -> tuple[Bundle, Activity]:
    crane = Bundle(PROFILE, logs)
    crane.slips = slips
    return crane, activity(planner=SamplingPlanner())


def test_a_bundle_is_lifted_slowly_while_the_jaws_keep_closing() -> None:
    crane, planner = made(pair())
    crane.until(planner, Phase.LIFT)
    assert {log.id for log in planner.grasp.logs} == {0, 1}
    begun_ns = crane.now_ns
    while planner.phase is Phase.LIFT:
        assert crane.setpoint.grapple is GrappleCommand.CLOSE
        crane.step(planner)
    assert planner.phase is Phase.CARRY, planner.failure
    assert crane.pin()[2] == pytest.approx(travel_height_m(PROFILE), abs=0.02)
    assert (crane.now_ns - begun_ns) * 1e-9 > BUNDLE_LIFT_S


def test_the_pin_waits_while_the_jaws_close_again() -> None:
    crane, planner = made(pair())
    crane.until(planner, Phase.LIFT)
    crane.steps(planner, 80)
    crane.gripped = False
    heights = []
    for _ in range(60):
        crane.gripped = False
        crane._grapple = lambda command: None
        crane.step(planner)
        heights.append(crane.pin()[2])
    assert planner.phase is Phase.LIFT
    assert heights[-1] == pytest.approx(heights[-10], abs=2e-3) and heights[-1] > heights[0] - 1e-3


def test_a_log_that_stayed_behind_is_not_carried() -> None:
    crane, planner = made(pair(), slips=(0,))
    crane.until(planner, Phase.CARRY)
    assert [log.id for log in planner.grasp.logs] == [1] and planner.missed == 0


def test_a_bundle_that_slips_off_whole_is_gripped_again() -> None:
    crane, planner = made(pair(), slips=(0, 1))
    for _ in range(1600):
        crane.step(planner)
        if planner.missed:
            break
    assert planner.missed == 1


def test_a_single_log_of_many_is_taken_from_the_top_and_laid_down() -> None:
    crane, planner = made(cross(), slips=(0, 1))
    crane.until(planner, Phase.CARRY)
    assert planner.grasp.log.id == 2
    assert not any(lies_in_bunk(PROFILE.bunk, log) for log in crane.logs)


def test_a_bundle_without_a_path_on_is_released_a_little_above_where_it_lay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("autonomy.crane_job.cycle.carry_motion", refusing(Unreachable("no way is clear")))
    crane, planner = made(pair())
    crane.until(planner, Phase.OPEN)
    assert 0.1 < crane.pin()[2] - planner.grasp.pose.z_m < 0.3


# -- a pile too wide for the jaws
STALL_RAD = 0.5  # of 2.25: opened by four fifths


class Heap(StandIn):
    """Tongs that come down deeper than ``shoulder_m`` meet logs on both sides."""

    shoulder_m = GROUND + 0.12
    gives_rad = 0.0  # in a tick
    heavy_kg = 0.0
    """What hangs in the tongs that clasp, in full once the pin has risen by 0.3 m."""

    @property
    def load_kg(self) -> float:
        risen_m = self.pin_m() - self.clasped_m
        return self.heavy_kg * min(max(risen_m / 0.3, 0.0), 1.0) if self.gripped else 0.0

    clasped_m = 9.0

    def pin_m(self) -> float:
        """Height of the pin by the joints."""
        return pin_position(self.profile.kinematics, self.q)[2]

    def seen(self) -> tuple[LogObservation, ...]:
        return tuple(measured(log) for log in self.logs)

    def _grapple(self, command: GrappleCommand) -> None:
        before, tip_m = self.gripped, self.pin()[2] - tip_below_pin_m(self.profile.grapple.jaws, self.tong_rad)
        if command is GrappleCommand.CLOSE and self.tong_rad >= STALL_RAD and tip_m < self.shoulder_m:
            self.gripped = True
            self.tong_rad += self.gives_rad
        else:
            self.gripped = self.held is not None or (self.heavy_kg > 0.0 and self.gripped)
            super()._grapple(command)
        if self.gripped and not before:
            self.clasped_m = self.pin_m()


def lifting(**told: float) -> tuple[Heap, Activity, list[Phase]]:
    """A heap with these attributes, the job at the beginning of its lift, and its phases since the first descent."""
    heap, planner = Heap(PROFILE, small_pile()), activity(planner=SamplingPlanner())
    for name, value in told.items():
        setattr(heap, name, value)
    phases = heap.until(planner, Phase.LIFT)
    return heap, planner, phases[phases.index(Phase.DESCEND) :]


def test_jaws_that_stall_at_the_sides_of_a_pile_close_on_while_they_lift_it() -> None:
    heap, planner, phases = lifting()
    assert phases == [Phase.DESCEND, Phase.CLOSE, Phase.LIFT] and heap.tong_rad < STALL_RAD + 0.1
    while planner.phase is Phase.LIFT and heap.tong_rad < STALL_RAD + 0.5:
        heap.step(planner)
    assert planner.phase is Phase.LIFT


def test_a_pile_that_yields_slowly_is_waited_for() -> None:
    heap, _, phases = lifting(gives_rad=0.002)
    assert phases == [Phase.DESCEND, Phase.CLOSE, Phase.LIFT] and heap.tong_rad > STALL_RAD + 0.1


def test_what_is_too_heavy_is_laid_down_before_the_machine_stops_and_gripped_anew() -> None:
    heap, planner, _ = lifting(heavy_kg=600.0)
    begun_m, loads, opened_m = heap.pin_m(), [], []
    phases = [planner.phase]
    while planner.phase is not Phase.FAILED and len(phases) < 40:
        heap.step(planner)
        loads.append(heap.load_kg / bearable_kg(planner._cycle.arm, heap.q))
        if planner.phase is not phases[-1]:
            phases.append(planner.phase)
            begun_m = heap.pin_m() if planner.phase is Phase.LIFT else begun_m
            opened_m += [heap.pin_m() - begun_m] if planner.phase is Phase.OPEN else []
        assert planner.phase is not Phase.LIFT or heap.pin_m() < begun_m + 0.3
    assert max(loads) < 1.0
    assert phases.count(Phase.LIFT) == 1 + MAX_RESTARTS and planner.failure_code == "activity.too-heavy"
    assert 350.0 < numbers_in(planner.failure)[0] <= 600.0
    assert Phase.LIFT not in {b for a, b in pairwise(phases) if a is Phase.OPEN}
    assert {b for a, b in pairwise(phases) if a is Phase.LIFT} == {Phase.LOWER}
    assert max(opened_m) < 0.21, "opened in the air, the jaws let the crane spring up"


def test_a_heavy_load_is_lifted_more_slowly() -> None:
    risen_m = []
    for heavy_kg in (360.0, 10.0):
        heap, planner, _ = lifting(heavy_kg=heavy_kg)
        begun_m = heap.pin_m()
        heap.steps(planner, 120)
        assert planner.phase is Phase.LIFT
        risen_m.append(heap.pin_m() - begun_m)
    assert 0.2 < risen_m[0] < 0.8 * risen_m[1]
