"""The productivity experiment: metrics of runs with known answers, and its tasks."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.missions.validation import problems_of
from experiments.productivity.experiment import AMOUNTS, KINDS, QUICK, plan, task
from experiments.productivity.metrics import cycles, gather
from machine.loading.profile_file import load_profile

PROFILE = load_profile("aoro_fc8")
TONGS_S = 5.0


def grasp(begin_s: float, seconds: float, logs: int = 1, state: str = "COLLECT", failure: str | None = None) -> Any:
    """A grasp whose ways take 8 s at least."""
    half = begin_s + seconds / 2
    phases = [["ABOVE", begin_s, 3.0], ["CLOSE", half, 1.0], ["CARRY", half + 1.0, 5.0]]
    return {
        "begin_s": begin_s,
        "end_s": begin_s + seconds,
        "state": state,
        "phases": phases,
        "failure": failure,
        "attempts": [{"log": 0, "logs": logs, "meant_m": 0.0, "off_m": [0.0, 0.0, 0.0]}],
    }


def run(grasps: list[Any], logs: int = 2, seconds: float = 100.0, landed: bool = False) -> dict[str, Any]:
    """A mission whose logs of a cubic metre each were all brought in, or to the landing."""
    log = {"size_m": [1.0, math.sqrt(4.0 / math.pi)], "in_bunk": not landed, "landed": landed, "detected": True}
    return {"seconds": seconds, "stops": 0, "logs": [log] * logs, "grasps": grasps, "failure": ""}


def test_logs_and_wood_an_hour() -> None:
    metrics = gather({"singles/0": run([grasp(0.0, 20.0), grasp(30.0, 30.0)])}, TONGS_S)
    assert metrics["logs_per_hour"] == pytest.approx(72.0) and metrics["m3_per_hour"] == pytest.approx(72.0)
    assert metrics["crane_logs_per_hour"] == pytest.approx(144.0)
    assert metrics["cycle_median_s"] == pytest.approx(25.0)
    assert metrics["shortest_median_s"] == pytest.approx(3.0 + 5.0 + TONGS_S)
    assert metrics["over_shortest"] == pytest.approx(25.0 / 13.0)


def test_only_successful_grasps_are_cycles() -> None:
    grasps = [grasp(0.0, 20.0), grasp(30.0, 99.0, failure="missed"), grasp(140.0, 90.0, logs=2)]
    grasps.append({"begin_s": 300.0, "state": "COLLECT", "phases": [], "attempts": []})  # cut off by the limit
    metrics = gather({"singles/0": run(grasps)}, TONGS_S)
    assert metrics["cycle_median_s"] == pytest.approx(20.0)
    assert metrics["crane_logs_per_hour"] == pytest.approx(3600.0 * 2 / 209.0)


def test_a_pile_counts_all_logs_of_a_grasp() -> None:
    metrics = gather({"piles/0": run([grasp(0.0, 30.0, logs=2), grasp(40.0, 40.0)], logs=3)}, TONGS_S)
    assert metrics["piles.cycle_median_s"] == pytest.approx(35.0)
    assert metrics["piles.logs_per_grasp"] == pytest.approx(1.5)


def test_unloading_counts_from_its_first_grasp_to_its_last() -> None:
    grasps = [grasp(100.0, 30.0, 2, "UNLOAD"), grasp(140.0, 20.0, 2, "UNLOAD")]
    metrics = gather({"landing/0": run(grasps, logs=4, seconds=500.0, landed=True)}, TONGS_S)
    assert metrics["unload_s"] == pytest.approx(60.0) and metrics["unload_logs_per_hour"] == pytest.approx(240.0)
    assert metrics["unload_logs_per_grasp"] == pytest.approx(2.0) and metrics["unloaded"] == 1.0
    assert metrics["unload_cycle_median_s"] == pytest.approx(25.0)
    assert gather({"landing/0": run([], landed=False)}, TONGS_S)["unloaded"] == 0.0


def test_phases_fill_a_cycle() -> None:
    (one,) = cycles(run([grasp(10.0, 20.0)]), TONGS_S)
    assert sum(seconds for _, seconds in one.phases) == pytest.approx(one.seconds) == pytest.approx(20.0)


def test_every_task_is_in_the_plan() -> None:
    jobs = plan(SimpleNamespace(seed=1, truth="nominal", quick=False), "aoro_fc8", 2)
    assert len(jobs) == len({job.name for job in jobs}) == 2 * len(AMOUNTS) and set(AMOUNTS) == set(KINDS)
    quick = plan(SimpleNamespace(seed=1, truth="nominal", quick=True), "aoro_fc8", 1)
    assert [job.kind for job in quick] == list(QUICK)


@pytest.mark.parametrize("kind", KINDS)
def test_a_task_can_be_driven_and_its_logs_do_not_touch_the_machine(kind: str) -> None:
    mission, site = task(kind, PROFILE, "nominal", 3, AMOUNTS[kind])
    assert not problems_of(mission) and task(kind, PROFILE, "nominal", 3, AMOUNTS[kind])[1] == site
    assert len(site.logs) == {"singles": 12, "piles": 20, "landing": 24}[kind]
    assert bool(mission.landings) == (kind == "landing")
    half = 0.5 * (PROFILE.carrier.track_width_m + PROFILE.carrier.wheel_width_m)
    for log in site.logs:
        if log.in_bunk:
            assert abs(log.y_m) + 0.5 * log.diameter_m < 0.5 * PROFILE.bunk.width_m
        else:
            ends = log.y_m + np.array([-0.5, 0.5]) * log.length_m * math.sin(log.yaw_rad)
            assert np.abs(ends).min() - 0.5 * log.diameter_m > half
