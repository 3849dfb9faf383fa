"""Estimator, laws, valve map and the closed loop on a small plant."""

import math

import pytest
from bench import MS, SPECS, Bench, T
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.setpoint import GrappleCommand
from controller.estimator import JointEstimator
from controller.laws.grapple import GrappleLaw, GrappleState
from controller.laws.pd import HEADROOM, PdLaw
from controller.valve import ValveMap
from machine.encoder import counts_from_position, position_from_counts
from machine.modes import Mode

SLEW = SPECS[0]
SPEED = st.floats(-0.5, 0.5)


@given(SPEED)
def test_valve_map_is_the_inverse_of_the_rescaled_deadband(velocity):
    u = ValveMap(SLEW.valve).spool_pct(velocity) / 100.0
    deadband = SLEW.valve.deadband_plus_pct / 100.0
    opening = math.copysign(max(0.0, abs(u) - deadband) / (1.0 - deadband), u)
    if abs(velocity) > 0.01 * 0.5:
        assert opening * 0.5 == pytest.approx(velocity, abs=1e-9)
    else:
        assert abs(u) <= deadband + 0.01


def test_valve_map_is_odd_monotonic_and_saturates():
    lift = SPECS[1].valve  # different speeds on the two sides
    made = ValveMap(lift)
    values = [made.spool_pct(v / 1000) for v in range(-400, 401)]
    assert values == sorted(values) and values[0] == -100.0 and values[-1] == 100.0
    assert made.spool_pct(0.0) == 0.0
    assert made.spool_pct(0.12) > -made.spool_pct(-0.12)
    assert made.limit(9.0) == lift.full_speed_plus and made.limit(-9.0) == -lift.full_speed_minus


def follow(estimator, positions):
    for k, position in enumerate(positions):
        now_ns = 10**9 + k * T
        estimator.predict(now_ns)
        estimator.sample(position_from_counts(SLEW.encoder, counts_from_position(SLEW.encoder, position)), now_ns)


def test_estimator_tracks_a_ramp_without_lag_and_without_quantisation_noise():
    estimator = JointEstimator(SLEW, T * 1e-9)
    assert not estimator.known and math.isnan(estimator.position)
    follow(estimator, [0.1 * k * T * 1e-9 for k in range(400)])
    assert estimator.position == pytest.approx(0.1 * 399 * T * 1e-9, abs=3e-4)
    assert estimator.velocity == pytest.approx(0.1, abs=0.01)
    follow(estimator, [0.1995] * 1)
    estimator.reset()
    assert not estimator.known and math.isnan(estimator.velocity)


def test_estimator_gains_do_not_depend_on_the_rate():
    slow, fast = JointEstimator(SLEW, 0.01), JointEstimator(SLEW, 0.005)
    for estimator, dt in ((slow, 10 * MS), (fast, 5 * MS)):
        for k in range(1, int(0.1e9 / dt) + 1):
            estimator.predict(k * dt)
            estimator.sample(0.2 * k * dt * 1e-9, k * dt)
    assert slow.velocity == pytest.approx(fast.velocity, rel=0.15)


def test_estimator_coasts_over_a_missing_sample():
    estimator = JointEstimator(SLEW, T * 1e-9)
    follow(estimator, [0.2 * k * T * 1e-9 for k in range(200)])
    before = estimator.position
    estimator.predict(10**9 + 200 * T)
    assert estimator.position == pytest.approx(before + 0.2 * T * 1e-9, abs=2e-4)


def law(j=0):
    return PdLaw(SPECS[j], ValveMap(SPECS[j].valve))


def test_law_rests_in_the_stop_band_with_hysteresis():
    made = law()
    band = SLEW.law.stop_band
    assert made.step(0.9 * band, 0.0, 0.0, 0.0, 0.0, 1.0, 0.005) == 0.0
    assert made.step(1.1 * band, 0.0, 0.0, 0.0, 0.0, 1.0, 0.005) > 0.0
    made.step(0.7 * band, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
    assert made.velocity_command > 0.0, "leaves the band only at half of it"
    made.step(0.4 * band, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
    assert made.velocity_command == 0.0


def test_law_feeds_the_leading_velocity_forward_and_limits_the_change_per_second():
    made = law()
    assert made.step(0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.005) == pytest.approx(4 * 0.4 * 0.005)
    for _ in range(200):
        command = made.step(0.0, 0.2, 0.2, 0.0, 0.2, 1.0, 0.005)
    assert command == pytest.approx(0.2)


@given(st.floats(-4, 4), st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(-2, 2))
def test_law_never_exceeds_its_cap_and_never_drives_out_of_the_range(q_ref, v_ref, lead, q, v):
    for cap in (1.0, 0.5):
        made = law()
        command = made.step(q_ref, v_ref, lead, q, v, cap, 10.0)
        assert abs(command) <= min(HEADROOM * SLEW.speed_limit * cap, 0.5) + 1e-12
        assert not (q > SLEW.upper and command > 0.0)
        assert not (q < SLEW.lower and command < 0.0)


def run_grapple(made, wanted, seconds, clamp=math.nan, opening=math.nan, start_ns=0):
    for k in range(int(seconds * 200)):
        made.step(wanted, clamp, opening, start_ns + k * T)
    return start_ns + int(seconds * 200) * T


def test_grapple_opens_and_closes_by_time_without_sensors():
    made = GrappleLaw(Bench().settings.profile.grapple)
    now = run_grapple(made, GrappleCommand.OPEN, 3.4)
    assert (made.state, made.spool_pct, made.mode) == (GrappleState.OPENING, 100.0, GrappleCommand.OPEN)
    now = run_grapple(made, GrappleCommand.OPEN, 0.2, start_ns=now)
    assert (made.state, made.spool_pct) == (GrappleState.OPEN, 0.0)
    now = run_grapple(made, GrappleCommand.CLOSE, 3.4, start_ns=now)
    assert (made.spool_pct, made.mode) == (-100.0, GrappleCommand.CLOSE)
    now = run_grapple(made, GrappleCommand.CLOSE, 0.2, start_ns=now)
    assert (made.state, made.spool_pct, made.mode) == (GrappleState.HOLDING, 0.0, GrappleCommand.HOLD)


def test_grapple_uses_pressure_and_opening_and_never_opens_by_itself():
    made = GrappleLaw(Bench().settings.profile.grapple)
    made.step(GrappleCommand.CLOSE, 20.0, 60.0, 0)
    made.step(GrappleCommand.CLOSE, 151.0, 30.0, T)
    assert made.state is GrappleState.HOLDING
    for wanted in (GrappleCommand.NEUTRAL, GrappleCommand.HOLD, GrappleCommand.CLOSE):
        made.step(wanted, 0.0, 0.0, 2 * T)
        made.release()
        assert made.mode is GrappleCommand.HOLD
    made.step(GrappleCommand.OPEN, 0.0, 50.0, 3 * T)
    made.step(GrappleCommand.OPEN, 0.0, 98.5, 4 * T)
    assert made.state is GrappleState.OPEN
    run_grapple(made, GrappleCommand.CLOSE, 5.0, clamp=10.0, opening=40.0)
    assert made.state is GrappleState.CLOSING, "without pressure it goes on for a while"
    run_grapple(made, GrappleCommand.CLOSE, 0.5, clamp=10.0, opening=40.0, start_ns=5 * 10**9)
    assert made.state is GrappleState.HOLDING


def test_grapple_holds_through_a_stop_and_a_fault():
    bench = Bench().armed()
    for k in range(1100):
        bench.tick([bench.hold(grapple=GrappleCommand.CLOSE)] if k % 10 == 0 else ())
        if k == 300:
            assert bench.commands_b["Grapple"] == -100.0
    assert bench.commands_b["GrappleMode"] == GrappleCommand.HOLD
    for change in ({"ChannelA": 1}, {"ChannelA": 0, "ChannelB": 0}):
        bench.changed["EstopStat"] = change
        bench.run(60)
        assert bench.mode in (Mode.STOP, Mode.FAULT)
        assert bench.neutral and bench.commands_b["GrappleMode"] == GrappleCommand.HOLD


GOALS = (0.8, 0.35, 0.6, 0.5, 1.2)


def test_pd_tracks_a_smooth_motion_of_all_joints():
    """Profile of the 2026 test-bed (machines.md 1.6), planner at 20 Hz, small plant with dead time and dead-band."""
    bench = Bench().armed()
    start, origin_ns = list(bench.q), bench.now_ns
    total_s = 1.1 * max(2.1875 * abs(d) / s.speed_limit for d, s in zip(GOALS, SPECS, strict=True))

    def plan(t_s):
        x = min(max(t_s / total_s, 0.0), 1.0)
        s = 35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7
        ds = (140 * x**3 - 420 * x**4 + 420 * x**5 - 140 * x**6) / total_s
        return [p + d * s for p, d in zip(start, GOALS, strict=True)], [d * ds for d in GOALS]

    worst = [0.0] * 5
    for k in range(int(total_s * 200) + 60):
        datagrams = []
        if k % 10 == 0:
            t_s = (bench.now_ns - origin_ns) * 1e-9
            knots = [(50 * i, *plan(t_s + 0.05 * i)) for i in range(9)]
            datagrams = [bench.setpoint(knots, final=t_s + 0.4 >= total_s)]
        bench.tick(datagrams)
        assert bench.mode is Mode.ACTIVE, bench.reason
        worst = [max(w, abs(q - r)) for w, q, r in zip(worst, bench.q, bench.controller.reference, strict=True)]
    assert all(w < 0.004 for w in worst), worst
    for q, p, d, spec in zip(bench.q, start, GOALS, SPECS, strict=True):
        assert abs(q - p - d) <= spec.law.stop_band
    bench.run(60)
    assert bench.mode is Mode.ARMED


def test_half_speed_caps_the_command():
    bench = Bench().active(speed=0.13)
    bench.dropped.add("PressA")
    bench.run(25)
    bench.drive(0, 0.13, 30)
    for _ in range(12):
        bench.drive(0, min(bench.controller.reference_velocity[0] + 0.03, 0.33), 10)
    assert bench.controller.supervisor.half_speed
    limit = ValveMap(SLEW.valve).spool_pct(0.5 * HEADROOM * SLEW.speed_limit)
    assert abs(bench.commands_a["Slew"] - limit) <= 0.05
