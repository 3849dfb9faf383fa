"""Grasps that are chosen again: from above, where logs are seen better, and after jaws have told that they missed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import hypot, inf, nan, pi

import pytest

from autonomy.crane_job.activity import DETECTION_TIMEOUT_NS, Activity
from autonomy.crane_job.cycle import EXTRACTION_DEPTH_M, LOOK_ASIDE_RAD, SURE_PROBABILITY
from autonomy.crane_job.grasp_verification import MAX_RESTARTS
from autonomy.crane_job.phase_motions import EXTRACTION_DISTANCE_M
from autonomy.crane_job.phases import Phase
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.perception.log_list import TRIANGLE, LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.grapple import tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from machine.joints import Joint
from tests.autonomy.crane_stand_in import TICK_NS, StandIn, activity, refusing
from tests.autonomy.grasp_scenes import GROUND, PROFILE, log, measured, pair

OFF_M = 0.09
NOTHING_SAFE = NoGrasp("grasp.none-safe", "nothing is safe")


class Camera(StandIn):
    """A crane whose camera sees logs beside where they lie, but from above; ``covered``: there it sees nothing."""

    covered = False
    off_m = OFF_M

    def seen(self) -> tuple[LogObservation, ...]:
        """Measured logs."""
        x, y, _ = self.pin()
        above = hypot(x - self.logs[0].center_m[0], y - self.logs[0].center_m[1]) < 1.0
        if above and self.covered:
            return ()
        return tuple(seen_aside(log, 0.0 if above else self.off_m) for log in self.logs)


def seen_aside(log: LogObservation, off_m: float) -> LogObservation:
    x, y, z = log.center_m
    variances = [1e-4 if i in (0, 7) else 0.0 for i in range(TRIANGLE)]
    return replace(log, center_m=(x, y + off_m, z), covariance=tuple(variances))


def made(planner=None) -> tuple[Camera, Activity]:
    return Camera(PROFILE, pair()), activity(planner=planner or SamplingPlanner())


class Asked:
    """A planner that counts its requests, and finds nothing after so many."""

    def __init__(self, planner=None, finds: float = inf) -> None:
        self.planner, self.finds, self.count = planner or SamplingPlanner(), finds, 0

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        self.count += 1
        if self.count > self.finds:
            raise NOTHING_SAFE
        return self.planner(request)


def grasps_until(crane: StandIn, planner: Activity, phase: Phase) -> int:
    """How many grasps the crane went to, one after the other."""
    found: list[tuple[float, float]] = []
    while planner.phase is not phase and not planner.idle:
        crane.step(planner)
        if planner.grasp is not None:
            at = (planner.grasp.pose.slew_rad, planner.grasp.pose.rot_rad)
            if not found or found[-1] != at:
                found.append(at)
    assert planner.phase is phase, planner.failure
    return len(found)


def test_from_above_the_grasp_is_selected_again_and_approached() -> None:
    crane, planner = made()
    assert grasps_until(crane, planner, Phase.CLOSE) > 1
    middle = sum(log.center_m[1] for log in crane.logs) / 2
    assert crane.pin()[1] == pytest.approx(middle, abs=0.05), "and not off it by what was seen from aside"
    phases = [m.phase for m in crane.trace]
    assert phases.count("LOOK") and phases.index("DESCEND") > phases.index("ABOVE")


def test_unmeasured_logs_are_detected_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Camera, "seen", StandIn.seen)
    crane, planner = made()
    assert grasps_until(crane, planner, Phase.CLOSE) == 1


def test_without_a_detection_from_above_the_crane_continues_after_a_moment() -> None:
    crane, planner = made()
    crane.covered = True
    crane.until(planner, Phase.ABOVE)
    while not planner.arrived:
        crane.step(planner)
    since_ns = crane.now_ns
    assert grasps_until(crane, planner, Phase.DESCEND) == 1
    assert crane.now_ns - since_ns <= DETECTION_TIMEOUT_NS + 4 * TICK_NS


class Edge(Camera):
    """From aside the camera sees one end of a log, from above the same end and a whole log."""

    def seen(self) -> tuple[LogObservation, ...]:
        part, whole = Camera.seen(self)
        x, y, z = part.center_m
        part = replace(part, center_m=(x + 0.7, y, z), length_m=1.2)
        return (part, whole) if abs(self.pin()[1] - y) < 0.5 else (part,)


def test_a_log_that_stays_a_part_is_not_gripped_before_the_others_are_looked_at() -> None:
    _, planner = made()
    edge = Edge(PROFILE, pair())
    edge.until(planner, Phase.ABOVE)
    assert planner.grasp.log.id == 0
    edge.until(planner, Phase.DESCEND)
    assert 1 in [log.id for log in planner.grasp.logs]


@pytest.mark.parametrize(("direct", "selections"), [(False, 2), (True, 1)])
def test_above_a_single_log_it_is_selected_again_where_the_crane_rests_anyway(direct: bool, selections: int) -> None:
    crane, asked = Camera(PROFILE, pair()[:1]), Asked()
    crane.off_m = 0.0
    crane.until(activity(planner=asked, direct=direct), Phase.CLOSE)
    assert asked.count == selections


def test_a_better_grasp_without_a_path_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    crane, planner = made()
    crane.until(planner, Phase.ABOVE)

    monkeypatch.setattr("autonomy.crane_job.cycle.approach_motion", refusing(Unreachable("no way is clear")))
    crane.until(planner, Phase.CLOSE)
    assert planner.failure is None


def test_a_reselection_that_finds_no_grasp_changes_none() -> None:
    asked = Asked(finds=1)
    crane, planner = made(asked)
    crane.until(planner, Phase.ABOVE)
    first = planner.grasp
    crane.until(planner, Phase.CLOSE)
    assert asked.count > 1 and planner.grasp is not None and planner.grasp.reason == first.reason


@pytest.mark.parametrize("better", [True, False])
def test_without_a_grasp_further_detections_are_used_before_the_job_fails(better: bool) -> None:
    sampling = SamplingPlanner()
    asked: list[int] = []

    def at_last(request: GraspRequest) -> GraspCandidate:
        asked.append(crane.now_ns)
        if better and len(asked) > 3:
            return sampling(request)
        raise NOTHING_SAFE

    crane, planner = made(at_last)
    while planner.phase <= Phase.LOOK and not planner.failure:
        crane.step(planner)
    if better:
        assert planner.phase is Phase.ABOVE and len(asked) == 4
    else:
        assert planner.failure_code == "grasp.none-safe"
        pauses = [later - before for before, later in pairwise(asked) if later - before > 1e9]
        assert len(pauses) == 2, "it turned to either side"
        from_here = [now_ns for now_ns in asked if now_ns < asked[0] + pauses[0]]
        assert from_here[-1] - from_here[0] == pytest.approx(DETECTION_TIMEOUT_NS, abs=3 * TICK_NS)


def unsure(request: GraspRequest) -> GraspCandidate:
    return replace(SamplingPlanner()(request), probability=SURE_PROBABILITY - 0.1)


@pytest.mark.parametrize("sure", [True, False])
def test_an_unsure_grasp_is_chosen_after_a_look_from_both_sides(sure: bool) -> None:
    crane, planner = made(SamplingPlanner() if sure else unsure)
    crane.until(planner, Phase.ABOVE)
    slews = [moment.q[Joint.SLEW] for moment in crane.trace]
    turned_rad = max(slews) - min(slews)
    assert turned_rad == pytest.approx(0.0 if sure else 2.0 * LOOK_ASIDE_RAD, abs=0.02)


@pytest.mark.parametrize(("direct", "turns"), [(False, True), (True, False)])
def test_a_hidden_end_is_looked_at_from_the_side_where_the_crane_takes_its_time(direct: bool, turns: bool) -> None:
    crane, planner = Camera(PROFILE, pair()), activity(planner=SamplingPlanner(), direct=direct)
    hidden_end = tuple(0.35 if i == 22 else 1e-4 if i in (0, 7, 13, 18) else 0.0 for i in range(TRIANGLE))
    crane.seen = lambda: tuple(replace(log, covariance=hidden_end) for log in crane.logs)
    crane.until(planner, Phase.ABOVE)
    slews = [moment.q[Joint.SLEW] for moment in crane.trace]
    assert (max(slews) - min(slews) > LOOK_ASIDE_RAD) is turns


def test_what_looks_like_a_log_between_open_jaws_is_none() -> None:
    """It would be in the crane's way, and the topmost log."""
    crane, planner = made()

    def seen_with_ghost() -> tuple[LogObservation, ...]:
        if planner.phase > Phase.LOOK:
            return Camera.seen(crane)
        x, y, z = crane.pin()
        ghost = LogObservation(9, (x + 0.1, y, z - 0.3), (1.0, 0.0, 0.0), 0.7, 0.1, (1e-4,) * TRIANGLE)
        return (*Camera.seen(crane), ghost)

    crane.seen = seen_with_ghost
    crane.until(planner, Phase.ABOVE)
    assert planner.grasp is not None and 9 not in [log.id for log in planner.grasp.logs]


def test_with_exactly_known_logs_the_job_fails_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Camera, "seen", StandIn.seen)
    crane, planner = made(refusing(NOTHING_SAFE))
    while not planner.failure:
        crane.step(planner)
    assert len([m for m in crane.trace if m.phase == "LOOK"]) <= 6


# -- jaws that tell that they have missed
SHUT, HOLDING = 4, 5
PINCH_RAD = 0.92  # of 2.25


class Slipping(StandIn):
    """Tongs shut on nothing ``misses`` times and say so; then they hold the pair."""

    misses = 1

    def report(self) -> StateReport:
        shut = self.gripped and self._closings <= self.misses
        return replace(super().report(), grapple_state=SHUT if shut else HOLDING if self.gripped else 0)

    @property
    def _closings(self) -> int:
        phases = [m.phase for m in self.trace]
        return sum(now == "CLOSE" != was for was, now in zip(["", *phases], phases, strict=False))

    def seen(self) -> tuple[LogObservation, ...]:
        return tuple(map(measured, self.logs))


def test_jaws_that_close_on_nothing_open_detect_and_close_again() -> None:
    crane = Slipping(PROFILE, [log(0, -0.105, diameter=0.21), log(1, 0.105, diameter=0.21)])
    phases = crane.until(activity(planner=SamplingPlanner()), Phase.LIFT)
    assert phases[phases.index(Phase.CLOSE) :] == [Phase.CLOSE, Phase.ABOVE, Phase.DESCEND, Phase.CLOSE, Phase.LIFT]
    risen = [m for m in crane.trace if m.phase == "ABOVE"][-1]
    closed = next(m for m in crane.trace if m.phase == "CLOSE")
    assert risen.pin[2] > closed.pin[2] + 0.2 and risen.tong_rad < 0.2, "from above, and open"


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
    planner = activity(planner=SamplingPlanner())
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
    planner = activity(planner=SamplingPlanner())
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


def row_of_two() -> list[LogObservation]:
    return [log(0, -0.3, diameter=0.3), log(1, 0.0, diameter=0.3)]


def extracting(request: GraspRequest) -> GraspCandidate:
    """Extracts the end log of a row towards +y."""
    logs = request.logs
    end = logs[-1]
    x, y, _ = end.center_m
    return GraspCandidate(x, y + 0.5, pi / 2, GROUND, (len(logs) - 1,), 0.9, "extracts", penetrates=True, extracts=True)


def test_a_log_that_is_pinched_in_its_row_is_dragged_out_and_gripped_there() -> None:
    crane = Pinching(PROFILE, row_of_two())
    planner = activity(planner=extracting)
    crane.until(planner, Phase.LIFT)
    pins = [m.pin for m in crane.trace if m.phase == "CLOSE"]
    assert pins[-1][1] - pins[0][1] == pytest.approx(EXTRACTION_DISTANCE_M, abs=0.03), "away from the others"
    assert abs(pins[-1][2] - pins[0][2] - EXTRACTION_DEPTH_M) < 0.15 and abs(pins[-1][0] - pins[0][0]) < 0.05
    crane.steps(planner, 60)
    assert crane.pin()[1] == pytest.approx(pins[-1][1], abs=0.03), "it goes up from there"


def test_extracting_jaws_go_in_beside_the_log_before_they_close() -> None:
    over = {}
    for draws in (True, False):
        crane = Pinching(PROFILE, row_of_two())
        crane.until(activity(planner=lambda request, d=draws: replace(extracting(request), extracts=d)), Phase.CLOSE)
        tip = crane.pin()[2] - tip_below_pin_m(PROFILE.grapple.jaws, crane.tong_rad)
        over[draws] = tip - GROUND
    assert 0.02 < over[True] < 0.1, "under the middle of the log, and over the ground"
    assert over[False] > 0.15, "they sweep deeper as they close"


def test_a_log_still_pinched_after_the_drag_is_detected_again() -> None:
    crane = Pinching(PROFILE, row_of_two())
    crane.free_m = 9.0
    phases = crane.until(activity(planner=extracting), Phase.LIFT)
    assert phases.count(Phase.ABOVE) == 1 + MAX_RESTARTS


def test_without_a_better_grasp_after_a_drag_the_old_one_closes_before_it_drags_again() -> None:
    crane, asked = Pinching(PROFILE, row_of_two()), Asked(extracting, finds=3)
    crane.free_m = 9.0
    crane.until(activity(planner=asked), Phase.LIFT)
    assert asked.count > 3
    phases = [m.phase for m in crane.trace]
    again = len(phases) - next(i for i, p in enumerate(reversed(phases)) if p == "DESCEND")
    closing = crane.trace[again : again + 15]
    assert {m.phase for m in closing} == {"CLOSE"} and closing[-1].tong_rad > closing[0].tong_rad
    assert max(abs(m.pin[1] - closing[0].pin[1]) for m in closing) < 0.02
