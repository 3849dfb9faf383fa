"""The closed loop of the whole controller on a small plant, and the time scaling of its trajectories."""

from itertools import pairwise
from math import isnan

import msgspec
import pytest

from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot
from controller.crane.reference_governor import (
    FLOW_SHARE,
    HISTORY_KNOTS,
    MAX_BEHIND_NS,
    RATE_CHANGE_1_S,
    ReferenceGovernor,
    TimeScaling,
    Trajectory,
)
from controller.guard.__main__ import build, profile_path
from controller.laws.grapple import GrappleState
from controller.laws.valve_map import ValveMap
from machine.joints import Joint
from machine.profile import SPEED_HEADROOM_SHARE
from machine.status.modes import Mode
from tests.controller.bench import AORO, MS, PROFILE, SETTINGS, SPECS, Bench, T, settings_of, with_pump

GOALS = (0.8, 0.35, 0.6, 0.5, 1.2)
"""Displacement of every joint [rad, m]."""


def plan_smoothly(bench, total_s, seconds):
    """A planner that moves all joints together, on a profile of seventh order; yields after each tick."""
    start, origin_ns = list(bench.q), bench.now_ns

    def plan(t_s):
        x = min(max(t_s / total_s, 0.0), 1.0)
        s = 35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7
        ds = (140 * x**3 - 420 * x**4 + 420 * x**5 - 140 * x**6) / total_s
        return [p + d * s for p, d in zip(start, GOALS, strict=True)], [d * ds for d in GOALS]

    for k in range(int(seconds * 200)):
        datagrams = []
        if k % 10 == 0:
            t_s = (bench.now_ns - origin_ns) * 1e-9
            datagrams = [
                bench.setpoint([(50 * i, *plan(t_s + 0.05 * i)) for i in range(9)], final=t_s + 0.4 >= total_s)
            ]
        bench.tick(datagrams)
        assert bench.mode is Mode.ACTIVE, (bench.reason, k)
        yield start


SLEW = SPECS[0]
TOTAL_S = 16.0


@pytest.mark.parametrize("kind", ["pd", "sliding_mode", pytest.param("super_twisting", marks=pytest.mark.long)])
def test_smooth_motion_of_all_joints_is_tracked(kind):
    """Profile of the 2026 test-bed (docs/reference/machines.md section 1.6), planner at 20 Hz, slow enough for the
    pump.
    """
    joints = {
        name: msgspec.structs.replace(s, law=msgspec.structs.replace(s.law, kind=kind))
        for name, s in SETTINGS.profile.joints.items()
    }
    profile = msgspec.structs.replace(SETTINGS.profile, joints=joints)
    bench = Bench(settings_of(profile)).armed()
    worst = [0.0] * 5
    start = list(bench.q)
    for _ in plan_smoothly(bench, TOTAL_S, TOTAL_S + 3.0):
        reference = bench.controller.reference_position
        worst = [max(w, abs(q - r)) for w, q, r in zip(worst, bench.q, reference, strict=True)]
        assert bench.controller.crane.governor.behind_ns == 0
    assert max(worst[:4]) < 0.004 and worst[4] < 0.01, worst
    for q, p, d, spec in zip(bench.q, start, GOALS, SPECS, strict=True):
        assert abs(q - p - d) <= 2.0 * spec.law.stop_band
    assert bench.run(60) is Mode.ARMED


def test_valves_are_shut_at_rest():
    bench = Bench().armed()
    for _ in plan_smoothly(bench, 8.0, 10.0):
        pass
    opened = 0
    for k in range(800):
        bench.tick([bench.hold()] if k % 10 == 0 else ())
        opened += not bench.neutral and any(bench.commands_a[s] for s in ("Slew", "Lift", "Tilt", "Ext"))
    assert opened <= 0.05 * 800


def test_half_speed_slows_the_trajectory():
    bench = Bench().active(speed=0.13)
    bench.dropped.add("PressA")
    bench.run(25)
    bench.drive(0, 0.13, 30)
    for _ in range(12):
        planned = bench.controller.crane.governor.planned(bench.now_ns)[1][0]
        bench.drive(0, min(planned + 0.03, 0.33), 10)
    assert bench.controller.supervisor.half_speed
    limit = ValveMap(SLEW.valve).spool_pct(0.5 * SPEED_HEADROOM_SHARE * SLEW.speed_limit)
    assert bench.commands_a["Slew"] <= limit + 0.05
    assert bench.controller.crane.governor.rate < 0.8


# -- a machine without sensors for rotator and opening: it starts, moves and never reads them


@pytest.fixture
def forwarder() -> Bench:
    return Bench(settings=AORO, home=(0.0, 0.9, -2.0, 0.5, 0.0), guard=build(profile_path("aoro_fc8")))


@pytest.mark.parametrize("which", [Joint.SLEW, Joint.EXT, Joint.ROT])
def test_controller_arms_and_moves_without_a_rotator_encoder_and_the_guard_lets_it(forwarder, which):
    forwarder.active(which, 0.1, 200)
    report = forwarder.reports[-1]
    assert forwarder.mode is Mode.ACTIVE and report.refused == 0
    assert forwarder.q[which] > 0.07
    assert isnan(report.position[Joint.ROT]) and not any(map(isnan, report.position[: Joint.ROT]))
    if which is Joint.ROT:
        assert report.reference[Joint.ROT] == pytest.approx(forwarder.q[Joint.ROT], abs=0.05)


def test_opening_on_the_bus_is_ignored_without_a_sensor(forwarder):
    forwarder.changed["GrappleStat"] = {"Opening": 100.0}
    forwarder.armed()
    forwarder.keep(300, grapple=GrappleCommand.OPEN)
    assert forwarder.controller.crane.grapple.state is GrappleState.OPENING, "100 % open means nothing here"
    forwarder.keep(400, grapple=GrappleCommand.OPEN)
    assert isnan(forwarder.reports[-1].opening_pct)
    assert forwarder.controller.crane.grapple.state is GrappleState.OPEN


# -- time scaling: slowed for the pump and at half speed, on the path, and joined to the planner's setpoints

VALVES = [ValveMap(s.valve) for s in SPECS]
ZERO = (0.0,) * 5


def setpoint(stamp_ns, positions, velocity=ZERO, every_ms=50):
    knots = tuple(Knot(i * every_ms * MS, tuple(q), tuple(velocity)) for i, q in enumerate(positions))
    return CraneSetpoint(1, 0, stamp_ns, 200 * MS, GrappleCommand.NEUTRAL, False, knots)


def line(stamp_ns, velocity, n=9):
    """Knots on a straight line through 0 at time 0."""
    return setpoint(stamp_ns, [[v * (stamp_ns * 1e-9 + 0.05 * i) for v in velocity] for i in range(n)], velocity)


def test_rate_is_one_within_the_limits_of_pump_and_joints():
    pace = TimeScaling(with_pump(1.0))
    for _ in range(100):
        pace.step([s.speed_limit for s in SPECS], VALVES, 1.0, T)
    assert (pace.rate, pace.behind_ns) == (1.0, 0)


def test_rate_falls_smoothly_and_the_time_behind_is_bounded():
    velocity = [0.2, 0.1, -0.2, 0.2, 0.0]
    flow = sum(
        (v * s.valve.flow_plus if v >= 0 else -v * s.valve.flow_minus) for v, s in zip(velocity, SPECS, strict=True)
    )
    pace, rates = TimeScaling(with_pump(0.5 * flow)), [1.0]
    for _ in range(80):
        pace.step(velocity, VALVES, 1.0, T)
        rates.append(pace.rate)
    assert max(a - b for a, b in pairwise(rates)) <= RATE_CHANGE_1_S * T * 1e-9 + 1e-12
    assert pace.rate == pytest.approx(0.5 * FLOW_SHARE)
    for _ in range(4000):
        pace.step(velocity, VALVES, 1.0, T)
    assert MAX_BEHIND_NS <= pace.behind_ns < 1.3 * MAX_BEHIND_NS
    pace.reset()
    assert (pace.rate, pace.behind_ns) == (1.0, 0)


def test_lower_cap_slows_the_time_when_a_joint_is_faster():
    pace = TimeScaling(with_pump(1.0))
    for _ in range(200):
        pace.step([SPECS[0].speed_limit, 0.0, 0.0, 0.0, 0.0], VALVES, 0.5, T)
    assert 0.5 < pace.rate < 0.6


def follower(flow_m3_s):
    return ReferenceGovernor(with_pump(flow_m3_s), VALVES, [120 * MS] * 5)


def test_slowed_reference_stays_on_the_path():
    made, velocity = follower(1.0e-4), [0.2, 0.1, -0.1, 0.1, 0.0]
    for k in range(160):
        now_ns = 10**9 + k * T
        if k % 10 == 0:
            made.candidate.load(line(now_ns, velocity))
            made.accept(now_ns, True)
        made.follow(now_ns, 1.0)
        own_s = (now_ns - made.behind_ns) * 1e-9
        assert made.position == pytest.approx([v * own_s for v in velocity], abs=1e-9)
        assert made.velocity == pytest.approx([v * made.rate for v in velocity], abs=1e-9)
    assert made.behind_ns > 300 * MS and made.rate < 0.6
    assert made.planned(now_ns)[0] == pytest.approx([v * now_ns * 1e-9 for v in velocity], abs=1e-9)


def test_time_catches_up_at_rest_and_hold_resets():
    made, velocity = follower(1.0e-4), [0.2, 0.1, -0.1, 0.1, 0.0]
    made.candidate.load(line(10**9, velocity))
    made.accept(10**9, True)
    for k in range(40):
        made.follow(10**9 + k * T, 1.0)
    behind = made.behind_ns
    assert behind > 0
    goal = [v * 1.4 for v in velocity]
    made.candidate.load(setpoint(10**9 + 400 * MS, [goal] * 9))
    made.accept(10**9 + 400 * MS, True)
    for k in range(40, 600):
        made.follow(10**9 + k * T, 1.0)
    assert made.behind_ns == 0 and made.position == pytest.approx(goal) and not any(made.velocity)
    made.hold(0, 0.3, 10**9)
    assert made.position[0] == 0.3 and made.behind_ns == 0


def test_trajectory_keeps_past_knots_only_while_behind():
    old, new = Trajectory(), Trajectory()
    old.load(line(10**9, [0.1] * 5))
    for k in range(1, 60):
        new.load(line(10**9 + k * 50 * MS, [0.1] * 5))
        old.extend(new, 10**9 + k * 50 * MS - 300 * MS)
        q, v = [0.0] * 5, [0.0] * 5
        for back in range(0, 300, 20):
            at_ns = 10**9 + k * 50 * MS - min(back, k * 50) * MS
            old.fill(range(5), at_ns, q, v)
            assert q == pytest.approx([0.1 * at_ns * 1e-9] * 5)
    old.extend(new, 0)
    assert old._n <= HISTORY_KNOTS + 9 and old.end_ns == 10**9 + 59 * 50 * MS + 400 * MS


@pytest.mark.parametrize("late_us", [1, 300, 20_000])
def test_setpoints_of_a_planner_that_is_not_punctual_join_without_a_speed_that_no_joint_has(late_us):
    """Its clock goes on in whole periods: each setpoint begins a little off the last one's path."""
    made, velocity = follower(1.0e-4), [0.2, 0.1, -0.1, 0.1, 0.0]
    now_ns, due_ns, k = 10**9, 10**9, 0
    for _ in range(800):
        if now_ns >= due_ns:
            off_s = 0.004 * (-1) ** k
            ahead = [[v * (k * 0.05 + off_s + 0.05 * i) for v in velocity] for i in range(9)]
            made.candidate.load(setpoint(now_ns - T + late_us * 1000, ahead, velocity))
            made.accept(now_ns, True)
            due_ns, k = due_ns + 50 * MS + late_us * 1000, k + 1
        made.follow(now_ns, 1.0)
        for v, lead, most in zip(made.velocity, made.lead_velocity, velocity, strict=True):
            assert max(abs(v), abs(lead)) <= 1.05 * abs(most) + 1e-12
        now_ns += T
    assert made.behind_ns >= MAX_BEHIND_NS


def test_a_curve_that_is_continued_stays_what_it_was_and_then_steps():
    old, same, new = Trajectory(), Trajectory(), Trajectory()
    for each in (old, same):
        each.load(setpoint(10**9, [[0.1 * i * i] * 5 for i in range(4)], [0.5] * 5))
    step_ns = 10**9 + 120 * MS
    new.load(setpoint(step_ns, [[2.0 + i] * 5 for i in range(3)], [20.0] * 5))
    old.extend(new, 10**9)
    found, wanted, v, w = ([0.0] * 5 for _ in range(4))
    for at_ns in range(10**9, step_ns + 100 * MS, 7 * MS // 3):
        old.fill(range(5), at_ns, found, v)
        (same if at_ns <= step_ns else new).fill(range(5), at_ns, wanted, w)
        assert found == pytest.approx(wanted) and v == pytest.approx(w), at_ns


def test_a_curve_that_ended_rests_until_it_is_continued():
    old, new = Trajectory(), Trajectory()
    old.load(setpoint(10**9, [[0.0] * 5, [0.1] * 5], [2.0] * 5))
    new.load(setpoint(10**9 + 90 * MS, [[0.2] * 5, [0.3] * 5], [2.0] * 5))
    old.extend(new, 10**9)
    q, v = [0.0] * 5, [0.0] * 5
    for ms, place, speed in ((51, 0.1, 0.0), (89, 0.1, 0.0), (91, 0.202, 2.0), (140, 0.3, 2.0)):
        old.fill(range(5), 10**9 + ms * MS, q, v)
        assert q == pytest.approx([place] * 5, abs=1e-4) and v == pytest.approx([speed] * 5, abs=0.01), ms


# -- in the controller


def bench_with(share):
    return Bench(settings_of(with_pump(PROFILE.hydraulics.pump_flow_m3_s * share))).armed()


def test_motion_beyond_the_pump_flow_stays_on_its_path():
    bench = bench_with(0.85)
    behind, off = 0, 0.0
    for start in plan_smoothly(bench, 9.0, 13.0):
        follower = bench.controller.crane.governor
        behind = max(behind, follower.behind_ns)
        shares = [(q - p) / d for q, p, d in zip(bench.q, start, GOALS, strict=True)]
        off = max(off, max(shares[:4]) - min(shares[:4]))
    assert behind > 100 * MS, "the motion should need more than the pump gives"
    assert off < 0.03, "all joints are at the same point of the path"
    for q, p, d, spec in zip(bench.q, start, GOALS, SPECS, strict=True):
        assert abs(q - p - d) <= 2.0 * spec.law.stop_band


def test_setpoint_at_the_slowed_reference_is_accepted():
    bench = bench_with(0.5)
    for _ in plan_smoothly(bench, 9.0, 4.0):
        pass
    follower = bench.controller.crane.governor
    assert follower.behind_ns > 100 * MS
    here = list(bench.controller.reference_position)
    speed = list(bench.controller.crane.governor.velocity)
    end = [h + 0.2 * v for h, v in zip(here, speed, strict=True)]
    bench.tick([bench.setpoint([(0, here, speed), (400, end, [0.0] * 5)])])
    assert bench.mode is Mode.ACTIVE and follower.behind_ns == 0
