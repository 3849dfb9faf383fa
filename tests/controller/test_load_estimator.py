"""The load in the grapple: by the load cell, else by the pressures of a lift at rest or steady speed."""

import dataclasses
import math

import msgspec
import pytest

from controller.estimation.load_estimator import LoadEstimator
from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.profile import Sag
from machine.sensing.weighing import empty_moment_nm, lever_share
from tests.controller.bench import HOME, SETTINGS, Bench

PROFILE = msgspec.structs.replace(SETTINGS.profile, sag=Sag(0.002, 0.0015, 0.01, 1e-6, 5200.0, 2900.0))
PERIOD_S = 0.02
BACK_BAR = 4.0


def pressures(kg: float, q=HOME) -> tuple[float, float]:
    """Both sides of the lift cylinder under the empty crane and a load."""
    lift, kin = PROFILE.joints["lift"].valve, PROFILE.kinematics
    moment_nm = empty_moment_nm(PROFILE.sag, kin, q) + kg * GRAVITY_M_S2 * (distances(kin, q)[1] - kin.a1_m)
    load_bar = moment_nm / (1e5 * lift.flow_plus * lever_share(lift, q[1]))
    return load_bar + BACK_BAR * lift.flow_minus / lift.flow_plus, BACK_BAR


def run(estimate: LoadEstimator, kg: float, seconds: float, velocity=lambda time_s: 0.0) -> float:
    for i in range(round(seconds / PERIOD_S)):
        found = estimate.step(HOME, velocity(i * PERIOD_S), *pressures(kg), PERIOD_S)
    return found


def test_load_at_rest_is_the_moment_beyond_the_empty_crane():
    estimate = LoadEstimator(PROFILE)
    assert run(estimate, 0.0, PERIOD_S) == pytest.approx(0.0, abs=1e-6)
    after = run(estimate, 200.0, 0.8)
    assert 100.0 < after < 150.0, "filtered"
    assert run(estimate, 200.0, 6.0) == pytest.approx(200.0, abs=1.0)


def test_pressures_count_only_at_steady_speed():
    estimate = LoadEstimator(PROFILE)
    run(estimate, 100.0, 1.0)
    assert run(estimate, 300.0, 0.4, lambda t: 0.4 * t) == pytest.approx(100.0, abs=15.0), "kept"
    assert run(estimate, 300.0, 8.0, lambda t: 0.16) == pytest.approx(300.0, abs=1.0)


def test_load_is_never_negative():
    assert run(LoadEstimator(PROFILE), -40.0, 1.0) == 0.0


@pytest.mark.parametrize("gone", ["pressure", "position", "sag"])
def test_unknown_input_gives_nan_and_restarts_the_filter(gone):
    profile = msgspec.structs.replace(PROFILE, sag=None) if gone == "sag" else PROFILE
    estimate = LoadEstimator(profile)
    run(estimate, 250.0, 2.0)
    a, b = pressures(0.0)
    q = (HOME[0], math.nan, *HOME[2:]) if gone == "position" else HOME
    assert math.isnan(estimate.step(q, 0.0, None if gone == "pressure" else a, b, PERIOD_S))
    again = estimate.step(HOME, 0.0, a, b, PERIOD_S)
    assert math.isnan(again) if gone == "sag" else again == pytest.approx(0.0, abs=1e-6)


def test_rotator_position_is_not_needed():
    a, b = pressures(150.0)
    assert LoadEstimator(PROFILE).step((*HOME[:4], math.nan), 0.0, a, b, PERIOD_S) == pytest.approx(150.0)


def report(profile, **grapple) -> float:
    bench = Bench(dataclasses.replace(SETTINGS, profile=profile))
    a, b = pressures(180.0)
    bench.changed["PressA"] = {"LiftA": a, "LiftB": b}
    bench.changed["GrappleStat"] = grapple
    bench.boot().run(120)
    return bench.reports[-1].load_kg


def test_load_cell_has_priority_over_pressures():
    assert report(PROFILE, Load=77.0) == 77.0
    assert report(PROFILE, Load=None) == pytest.approx(180.0, abs=3.0)
    assert math.isnan(report(SETTINGS.profile, Load=None))
