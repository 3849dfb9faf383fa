"""Tongs that tell that they have missed open, and are sent anew after another look, before the crane goes up empty."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, nan, pi

import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.cycle import EXTRACTION_DEPTH_M
from autonomy.crane_job.grasp_verification import MAX_RESTARTS
from autonomy.crane_job.phase_motions import EXTRACTION_DISTANCE_M
from autonomy.crane_job.phases import Phase
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import StandIn
from tests.autonomy.grasp_scenes import GROUND, PROFILE, log, measured, pair

SHUT, HOLDING = 4, 5
PINCH_RAD = 0.92  # of 2.25


class Slipping(StandIn):
    """Tongs shut on nothing ``misses`` times and say so; then they hold the pair."""

    misses = 1
    measures = True

    def report(self) -> StateReport:
        shut = self.gripped and self._closings <= self.misses
        return replace(super().report(), grapple_state=SHUT if shut else HOLDING if self.gripped else 0)

    @property
    def _closings(self) -> int:
        phases = [m.phase for m in self.trace]
        return sum(now == "CLOSE" != was for was, now in zip(["", *phases], phases, strict=False))

    def seen(self) -> tuple[LogObservation, ...]:
        return tuple(measured(log) if self.measures else log for log in self.logs)


def thick_pair() -> list[LogObservation]:
    return [replace(log, diameter_m=0.21, center_m=(*log.center_m[:2], log.center_m[2] + 0.005)) for log in pair()]


def phases_until_lifted(crane: Slipping) -> list[Phase]:
    phases = crane.until(
        Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner())), Phase.LIFT
    )
    return phases[phases.index(Phase.CLOSE) :]


def test_jaws_that_close_on_nothing_open_detect_and_close_again() -> None:
    crane = Slipping(PROFILE, thick_pair())
    assert phases_until_lifted(crane) == [Phase.CLOSE, Phase.ABOVE, Phase.DESCEND, Phase.CLOSE, Phase.LIFT]
    risen = [m for m in crane.trace if m.phase == "ABOVE"][-1]
    closed = next(m for m in crane.trace if m.phase == "CLOSE")
    assert risen.pin[2] > closed.pin[2] + 0.2 and risen.tong_rad < 0.2, "from above, and open"


def test_after_a_few_attempts_the_crane_lifts_anyway() -> None:
    crane = Slipping(PROFILE, thick_pair())
    crane.misses = 99
    assert phases_until_lifted(crane).count(Phase.CLOSE) == 1 + MAX_RESTARTS


@pytest.mark.parametrize("known_how", ["told", "thin", "blind"])
def test_unmeasured_logs_and_what_closed_jaws_may_hold_are_lifted_as_they_are(known_how: str) -> None:
    thin = [replace(log, diameter_m=0.15) for log in pair()]
    crane = Slipping(PROFILE, thin if known_how == "thin" else thick_pair(), feedback=known_how != "blind")
    crane.measures = known_how != "told"
    if known_how == "blind":
        crane.misses = 0  # nobody tells
    assert phases_until_lifted(crane).count(Phase.CLOSE) == 1


class Weighed(Slipping):
    """With a load cell: jaws that closed on nothing weigh ``empty_kg`` as they rise."""

    empty_kg = 1.0

    @property
    def load_kg(self) -> float:
        """What it shows."""
        return self.empty_kg if self.gripped and self._closings <= self.misses else super().load_kg


@pytest.mark.parametrize(("empty_kg", "anew"), [(1.0, True), (12.0, False)])
def test_closed_jaws_that_weigh_nothing_as_they_rise_restart(empty_kg: float, anew: bool) -> None:
    crane = Weighed(PROFILE, [replace(log, diameter_m=0.15) for log in pair()], log_kg=40.0)
    crane.empty_kg = empty_kg
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner()))
    crane.until(planner, Phase.LIFT)
    low = crane.pin()[2]
    while planner.phase is Phase.LIFT and crane.pin()[2] < low + VERIFY_LIFT_M:
        crane.step(planner)
    assert planner.phase is (Phase.ABOVE if anew else Phase.LIFT)
    if anew:
        assert crane.until(planner, Phase.LIFT) == [Phase.ABOVE, Phase.DESCEND, Phase.CLOSE, Phase.LIFT]


class Hiding(Weighed):
    """Closed jaws hide the first log from the camera; another one is in view."""

    def seen(self) -> tuple[LogObservation, ...]:
        return super().seen()[self.gripped :]


@pytest.mark.parametrize(("weighs_kg", "follows"), [(12.0, Phase.LOWER), (4.0, Phase.LOOK), (nan, Phase.LOOK)])
def test_a_thin_log_hidden_in_closed_jaws_is_carried_on_where_it_weighs(weighs_kg: float, follows: Phase) -> None:
    """The controller reports a held load from 30 kg on; a log of 12 kg was sometimes released again."""
    thin = replace(pair()[0], diameter_m=0.12)
    x, y, z = thin.center_m
    aside = replace(thin, id=thin.id + 7, center_m=(x, y - 2.0, z))
    crane = Hiding(PROFILE, [thin, aside], log_kg=weighs_kg)
    crane.empty_kg = weighs_kg
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner()))
    crane.until(planner, Phase.LIFT)
    while planner.phase in (Phase.LIFT, Phase.CARRY):
        crane.step(planner)
    assert planner.phase is follows


class Pinching(Slipping):
    """Tongs pinch the upper half of a thick log in a row until it has been dragged ``free_m`` aside."""

    free_m = 0.3
    misses = 0

    def _grapple(self, command: GrappleCommand) -> None:
        closed_at = next((m.pin for m in self.trace if m.phase == "CLOSE"), self.pin())
        pinches = hypot(self.pin()[0] - closed_at[0], self.pin()[1] - closed_at[1]) < self.free_m
        if command is GrappleCommand.CLOSE and pinches and self.tong_rad >= PINCH_RAD:
            self.gripped = True
        else:
            self.gripped = self.gripped and not (command is GrappleCommand.CLOSE and self.tong_rad < 2.0)
            super()._grapple(command)


def extracting(request: GraspRequest) -> GraspCandidate:
    """Extracts the end log of a row towards +y."""
    logs = request.logs
    end = logs[-1]
    x, y, _ = end.center_m
    return GraspCandidate(x, y + 0.5, pi / 2, GROUND, (len(logs) - 1,), 0.9, "extracts", penetrates=True, extracts=True)


def test_a_log_that_is_pinched_in_its_row_is_dragged_out_and_gripped_there() -> None:
    crane = Pinching(PROFILE, [log(0, -0.3, diameter=0.3), log(1, 0.0, diameter=0.3)])
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(extracting))
    crane.until(planner, Phase.LIFT)
    pins = [m.pin for m in crane.trace if m.phase == "CLOSE"]
    assert pins[-1][1] - pins[0][1] == pytest.approx(EXTRACTION_DISTANCE_M, abs=0.03), "away from the others"
    assert abs(pins[-1][2] - pins[0][2] - EXTRACTION_DEPTH_M) < 0.15 and abs(pins[-1][0] - pins[0][0]) < 0.05
    for _ in range(60):
        crane.step(planner)
    assert crane.pin()[1] == pytest.approx(pins[-1][1], abs=0.03), "it goes up from there"


def test_extracting_jaws_go_in_beside_the_log_before_they_close() -> None:
    pair_of = [log(0, -0.3, diameter=0.3), log(1, 0.0, diameter=0.3)]
    over = {}
    for draws in (True, False):
        crane = Pinching(PROFILE, pair_of)
        planner = lambda request, d=draws: replace(extracting(request), extracts=d)  # noqa: E731
        crane.until(Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(planner)), Phase.CLOSE)
        tip = crane.pin()[2] - tip_below_pin_m(PROFILE.grapple.jaws, crane.tong_rad)
        over[draws] = tip - GROUND
    assert 0.02 < over[True] < 0.1, "under the middle of the log, and over the ground"
    assert over[False] > 0.15, "they sweep deeper as they close"


def test_a_log_still_pinched_after_the_drag_is_detected_again() -> None:
    crane = Pinching(PROFILE, [log(0, -0.3, diameter=0.3), log(1, 0.0, diameter=0.3)])
    crane.free_m = 9.0
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(extracting))
    phases = crane.until(planner, Phase.LIFT)
    assert phases.count(Phase.ABOVE) == 1 + MAX_RESTARTS


def test_without_a_better_grasp_after_a_drag_the_old_one_closes_before_it_drags_again() -> None:
    asked = []

    def once(request: GraspRequest) -> GraspCandidate:
        asked.append(1)
        if len(asked) > 3:
            raise NoGrasp("grasp.none-safe", "nothing is safe")
        return extracting(request)

    crane = Pinching(PROFILE, [log(0, -0.3, diameter=0.3), log(1, 0.0, diameter=0.3)])
    crane.free_m = 9.0
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(once))
    crane.until(planner, Phase.LIFT)
    assert len(asked) > 3
    phases = [m.phase for m in crane.trace]
    again = len(phases) - next(i for i, p in enumerate(reversed(phases)) if p == "DESCEND")
    closing = crane.trace[again : again + 15]
    assert {m.phase for m in closing} == {"CLOSE"} and closing[-1].tong_rad > closing[0].tong_rad
    assert max(abs(m.pin[1] - closing[0].pin[1]) for m in closing) < 0.02
