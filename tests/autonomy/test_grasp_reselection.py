"""A grasp among logs that a camera measured from aside is chosen again from above it, where these are seen better."""

from __future__ import annotations

from dataclasses import replace
from math import hypot

import pytest

from autonomy.crane_job.activity import DETECTION_TIMEOUT_NS, Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.motion.motion_planner import TimeOptimalPlanner
from autonomy.perception.log_list import TRIANGLE, LogObservation
from machine.geometry.kinematics import Unreachable
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import TICK_NS, StandIn
from tests.autonomy.grasp_scenes import PROFILE, pair

OFF_M = 0.09


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
        return tuple(measured(log, 0.0 if above else self.off_m) for log in self.logs)


def measured(log: LogObservation, off_m: float) -> LogObservation:
    x, y, z = log.center_m
    variances = [0.0] * TRIANGLE
    variances[0] = variances[7] = 1e-4
    return replace(log, center_m=(x, y + off_m, z), covariance=tuple(variances))


def made(chooser: PlannerSelection | None = None) -> tuple[Camera, Activity]:
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=chooser or PlannerSelection(SamplingPlanner()))
    return Camera(PROFILE, pair()), planner


def until(crane: StandIn, planner: Activity, phase: Phase) -> list[tuple[float, float]]:
    """Where the grasps were that the crane went to."""
    found: list[tuple[float, float]] = []
    for _ in range(1200):
        if planner.phase is phase or planner.idle:
            break
        crane.step(planner)
        if planner.grasp is not None:
            at = (planner.grasp.pose.slew_rad, planner.grasp.pose.rot_rad)
            if not found or found[-1] != at:
                found.append(at)
    assert planner.phase is phase, planner.failure
    return found


def test_from_above_the_grasp_is_selected_again_and_approached() -> None:
    crane, planner = made()
    assert len(until(crane, planner, Phase.CLOSE)) > 1
    middle = sum(log.center_m[1] for log in crane.logs) / 2
    assert crane.pin()[1] == pytest.approx(middle, abs=0.05), "and not off it by what was seen from aside"
    phases = [m.phase for m in crane.trace]
    assert phases.count("LOOK") and phases.index("DESCEND") > phases.index("ABOVE")


def test_unmeasured_logs_are_detected_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Camera, "seen", StandIn.seen)
    crane, planner = made()
    assert len(until(crane, planner, Phase.CLOSE)) == 1


def test_without_a_detection_from_above_the_crane_continues_after_a_moment() -> None:
    crane, planner = made()
    crane.covered = True
    until(crane, planner, Phase.ABOVE)
    while not planner.arrived:
        crane.step(planner)
    since_ns = crane.now_ns
    assert len(until(crane, planner, Phase.DESCEND)) == 1
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
    until(edge, planner, Phase.ABOVE)
    assert planner.grasp is not None and planner.grasp.log.id == 0
    until(edge, planner, Phase.DESCEND)
    assert 1 in [log.id for log in planner.grasp.logs]


@pytest.mark.parametrize(("direct", "selections"), [(False, 2), (True, 1)])
def test_above_a_single_log_it_is_selected_again_where_the_crane_rests_anyway(direct: bool, selections: int) -> None:
    asked = []

    def counting(request: GraspRequest) -> GraspCandidate:
        asked.append(len(request.logs))
        return SamplingPlanner()(request)

    crane = Camera(PROFILE, pair()[:1])
    crane.off_m = 0.0
    motions, selector = TimeOptimalPlanner(direct=direct), PlannerSelection(counting)
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=selector, motion_planner=motions)
    until(crane, planner, Phase.CLOSE)
    assert len(asked) == selections


def test_a_better_grasp_without_a_path_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    crane, planner = made()
    until(crane, planner, Phase.ABOVE)

    def refuse(*_: object, **__: object) -> None:
        raise Unreachable("no way is clear")

    monkeypatch.setattr("autonomy.crane_job.cycle.approach_motion", refuse)
    until(crane, planner, Phase.CLOSE)
    assert planner.failure is None


def test_a_reselection_that_finds_no_grasp_changes_none() -> None:
    sampling = SamplingPlanner()
    asked = []

    def once(request: GraspRequest) -> GraspCandidate:
        asked.append(1)
        if len(asked) > 1:
            raise NoGrasp("grasp.none-safe", "nothing is safe")
        return sampling(request)

    crane, planner = made(PlannerSelection(once))
    until(crane, planner, Phase.ABOVE)
    first = planner.grasp
    assert first is not None
    until(crane, planner, Phase.CLOSE)
    assert len(asked) > 1 and planner.grasp is not None and planner.grasp.reason == first.reason


@pytest.mark.parametrize("better", [True, False])
def test_without_a_grasp_further_detections_are_used_before_the_job_fails(better: bool) -> None:
    sampling = SamplingPlanner()
    asked: list[int] = []

    def at_last(request: GraspRequest) -> GraspCandidate:
        asked.append(crane.now_ns)
        if better and len(asked) > 3:
            return sampling(request)
        raise NoGrasp("grasp.none-safe", "nothing is safe")

    crane, planner = made(PlannerSelection(at_last))
    while planner.phase <= Phase.LOOK and not planner.failure:
        crane.step(planner)
    if better:
        assert planner.phase is Phase.ABOVE and len(asked) == 4
    else:
        assert planner.failure_code == "grasp.none-safe"
        assert asked[-1] - asked[0] == pytest.approx(DETECTION_TIMEOUT_NS, abs=3 * TICK_NS)


def test_with_exactly_known_logs_the_job_fails_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Camera, "seen", StandIn.seen)

    def refuse(request: GraspRequest) -> GraspCandidate:
        raise NoGrasp("grasp.none-safe", "nothing is safe")

    crane, planner = made(PlannerSelection(refuse))
    while not planner.failure:
        crane.step(planner)
    assert len([m for m in crane.trace if m.phase == "LOOK"]) <= 6
