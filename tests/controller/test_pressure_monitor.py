"""A burst hose is told by the pressures of both chambers, in time, and ordinary work is none."""

import math

import pytest

from can_dbc.messages.crane import OperatorAction
from controller.estimation.pressure_monitor import (
    GAP_NS,
    LOADED_BAR,
    LOST_NS,
    LOST_SHARE,
    RISE_BAR,
    CylinderMonitor,
)
from machine.joints import Joint
from machine.status.evidence import quantities
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, Bench, T, count_until

STEP_NS = 5 * MS


def burst_ns(pressures, step_ns=STEP_NS):
    """When a monitor that sees these pairs says that a hose has burst; None: never."""
    monitor = CylinderMonitor()
    for k, (a_bar, b_bar) in enumerate(pressures):
        if monitor.step(a_bar, b_bar, 1_000_000_000 + k * step_ns):
            return k * step_ns
    return None


def loaded(a_bar=40.0, b_bar=6.0, count=10):
    return [(a_bar, b_bar)] * count


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("step_ns", [5 * MS, 10 * MS])
def test_a_chamber_that_loses_its_pressure_has_burst(swapped, step_ns):
    course = loaded() + [(4.0, 1.5)] * 20
    course = [(b, a) if swapped else (a, b) for a, b in course]
    found = burst_ns(course, step_ns)
    assert found is not None and found - 10 * step_ns == LOST_NS


@pytest.mark.parametrize(
    "course",
    [
        loaded() + [(4.0, 6.0 + RISE_BAR + 0.1)] * 20,  # the load is dropped: it no longer holds up the other chamber
        loaded(LOADED_BAR - 0.1) + [(0.0, 0.0)] * 20,  # carries nothing
        loaded() + [(40.0 * LOST_SHARE + 0.1, 1.5)] * 20,  # half a load gone
        loaded() + [(4.0, 1.5)] * (LOST_NS // STEP_NS) + loaded(),  # a peak of noise, or a swing that comes back
        loaded() + [(40.0 - 1.2 * k, 1.5) for k in range(33)] + [(0.5, 1.5)] * 20,  # 240 bar/s: the fastest of log work
        [(4.0, 1.5)] * 30,  # never loaded
    ],
)
def test_ordinary_changes_are_none(course):
    assert burst_ns(course) is None


def test_pressures_far_apart_are_not_compared():
    assert burst_ns(loaded() + [(4.0, 1.5)] * 20, GAP_NS + 1) is None


def test_what_was_before_a_reset_does_not_count():
    monitor = CylinderMonitor()
    for k, pair in enumerate(loaded()):
        monitor.step(*pair, k * STEP_NS)
    monitor.reset()
    assert not any(monitor.step(4.0, 1.5, (10 + k) * STEP_NS) for k in range(20))


def holding_bench():
    bench = Bench().armed()
    bench.changed["PressA"] = {"LiftA": 45.0, "LiftB": 5.0, "TiltA": 18.0, "TiltB": 30.0}
    bench.changed["PressB"] = {"ExtA": 6.0, "ExtB": 33.0, "SlewA": 20.0, "SlewB": 25.0}
    assert bench.keep(20) is Mode.ACTIVE
    return bench


@pytest.mark.parametrize(
    ("message", "signals", "j"),
    [
        ("PressA", {"LiftA": 4.0, "LiftB": 1.5}, Joint.LIFT),
        ("PressA", {"TiltA": 10.0, "TiltB": 3.0}, Joint.TILT),
        ("PressB", {"ExtA": 3.0, "ExtB": 2.0}, Joint.EXT),
        ("PressB", {"SlewA": 12.0, "SlewB": 1.0}, Joint.SLEW),
    ],
)
def test_the_supply_is_cut_in_time_and_the_numbers_are_told(message, signals, j):
    bench = holding_bench()
    loaded_one = max(signals, key=bench.changed[message].__getitem__)
    before_bar = bench.changed[message][loaded_one]
    bench.changed[message] = {**bench.changed[message], **signals}
    k = count_until(lambda: bench.tick([bench.hold()]), lambda: bench.mode is not Mode.ACTIVE)
    assert bench.mode is Mode.FAULT and bench.reason == Reason.HOSE_BURST
    assert k * T <= FAULTS[Reason.HOSE_BURST].bound_ms * MS
    evidence = bench.controller.evidence
    told = quantities(Reason.HOSE_BURST, int(j), evidence.numbers)
    assert [q.value for q in told] == [pytest.approx(signals[loaded_one]), pytest.approx(before_bar)]
    assert bench.controller.supervisor.detail == j and math.isnan(evidence.numbers[1])


def test_a_pressure_that_is_not_known_is_no_burst():
    bench = holding_bench()
    bench.dropped.add("PressA")
    bench.run(3)
    bench.dropped.discard("PressA")
    bench.changed["PressA"] = {**bench.changed["PressA"], "LiftA": None}
    assert bench.keep(40) is Mode.ACTIVE


def test_pressures_that_fell_before_arming_do_not_count():
    bench = holding_bench()
    bench.press(OperatorAction.DISARM)
    bench.run(60)
    assert not bench.controller.supervisor.armed
    bench.changed["PressA"] = {"LiftA": 0.0, "LiftB": 0.0}
    bench.tick()
    bench.press(OperatorAction.ARM)
    assert bench.run(20) is Mode.ARMED
