"""Logs that nobody sees, under logs that lie on them."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from autonomy.grasp import sampling_planner
from autonomy.grasp.cylinders import Cylinders, as_cylinders, log_covariance
from autonomy.grasp.hidden_logs import MAX_COUNT, hidden_observations, with_hidden_logs
from autonomy.grasp.planner import GraspRequest
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.perception.log_list import LogObservation
from tests.autonomy.grasp_scenes import ARM, GROUND, Y, cross, log, measured, pair, small_pile

HOLLOW_M = sqrt(0.205**2 - 0.105**2)
"""Height of the underside of a log in the valley of two that lie on the ground."""


def hidden_under(logs: list[LogObservation]) -> list[LogObservation]:
    """The logs that must lie under these."""
    covariances = np.stack([log_covariance(log) for log in logs])
    world = as_cylinders(logs)
    world, sigma = with_hidden_logs(world, world, covariances, GROUND)
    assert len(sigma) == world.count
    return hidden_observations(world, len(logs))


@pytest.mark.parametrize("scene", [pair, small_pile, cross])
def test_where_everything_that_holds_is_seen_nothing_is_hidden(scene) -> None:
    assert not hidden_under(scene())


def test_a_log_in_the_valley_of_two_hidden_ones_shows_both() -> None:
    *lying, upper = small_pile()
    found = hidden_under([upper])
    assert sorted(o.center_m[1] - Y for o in found) == pytest.approx(sorted(o.center_m[1] - Y for o in lying), abs=0.01)
    for o in found:
        assert o.center_m[2] == pytest.approx(GROUND + 0.1, abs=5e-3) and o.diameter_m == pytest.approx(0.2)
        assert o.id < 0 and o.length_m == upper.length_m


def test_only_the_side_that_no_seen_log_holds_shows_one() -> None:
    left, right, upper = small_pile()
    (found,) = hidden_under([left, upper])
    assert found.center_m[1] == pytest.approx(right.center_m[1], abs=0.01)


def test_a_whole_row_above_the_ground_never_hides_more_than_the_most() -> None:
    row = [log(k, 0.205 * k - 1.0, HOLLOW_M) for k in range(10)]
    assert len(hidden_under(row)) <= MAX_COUNT


def test_a_log_that_was_only_pushed_up_by_a_thick_one_hides_nothing() -> None:
    """One of two logs side by side was measured 0.47 m thick: the other one had no room beside it on the ground."""
    lying, thick = log(0, 0.19), log(1, -0.1, diameter=0.47)
    raised = log(0, 0.19, 0.22)
    covariances = np.stack([log_covariance(o) for o in (lying, thick)])
    measured_world, settled = as_cylinders([lying, thick]), as_cylinders([raised, thick])
    assert with_hidden_logs(measured_world, settled, covariances, GROUND)[0].count == 2
    assert with_hidden_logs(settled, settled, covariances, GROUND)[0].count > 2


def test_a_hidden_log_is_never_the_one_to_grip(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hidden log that was higher than all in view ended the planner with a traceback."""

    def much_hidden(_: Cylinders, world: Cylinders, covariances: np.ndarray, __: float) -> tuple[Cylinders, np.ndarray]:
        tall = as_cylinders([log(-1, across_m, diameter=0.5) for across_m in (-0.5, 0.0, 0.5)])
        parts = zip(*((w.center, w.axis, w.length, w.radius) for w in (world, tall)), strict=True)
        extra = [log_covariance(log(-1)) for _ in range(tall.count)]
        return Cylinders(*map(np.concatenate, parts)), np.concatenate([covariances, extra])

    monkeypatch.setattr(sampling_planner, "with_hidden_logs", much_hidden)
    for visible in (pair(), [log(0, 0.25)], [log(0, 0.0, 0.1)]):
        candidate = SamplingPlanner()(GraspRequest(ARM, list(map(measured, visible)), 0.0))
        assert candidate.logs and max(candidate.logs) < len(visible)


def test_jaws_pass_over_what_must_lie_under_the_logs_that_they_take() -> None:
    """On the ground they would close on three logs that they do not know."""
    row = [measured(log(k, across_m, HOLLOW_M)) for k, across_m in enumerate((-0.105, 0.105))]
    candidate = SamplingPlanner()(GraspRequest(ARM, row, 0.0))
    assert candidate.logs == (0, 1) and candidate.penetrates
    assert candidate.support_z_m - GROUND == pytest.approx(HOLLOW_M, abs=0.04)
    assert "-1" not in candidate.reason


def test_a_log_that_must_come_along_from_below_is_said() -> None:
    candidate = SamplingPlanner()(GraspRequest(ARM, [measured(log(7, 0.0, HOLLOW_M))], 0.0))
    assert candidate.logs == (0,)
    assert "1 log (7) of 1 at once with 2 that must lie under them" in candidate.reason
