"""The Kalman filter of a joint: gains against independent solvers, and estimates from encoder samples."""

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from controller.estimation.joint_estimator import (
    JointEstimator,
    acceleration_density,
    measurement_variance,
    steady_gains,
)
from machine.loading.profile_file import load_profile
from machine.sensing import counts_from_position, position_from_counts
from tests.controller.bench import MS, SPECS, T

SLEW = SPECS[0]
PERIOD_S = T * 1e-9
H = np.array([[1.0, 0.0]])
SENSED = [s for name in ("palms_471", "aoro_fc8") for s in load_profile(name).joints.values() if s.encoder]


def model(period_s, density):
    """Transition and process noise of a white acceleration."""
    q = density * np.array([[period_s**3 / 3, period_s**2 / 2], [period_s**2 / 2, period_s]])
    return np.array([[1.0, period_s], [0.0, 1.0]]), q


def riccati_gains(period_s, density, variance):
    f, q = model(period_s, density)
    p = solve_discrete_are(f.T, H.T, q, np.array([[variance]]))
    return p @ H.T / (p[0, 0] + variance)


@pytest.mark.parametrize("spec", SENSED, ids=lambda s: s.encoder.message)
def test_gains_are_the_solution_of_the_riccati_equation(spec):
    wanted = riccati_gains(PERIOD_S, acceleration_density(spec), measurement_variance(spec.encoder))
    found = steady_gains(PERIOD_S, acceleration_density(spec), measurement_variance(spec.encoder))
    assert found == pytest.approx(wanted.ravel().tolist(), rel=1e-6)


@given(st.floats(1e-3, 0.02), st.floats(1e-6, 1.0), st.floats(1e-10, 1e-4))
def test_gains_are_stable_for_any_noise(period_s, density, variance):
    wanted = riccati_gains(period_s, density, variance).ravel().tolist()
    assert steady_gains(period_s, density, variance) == pytest.approx(wanted, rel=1e-4)


@given(st.sampled_from(SENSED), st.floats(-0.9, 0.9), st.floats(0.05, 2.0), st.sets(st.integers(1, 199), max_size=60))
@settings(max_examples=20, deadline=None)
def test_estimates_agree_with_filterpy_on_quantised_samples(spec, share, hz, lost):
    """Sines of any joint, rounded to its encoder's counts, some samples lost: two scalar recurrences, one filter."""
    density, variance = acceleration_density(spec), measurement_variance(spec.encoder)
    reference = KalmanFilter(2, 1)
    reference.F, reference.H = model(PERIOD_S, density)[0], H
    reference.K = riccati_gains(PERIOD_S, density, variance)
    ours, amplitude = JointEstimator(spec, PERIOD_S), share * spec.speed_limit / (2.0 * math.pi * hz)
    for k in range(200):
        true = 0.5 * (spec.lower + spec.upper) + amplitude * math.sin(2.0 * math.pi * hz * k * PERIOD_S)
        measured = position_from_counts(spec.encoder, counts_from_position(spec.encoder, true))
        assert abs(measured - true) <= 0.501 * spec.encoder.unit_per_count
        ours.predict(k * T)
        reference.predict_steadystate()
        if k == 0:
            ours.update(measured, 0)
            reference.x = np.array([[measured], [0.0]])
        elif k not in lost:
            ours.update(measured, k * T)
            reference.update_steadystate(np.array([[measured]]))
        assert [ours.position, ours.velocity] == pytest.approx(reference.x.ravel().tolist(), abs=1e-9)
    assert ours.refused == 0


def follow(estimator, positions, age_ns=0, start_ns=10**9):
    """``positions`` are those at the moment of each sample."""
    for k, position in enumerate(positions):
        now_ns = start_ns + k * T
        estimator.predict(now_ns)
        counts = counts_from_position(SLEW.encoder, position)
        estimator.update(position_from_counts(SLEW.encoder, counts), now_ns - age_ns)


@pytest.mark.parametrize("age_ns", [0, T // 2, T])
def test_ramp_is_tracked_without_lag_whatever_the_age_of_the_sample(age_ns):
    estimator = JointEstimator(SLEW, PERIOD_S)
    assert not estimator.known and math.isnan(estimator.position)
    follow(estimator, [0.1 * (k * T - age_ns) * 1e-9 for k in range(400)], age_ns)
    assert estimator.position == pytest.approx(0.1 * 399 * PERIOD_S, abs=3e-4)
    assert estimator.velocity == pytest.approx(0.1, abs=0.01)
    estimator.reset()
    assert not estimator.known and math.isnan(estimator.velocity)


def test_filter_is_independent_of_the_rate():
    slow, fast = JointEstimator(SLEW, 0.01), JointEstimator(SLEW, 0.005)
    for estimator, dt in ((slow, 10 * MS), (fast, 5 * MS)):
        for k in range(1, int(0.1e9 / dt) + 1):
            estimator.predict(k * dt)
            estimator.update(0.2 * k * dt * 1e-9, k * dt)
    assert slow.velocity == pytest.approx(fast.velocity, rel=0.15)


def test_missing_sample_is_extrapolated():
    estimator = JointEstimator(SLEW, PERIOD_S)
    follow(estimator, [0.2 * k * PERIOD_S for k in range(200)])
    before = estimator.position
    estimator.predict(10**9 + 200 * T)
    assert estimator.position == pytest.approx(before + 0.2 * PERIOD_S, abs=2e-4)
