"""The forwarding-mission experiment: metrics of missions with known answers, its fields, and one log."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.mission_file import load_mission
from autonomy.missions.validation import problems_of
from experiments.common.mission_trial import ACROSS_M, ALONG_M, PAPER_B, PAPER_B_ANGLED, TURN_DEG, shuffled
from experiments.common.result import make_result
from experiments.forwarding_mission.experiment import (
    MACHINES,
    NOMINAL,
    calibrations,
    evaluated_again,
    missions,
    perform,
    short,
    trial,
)
from experiments.forwarding_mission.metrics import METRICS, by_log, gather

OPTIONS = SimpleNamespace(seed=3, quick=False, trials=None)
MISSION = load_mission(PAPER_B, route_wanted=True).mission


def grasp(log: int | None, off_m: tuple[float, float, float], logs: int = 1, state: str = "COLLECT") -> dict[str, Any]:
    """A grasp of 30 s that holds."""
    at = {"log": log, "logs": logs, "meant_m": 0.0, "off_m": list(off_m)}
    phases = [["LOOK", 0.0, 0.0], ["ABOVE", 1.0, 4.0], ["CLOSE", 10.0, 0.0]]
    return {"begin_s": 0.0, "state": state, "phases": phases, "attempts": [at], "failure": None, "end_s": 30.0}


def outcome(logs: int = 3, off_m: tuple[float, float, float] = (0.03, 0.04, 0.0), **changes: Any) -> dict[str, Any]:
    """A mission that takes every log, ``off_m`` beside it."""
    aboard = {"detected": True, "in_bunk": True, "lies_m": [[9.0, 9.0, 1.8]], "landed": False}
    lying = [aboard | {"place_m": [float(i), 3.0, 0.1], "size_m": [2.0, 0.25]} for i in range(logs)]
    ended = {"finished": True, "failure": "", "seconds": 900.0, "driven_m": 100.0, "stops": 0, "refused": 0}
    return (
        ended
        | {
            "loaded": logs,
            "given_up": {},
            "states": [],
            "logs": lying,
            "places": logs,
            "grasps": [grasp(i, off_m) for i in range(logs)],
            "path": [[0.0, 0.0, 0.0, 0], [1.0, 1.0, 0.0, 0]],
            "stands": [[0.0, 0.0, 0.0]],
        }
        | changes
    )


def test_an_offset_of_five_centimetres_is_measured_as_that() -> None:
    metrics = gather({"first/ours": outcome(), "mission/0": outcome(off_m=(-0.03, -0.04, 0.0))})
    assert metrics["grasp_offset_mean_m"] == pytest.approx(0.05)
    assert metrics["grasp_offset_across_m"] == pytest.approx(0.03)
    assert metrics["grasp_offset_along_m"] == pytest.approx(0.04)
    assert metrics["detected"] == metrics["loaded"] == metrics["finished"] == 1.0
    assert metrics["missions"] == 2.0 and metrics["faults"] == 0.0 and metrics["stops_mean"] == 1.0
    assert "faithful.loaded" not in metrics


def test_grasps_of_several_logs_and_grasps_from_the_bunk_are_no_offsets() -> None:
    off = (1.0, 0.0, 0.0)
    others = [grasp(0, off, logs=2), grasp(0, off, state="UNLOAD"), grasp(None, off)]
    metrics = gather({"first/ours": outcome() | {"grasps": [grasp(0, (0.01, 0.0, 0.0)), *others]}})
    assert metrics["grasp_offset_mean_m"] == pytest.approx(0.01)


def test_a_lost_log_a_stop_and_a_failed_mission_miss_their_limits() -> None:
    bad = outcome(finished=False, stops=2)
    bad["logs"][0] |= {"in_bunk": False, "detected": False}
    metrics = gather({"mission/0": bad, "machine/0": {"profile": None, "failure": "x"}})
    limits = {f.name: f for f in METRICS}
    wrong = {"detected": 2 / 3, "loaded": 2 / 3, "finished": 0.0, "faults": 2.0, "uncalibrated": 1.0}
    for name, value in wrong.items():
        assert metrics[name] == pytest.approx(value)
        assert not limits[name].holds(metrics[name]), name
    assert not limits["grasp_offset_mean_m"].holds(0.09)


def test_several_logs_loaded_from_one_place_are_one_stop() -> None:
    stands = [[0.0, 0.0, 1.0], [0.02, 0.0, 30.0], [5.0, 0.0, 60.0], [5.0, 0.01, 90.0], [0.0, 0.0, 120.0]]
    assert gather({"first/ours": outcome() | {"stands": stands}})["stops_mean"] == 3.0


def test_metrics_of_paper_b_have_their_own_prefix() -> None:
    metrics = gather({"first/ours": outcome(), "first/paper-b": outcome(off_m=(0.3, 0.4, 0.0))})
    assert metrics["faithful.grasp_offset_mean_m"] == pytest.approx(0.5)
    assert metrics["grasp_offset_mean_m"] == metrics["first.grasp_offset_mean_m"] == pytest.approx(0.05)


def test_the_last_grasp_of_a_log_is_in_the_table_and_none_is_a_dash() -> None:
    again = outcome()
    again["grasps"] = [*again["grasps"][:2], grasp(0, (0.0, 0.0, 0.02))]
    assert [row["off_m"] for row in by_log(again)] == [[0.0, 0.0, 0.02], [0.03, 0.04, 0.0], None]


def test_every_mission_has_a_field_of_its_own_and_the_individuals_take_turns() -> None:
    machines = calibrations(OPTIONS, "aoro_fc8", "sampled", MACHINES)
    texts = {job.name: {"profile": f"text {job.name}"} for job in machines}
    jobs = missions(OPTIONS, "aoro_fc8", "sampled", 20, texts)
    assert len(jobs) == len({job.options["field"] for job in jobs}) == 20
    assert {job.seed for job in jobs} == {job.seed for job in machines if job.name != NOMINAL}
    for job in jobs:
        machine = next(m for m in machines if m.seed == job.seed and m.name != NOMINAL)
        assert job.options["text"] == f"text {machine.name}"
    texts["machine/1"]["profile"] = None
    assert len(missions(OPTIONS, "aoro_fc8", "sampled", 20, texts)) == 16
    first = trial(OPTIONS, "aoro_fc8", texts)
    assert [job.options["way"] for job in first] == ["ours", *["paper-b"] * 10]
    assert len({job.options.get("field") for job in first}) == len({job.seed for job in first}) == 10
    assert {job.options["file"] for job in first} == {str(PAPER_B_ANGLED)}
    assert {job.options["file"] for job in jobs} == {str(PAPER_B)}
    assert {job.options["text"] for job in first} == {f"text {NOMINAL}"}
    assert not calibrations(OPTIONS, "aoro_fc8", "sampled", 0)


def test_a_shuffled_field_can_be_driven_and_differs_by_seed() -> None:
    plane = LocalPlane(MISSION.waypoints[0].latitude_deg, MISSION.waypoints[0].longitude_deg)
    seen = set()
    for seed in range(5):
        other = shuffled(MISSION, seed)
        assert shuffled(MISSION, seed) == other and not list(problems_of(other, True))
        for log, was in zip(other.logs, MISSION.logs, strict=True):
            x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
            x0, y0, _ = plane.local(was.position.latitude_deg, was.position.longitude_deg)
            assert abs(x - x0) <= ALONG_M + 0.01 and abs(y - y0) <= ACROSS_M + 0.01
            assert abs(math.remainder(log.bearing_deg - was.bearing_deg, 360.0)) <= TURN_DEG + 1e-9
        seen.add(other.logs[0].position)
    assert len(seen) == 5


def test_paper_b_s_logs_lie_as_its_grapple_hangs_when_the_crane_has_passed_them() -> None:
    """Along the line from the crane's base, which stops 4.6 m after a log."""
    first, second, *_ = MISSION.waypoints
    plane = LocalPlane(first.latitude_deg, first.longitude_deg)
    laid = load_mission(PAPER_B_ANGLED, route_wanted=True).mission
    assert not list(problems_of(laid, True)) and laid.waypoints == MISSION.waypoints
    assert [log.position for log in laid.logs] == [log.position for log in MISSION.logs]
    east, north, _ = plane.local(second.latitude_deg, second.longitude_deg)
    ahead = np.array([east, north]) / math.hypot(east, north)
    sides = set()
    for log in laid.logs:
        x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
        if abs(y) > 5.0:
            continue  # beside the other long side
        assert log.bearing_deg is not None
        base = ahead * (np.array([x, y]) @ ahead + 4.6)
        seen_at_deg = math.degrees(math.atan2(x - base[0], y - base[1]))
        assert abs(math.remainder(seen_at_deg - log.bearing_deg, 180.0)) < 5.0
        sides.add(y > 0.0)
    assert sides == {True, False}


def test_the_missions_by_paper_b_s_method_count_together() -> None:
    missed = outcome()
    missed["logs"][0]["in_bunk"] = False
    metrics = gather({"first/ours": outcome(), "first/paper-b": outcome(), "paper-b/0": missed})
    assert metrics["faithful.miscounted"] == 1.0 and metrics["miscounted"] == 0.0
    assert metrics["faithful.missions"] == 2.0 and metrics["first.missions"] == 1.0
    assert metrics["faithful.loaded"] == pytest.approx(5 / 6) and metrics["loaded"] == 1.0


def test_a_log_that_was_never_laid_does_not_count_and_one_on_the_load_is_aboard() -> None:
    """Log 1 lies where it was, so log 3 of the second lap waits for its place; log 2 lies over the stakes."""
    mission = outcome(logs=4) | {"places": 2}
    for i, lies_m in ((1, [1.0, 3.0, 0.1]), (2, [9.0, 9.0, 2.8]), (3, [3.0, 3.0, 0.1])):
        mission["logs"][i] |= {"in_bunk": False, "detected": i < 3, "lies_m": [lies_m]}
    metrics = gather({"first/ours": outcome(), "first/paper-b": mission})
    assert metrics["faithful.detected"] == 1.0 and metrics["faithful.never_laid"] == 1.0
    assert metrics["faithful.loaded"] == metrics["faithful.loaded_worst"] == pytest.approx(1 / 3)
    assert metrics["faithful.aboard"] == pytest.approx(2 / 3) and metrics["faithful.loaded_n"] == 3.0
    assert metrics["loaded_worst"] == 1.0


def test_published_missions_are_evaluated_by_the_criteria_of_today() -> None:
    saved = make_result("forwarding-mission", METRICS, {"loaded": 1.0}, profile="aoro_fc8", seed=1, trials=1, more={})
    lost = outcome()
    lost["logs"][0]["in_bunk"] = False
    again = evaluated_again(saved, {"mission/0": lost})
    assert again.metrics["loaded"] == pytest.approx(2 / 3) and "loaded" in again.missed
    assert again.commit == saved.commit and "faithful.loaded" in again.unmeasured


def test_a_short_mission_has_one_log_on_a_straight_path() -> None:
    mission = short(MISSION)
    assert len(mission.waypoints) == 2 and len(mission.logs) == mission.options.laps == 1


@pytest.mark.long
@pytest.mark.timeout(900)
def test_an_observed_mission_of_one_log() -> None:
    job = trial(SimpleNamespace(seed=1, quick=True), "aoro_fc8", {})[0]
    done = perform(job)
    assert done["finished"] and done["stops"] == 0, done["failure"]
    metrics = gather({job.name: done})
    assert metrics["detected"] == metrics["loaded"] == 1.0
    assert 0.0 < metrics["grasp_offset_mean_m"] < 0.15
    (one,) = done["grasps"]
    assert one["attempts"][-1]["log"] == 0 and one["failure"] is None
    assert done["path"][-1][1] > done["path"][0][1] + 10.0
