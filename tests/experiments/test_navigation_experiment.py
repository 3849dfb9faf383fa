"""The navigation experiment: its measures on drives with known answers, and one drive on the buses."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.navigation.clothoid_path import drivable_path
from autonomy.navigation.joining_path import joining_path
from experiments.navigation import measure
from experiments.navigation.experiment import CORNERS, LAPS, QUICK_START, STARTS, plan
from experiments.navigation.measure import Drive
from experiments.navigation.metrics import GROUNDS, LAP, METRICS, gather
from experiments.navigation.trial import COLUMNS, perform
from machine.loading.profile_file import load_profile

CARRIER = load_profile("aoro_fc8").carrier
assert CARRIER is not None
POINTS = list(CORNERS) * LAPS
SPACING_M = 0.1


def row(**values: float) -> list[float | None]:
    """One row of an outcome; what is not said is 0."""
    return [values.get(name, 0.0) for name in COLUMNS]


def drive(rows: list[list[float | None]], rest_m: list[float]) -> dict[str, Any]:
    """A drive of these rows that arrived."""
    told = {"arrived": True, "reason": "", "stops": 0, "rejected": 0, "seconds": 1.0}
    return told | {"rows": rows, "begin": [-12.0, -10.0, 0.0], "rest_m": rest_m}


def ours(off_m: float = 0.0, seen_off_m: float = 0.0, points: list[tuple[float, float]] = POINTS) -> dict[str, Any]:
    """A drive exactly ``off_m`` to the left of its path, that believes to be on it."""
    path = joining_path((-12.0, -10.0), 0.0, points, CARRIER)
    rows = []
    for s in np.arange(0.0, path.length_m, SPACING_M):
        x, y, heading, _ = path.at(s)
        left = (-math.sin(heading), math.cos(heading))
        true, seen = ((x + o * left[0], y + o * left[1]) for o in (off_m, off_m + seen_off_m))
        at = {"t_s": s, "s_m": s, "goal": -1, "sigma_m": 0.02, "yaw_rad": heading, "seen_yaw_rad": heading}
        rows.append(row(x_m=true[0], y_m=true[1], seen_x_m=seen[0], seen_y_m=seen[1], **at))
    x, y, *_ = path.at(path.length_m + 0.03)
    return drive(rows, [x, y])


def faithful(off_m: float = 0.0, laps: int = LAPS, curve_deg_m: float = 10.0) -> dict[str, Any]:
    """A drive along straight legs and arcs; off the line by ``off_m`` until the last lap."""
    rows, yaw, bend = [], 0.0, 0.0
    points = list(CORNERS) * laps
    x, y = -12.0, -10.0
    for goal, (gx, gy) in enumerate(points):
        while True:
            bearing = math.atan2(gy - y, gx - x)
            error = math.remainder(bearing - yaw, math.tau)
            turn = math.radians(curve_deg_m) * SPACING_M
            bend = 0.6 if error > turn else 0.0
            yaw += max(-turn, min(turn, error))
            x, y = x + SPACING_M * math.cos(yaw), y + SPACING_M * math.sin(yaw)
            shift = off_m if goal < len(points) - LAP else 0.0
            place = {"x_m": x + shift, "y_m": y + shift, "seen_x_m": x + shift, "seen_y_m": y + shift}
            rows.append(row(yaw_rad=yaw, sigma_m=0.02, goal=goal, bend_rad=bend, **place))
            if math.dist((x, y), (gx, gy)) < (6.0 if goal + 1 < len(points) else 1.0):
                break
    return drive(rows, [x, y])


def test_the_plan_drives_every_start_on_every_ground_by_both_methods() -> None:
    options = SimpleNamespace(seed=3, quick=False)
    jobs = plan(options, "aoro_fc8", "sampled", 2, POINTS)
    assert len(jobs) == len({j.name for j in jobs}) == 2 * 2 * len(GROUNDS) * len(STARTS)
    assert len(STARTS) == 6 and len(POINTS) == 8
    x, y = np.ptp(np.array(CORNERS), axis=0)
    assert x <= 40.0 and y <= 30.0
    for job in jobs:
        twin = next(j for j in jobs if j.name.split("/")[1:] == job.name.split("/")[1:] and j is not job)
        assert twin.seed == job.seed and twin.options["pose"] == job.options["pose"]


def test_every_start_has_a_path() -> None:
    for x, y, degrees in (*STARTS, QUICK_START):
        path = joining_path((x, y), math.radians(degrees), POINTS, CARRIER)
        assert measure.corner_end_m(path, POINTS[0]) < 0.3 * path.length_m
        assert path.xy_m[-1] == pytest.approx(POINTS[-1], abs=1e-3)


def test_an_error_of_three_centimetres_is_measured_as_that() -> None:
    metrics = gather({"ours/flat/0/0": ours(0.03), "ours/mud/0/0": ours(-0.05, 0.02)}, POINTS, CARRIER)
    assert metrics["flat.lateral_p95_m"] == pytest.approx(0.03, abs=2e-3)
    assert metrics["mud.lateral_p95_m"] == pytest.approx(0.05, abs=2e-3)
    assert 0.03 < metrics["lateral_p95_m"] <= 0.052
    assert metrics["stop_max_m"] == pytest.approx(0.03, abs=2e-3)
    assert metrics["located_p95_m"] == pytest.approx(0.02, abs=1e-3)
    assert metrics["honesty"] == pytest.approx(0.5, abs=0.02)
    assert metrics["arrived"] == 1.0 and metrics["stops"] == 0.0
    assert "faithful.lateral_p95_m" not in metrics


def test_what_came_before_the_first_bend_does_not_count() -> None:
    outcome = ours(0.0)
    for r in outcome["rows"][:150]:
        r[COLUMNS.index("y_m")] -= 2.0
    assert gather({"ours/flat/0/0": outcome}, POINTS, CARRIER)["lateral_p95_m"] < 2e-3


def test_converging_starts_are_near_their_common_path_on_the_last_lap() -> None:
    outcomes = {f"faithful/flat/0/{k}": faithful(off) for k, off in enumerate((0.0, 0.5, -0.5))}
    metrics = gather(outcomes, POINTS, CARRIER)
    assert metrics["faithful.lateral_p95_m"] < 0.02
    assert 0.2 < metrics["faithful.coming_p95_m"] < 0.8
    assert metrics["heading_deg_per_m"] == pytest.approx(10.0, rel=0.1)
    assert metrics["full_bend_deg_per_m"] == pytest.approx(10.0, rel=0.1)
    slow = gather({"faithful/flat/0/0": faithful(curve_deg_m=7.0)}, POINTS, CARRIER)
    assert slow["heading_deg_per_m"] < 8.0


def test_a_drive_that_did_not_arrive_counts_without_a_path() -> None:
    broken = faithful(3.0) | {"arrived": False, "stops": 2}
    outcomes = {"faithful/flat/0/0": faithful(), "faithful/flat/0/1": faithful(), "faithful/flat/0/2": broken}
    metrics = gather(outcomes, POINTS, CARRIER)
    assert metrics["faithful.coming_p95_m"] < 0.02
    assert metrics["arrived"] == pytest.approx(2 / 3) and metrics["stops"] == 2.0
    limits = {f.name: f for f in METRICS}
    assert not limits["arrived"].holds(metrics["arrived"]) and not limits["stops"].holds(2.0)


def test_a_drive_that_never_started_is_handled() -> None:
    nothing = {"rows": [], "begin": [None] * 3, "rest_m": [0.0, 0.0], "arrived": False, "reason": "x", "stops": 1}
    metrics = gather({"ours/flat/0/0": nothing, "faithful/flat/0/0": nothing}, POINTS, CARRIER)
    assert metrics["arrived"] == 0.0 and "lateral_p95_m" not in metrics


def test_the_heading_error_is_the_paper_s() -> None:
    outcome = {"rows": [row(x_m=0.0, y_m=0.0, yaw_rad=0.5, goal=0)]}
    error = measure.heading_error(Drive(outcome), [(0.0, 4.0)])
    assert error == pytest.approx([math.pi / 2 - 0.5])


def test_distances_are_to_segments() -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    off = measure.distances(np.array([[5.0, 2.0], [12.0, 5.0], [-3.0, 4.0]]), line)
    assert off == pytest.approx([2.0, 2.0, 5.0])


def test_a_first_bend_ends_where_the_path_is_straight_again() -> None:
    path = drivable_path([(0.0, 0.0), (30.0, 0.0), (30.0, 30.0)], CARRIER)
    end = measure.corner_end_m(path, (30.0, 0.0))
    assert path.corners_m[0] < end < path.corners_m[0] + 10.0
    assert path.at(end + 0.1)[3] == 0.0 and path.at(end - 0.3)[3] != 0.0


@pytest.mark.long
@pytest.mark.parametrize("way", ["ours", "faithful"])
def test_the_machine_drives_round_a_corner_in_mud_over_the_bus(way: str) -> None:
    options = SimpleNamespace(seed=0, quick=True)
    job = next(j for j in plan(options, "aoro_fc8", "sampled", 1, POINTS[:2]) if j.options["way"] == way)
    outcome = perform(job)
    assert outcome["arrived"], outcome["reason"]
    metrics = gather({job.name: outcome}, POINTS[:2], CARRIER, LAP)
    if way == "ours":
        assert metrics["lateral_p95_m"] < 0.08 and metrics["stop_max_m"] < 0.05
    else:
        assert metrics["heading_deg_per_m"] > 9.0 and math.dist(outcome["rest_m"], POINTS[1]) < 1.5
    assert metrics["located_p95_m"] < 0.08
