"""A pile too wide for the jaws: these stall at its sides, open again and close higher up, around what lies on top."""

from __future__ import annotations

from itertools import pairwise

import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.grasp_verification import MAX_REGRIPS_HIGHER
from autonomy.crane_job.phases import Phase
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import StandIn
from tests.autonomy.grasp_scenes import GROUND, PROFILE, measured, small_pile

STALL_RAD = 0.5  # of 2.25: opened by four fifths


class Heap(StandIn):
    """Tongs that come down deeper than ``shoulder_m`` meet logs on both sides."""

    shoulder_m = GROUND + 0.12
    measures = True
    gives_rad = 0.0  # in a tick

    def seen(self) -> tuple[LogObservation, ...]:
        return tuple(measured(log) if self.measures else log for log in self.logs)

    def _grapple(self, command: GrappleCommand) -> None:
        tip_m = self.pin()[2] - tip_below_pin_m(self.profile.grapple.jaws, self.tong_rad)
        if command is GrappleCommand.CLOSE and self.tong_rad >= STALL_RAD and tip_m < self.shoulder_m:
            self.gripped = True
            self.tong_rad += self.gives_rad
        else:
            super()._grapple(command)


def driven(heap: Heap) -> tuple[list[Phase], Activity]:
    """The phases from the first descent to the lift."""
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner()))
    phases = heap.until(planner, Phase.LIFT)
    return phases[phases.index(Phase.DESCEND) :], planner


def test_jaws_that_stall_at_the_sides_of_a_pile_close_higher_up() -> None:
    heap = Heap(PROFILE, small_pile())
    phases, _ = driven(heap)
    closes = [i for i, p in enumerate(phases) if p is Phase.CLOSE]
    assert 2 <= len(closes) <= 1 + MAX_REGRIPS_HIGHER
    assert all(phases[i + 1] is Phase.DESCEND for i in closes[:-1])
    assert heap.tong_rad > STALL_RAD + 0.5, "in the end they close"
    lows = [m.pin[2] for was, m in pairwise(heap.trace) if m.phase == "CLOSE" != was.phase]
    assert all(after - before == pytest.approx(0.1, abs=0.02) for before, after in pairwise(lows))


def test_a_pile_that_yields_slowly_is_not_released() -> None:
    heap = Heap(PROFILE, small_pile())
    heap.gives_rad = 0.002
    assert driven(heap)[0].count(Phase.CLOSE) == 1
    assert heap.tong_rad > STALL_RAD + 0.1


def test_a_pile_that_never_yields_is_lifted_after_all() -> None:
    heap = Heap(PROFILE, small_pile())
    heap.shoulder_m = 9.0
    assert driven(heap)[0].count(Phase.CLOSE) == 1 + MAX_REGRIPS_HIGHER


def test_unmeasured_logs_and_jaws_without_a_sensor_are_lifted_as_they_are() -> None:
    known, blind = Heap(PROFILE, small_pile()), Heap(PROFILE, small_pile(), feedback=False)
    known.measures = False
    for heap in (known, blind):
        assert driven(heap)[0].count(Phase.CLOSE) == 1
