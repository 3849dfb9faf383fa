"""The rates experiment without a clock: lines, what a processor carries, what is open; and one replay in real time."""

from __future__ import annotations

import math

import pytest

from experiments.timing import evaluation, rates
from experiments.timing.losses import Loss, Stall, Stop
from experiments.timing.rates import METRICS, CranePoint, RatePoint
from machine.status.reasons import Reason


def point(machine: str, rate_hz: int, cpu_share: float, **more: object) -> RatePoint:
    told = {"stops": (), "losses": (), "stalls": ()} | more
    return RatePoint(machine, rate_hz, cpu_share, 15.0 * rate_hz, 90.0, 120.0, 10 * rate_hz, 0, tick="compiled", **told)


def points(**more: object) -> list[RatePoint]:
    return [point(m, hz, 0.01 + hz * 1e-4, **more) for m in rates.MACHINES for hz in rates.RATES_HZ]


def crane(machine: str, cranes: int, missed: int = 0) -> CranePoint:
    return CranePoint(machine, cranes, 2000 * cranes, missed, 0, 20.0 * cranes * rates.functions_of(machine), 5000.0)


CRANES = [crane(m, n) for m in rates.MACHINES for n in (1, 2, 3)]


def test_every_function_of_a_machine_counts():
    assert rates.functions_of("palms_471") == 6 and rates.functions_of("aoro_fc8") == 14


def test_a_straight_line_has_no_residual_and_a_bent_one_has():
    assert rates.fit([1.0, 2.0, 4.0], [3.0, 5.0, 9.0]) == pytest.approx((2.0, 1.0, 0.0), abs=1e-9)
    assert rates.fit([1.0, 2.0, 3.0], [1.0, 4.0, 9.0])[2] > 0.05
    assert math.isnan(rates.fit([1.0], [1.0])[2])


def test_every_metric_of_the_page_is_measured_and_a_linear_run_meets_every_limit():
    metrics = rates.gather(points(), CRANES)
    assert {m.name for m in METRICS} <= set(metrics)
    found = evaluation.evaluate(METRICS, metrics, rates.undecided(metrics, points()))
    assert found == evaluation.Evaluation((), {})
    assert metrics["aoro_fc8_cranes_bound"] == math.floor(0.95 / 0.03)


def test_a_number_of_cranes_that_misses_deadlines_is_not_carried():
    metrics = rates.gather(points(), [*CRANES, crane("palms_471", 4, missed=9)])
    assert metrics["palms_471_cranes"] == 3.0


def test_a_cost_that_grows_faster_than_the_frames_misses_its_limit():
    bent = [point(m, hz, hz * hz * 1e-7) for m in rates.MACHINES for hz in rates.RATES_HZ]
    metrics = rates.gather(bent, CRANES)
    found = evaluation.evaluate(METRICS, metrics, rates.undecided(metrics, bent))
    assert "palms_471_frame_residual" in found.missed


@pytest.mark.parametrize(("stalls", "open_"), [((), False), ((Stall(0, 9_990_000_000, 60_000_000),), True)])
def test_a_loss_or_a_stop_counts_unless_a_witness_saw_the_host_stall(stalls, open_):
    lost = Loss(9_000_000_000, 10_000_000_000, "crane0", 3, 0)
    made = points(stops=[Stop(10_000_000_000, Reason.ESTOP_LOST, "")], losses=[lost], stalls=stalls)
    metrics = rates.gather(made, CRANES)
    found = evaluation.evaluate(METRICS, metrics, rates.undecided(metrics, made))
    assert ({"frames_lost", "stops"} <= found.inconclusive.keys()) is open_
    assert ({"frames_lost", "stops", "stops_unexplained"} <= {*found.missed}) is not open_
