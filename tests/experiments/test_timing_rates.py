"""The rates experiment without a clock: lines, what a processor carries, what is open; and one replay in real time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from experiments.common.result import evaluate
from experiments.timing import rates
from experiments.timing.events import Events, Stall, loss, stop
from experiments.timing.rates import METRICS, CranePoint, RatePoint
from machine.status.reasons import Reason


def figures(rate_hz: int, cpu_share: float) -> dict[str, float]:
    load = {"cpu_share": cpu_share, "frames_per_s": 15.0 * rate_hz, "ticks": 10.0 * rate_hz, "missed": 0.0}
    return load | {"cpu_p50_us": 90.0, "cpu_p99_us": 120.0}


def points(cpu_share: Callable[[int], float], events: Events | None = None) -> list[RatePoint]:
    return [
        RatePoint(m, hz, figures(hz, cpu_share(hz)), events or Events(), "compiled")
        for m in rates.MACHINES
        for hz in rates.RATES_HZ
    ]


def straight(rate_hz: int) -> float:
    return 0.01 + rate_hz * 1e-4


def judged(made: list[RatePoint]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the missed and of the inconclusive metrics."""
    metrics = rates.gather(made, CRANES)
    return evaluate(METRICS, metrics, False, rates.undecided(metrics, made))


def crane(machine: str, cranes: int, missed: int = 0) -> CranePoint:
    return CranePoint(machine, cranes, 2000 * cranes, missed, 0, 20.0 * cranes * rates.functions_of(machine))


CRANES = [crane(m, n) for m in rates.MACHINES for n in (1, 2, 3)]


def test_every_function_of_a_machine_counts():
    assert rates.functions_of("palms_471") == 6 and rates.functions_of("aoro_fc8") == 14


def test_a_straight_line_has_no_residual_and_a_bent_one_has():
    assert rates.fit([1.0, 2.0, 4.0], [3.0, 5.0, 9.0]) == pytest.approx((2.0, 1.0, 0.0), abs=1e-9)
    assert rates.fit([1.0, 2.0, 3.0], [1.0, 4.0, 9.0])[2] > 0.05
    assert math.isnan(rates.fit([1.0], [1.0])[2])


def test_every_metric_of_the_page_is_measured_and_a_linear_run_meets_every_limit():
    metrics = rates.gather(points(straight), CRANES)
    assert {m.name for m in METRICS} <= set(metrics)
    assert judged(points(straight)) == ((), ())
    assert metrics["aoro_fc8_cranes_bound"] == math.floor(0.95 / 0.03)


def test_a_number_of_cranes_that_misses_deadlines_is_not_carried():
    metrics = rates.gather(points(straight), [*CRANES, crane("palms_471", 4, missed=9)])
    assert metrics["palms_471_cranes"] == 3.0


def test_a_cost_that_grows_faster_than_the_frames_misses_its_limit():
    assert "palms_471_frame_residual" in judged(points(lambda hz: hz * hz * 1e-7))[0]


@pytest.mark.parametrize(("stalls", "open_"), [((), False), ((Stall(0, 9_990_000_000, 60_000_000),), True)])
def test_a_loss_or_a_stop_counts_unless_a_witness_saw_the_host_stall(stalls, open_):
    lost = loss(9_000_000_000, 10_000_000_000, "crane0", 3, 0)
    told = Events([stop(10_000_000_000, Reason.ESTOP_LOST, "")], [lost], list(stalls))
    missed, inconclusive = judged(points(straight, told))
    assert ({"frames_lost", "stops"} <= {*inconclusive}) is open_
    assert ({"frames_lost", "stops", "stops_unexplained"} <= {*missed}) is not open_
