"""Spool tests: through the whole controller, and a program in force alone."""

from __future__ import annotations

from math import nan

import msgspec
import pytest

from can_dbc.messages.crane import SpoolKnot, SpoolTest
from can_dbc.messages.datagrams import encode
from controller.crane.spool_test_run import MAX_OPEN_NS, SpoolTestRun
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.requests import RequestRefused
from machine.joints import JOINTS, Joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import AORO, HOME, MS, PROFILE, Bench, T, count_until

SIGNALS = ("Slew", "Lift", "Tilt", "Ext", "Rot")
RAMP = ((0, 0.0), (5, 12.0), (405, 30.0))


def knots_of(points: tuple[tuple[float, float], ...]) -> tuple[SpoolKnot, ...]:
    return tuple(SpoolKnot(int(ms * MS), percent) for ms, percent in points)


def asked(bench: Bench, *points: tuple[float, float], joint: int = Joint.SLEW, lease_ms: int = 200) -> bytes:
    """A spool test from points (ms, %) that begins now."""
    bench.setpoint_sequence += 1
    stamp = (bench.setpoint_sequence, bench.settings.profile_hash, bench.now_ns, lease_ms * MS)
    return encode(SpoolTest(*stamp, joint, knots_of(points)))


def spools(bench: Bench) -> list[float]:
    commands = {**bench.commands_a, **bench.commands_b}
    return [commands[name] for name in SIGNALS]


def running(bench: Bench, percent: float, seconds: float, joint: int = Joint.SLEW, step=lambda bench: False) -> None:
    """Ramp to ``percent`` and stay there, renewed every 50 ms; ``step`` may end it."""
    sign = 1 if percent > 0 else -1
    begin_ns = bench.now_ns
    edge = bench.specs[joint].valve.deadband_plus_pct

    opens_ns = begin_ns + 5 * MS
    full_ns = opens_ns + int((abs(percent) - edge) / 0.08 * MS)

    def at(ns: int) -> float:
        return sign * min(abs(percent), edge + 0.08 * max(0, ns - opens_ns) / MS) if ns > begin_ns else 0.0

    while bench.now_ns < begin_ns + seconds * 1e9:
        now = bench.now_ns
        corners = sorted({now, now + 400 * MS} | {ns for ns in (opens_ns, full_ns) if now < ns < now + 400 * MS})
        bench.tick([asked(bench, *(((ns - now) / MS, at(ns)) for ns in corners), joint=joint)])
        for _ in range(9):
            if step(bench):
                return
            bench.tick()


def test_one_spool_follows_its_knots_and_all_others_are_neutral() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, *RAMP)])
    assert bench.mode is Mode.ACTIVE
    for k in range(1, 30):
        bench.tick()
        now_ms = (k + 1) * T / MS
        slew, *others = spools(bench)
        assert slew == pytest.approx(12.0 + 18.0 * (now_ms - 5) / 400, abs=0.06)
        assert others == [0.0] * 4 and bench.commands_b["GrappleMode"] == 0
    assert bench.controller.reference_position[0] == pytest.approx(bench.q[0], abs=0.01), "it follows the joint"


def test_test_that_ends_neutral_ends_in_armed() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 12.0), (100, 14.0), (105, 0.0))])
    assert count_until(bench.tick, lambda: bench.mode is Mode.ARMED, 60) * T == pytest.approx(200 * MS, abs=2 * T)
    assert spools(bench) == [0.0] * 5


def test_lost_lease_closes_the_valve_on_a_ramp_and_stops() -> None:
    bench = Bench().armed()
    running(bench, 40.0, 0.6)
    opened = []
    count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert bench.controller.supervisor.reason is Reason.LEASE_LOST
    for _ in range(40):
        opened.append(spools(bench)[0])
        bench.tick()
    fading = [p for p in opened if p > 0.0]
    assert fading == sorted(fading, reverse=True) and len(fading) > 10, "not in one step"
    assert spools(bench) == [0.0] * 5 and not bench.controller.crane.spool_run.running


def test_knots_that_end_open_stop_before_the_lease_does() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 12.0), (100, 16.0))])
    ticks = count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert 95 * MS <= ticks * T <= 110 * MS and bench.controller.supervisor.reason is Reason.LEASE_LOST


def test_trajectory_is_accepted_once_the_valve_is_shut() -> None:
    bench = Bench().armed()
    running(bench, 30.0, 0.4)
    bench.tick([bench.hold()])
    gate = bench.controller.gate
    assert (gate.refusal, gate.detail) == (Reason.TEST_BUSY, Joint.SLEW)
    bench.tick([asked(bench, (0, spools(bench)[0]), (60, 0.0))])
    bench.run(14)
    bench.tick([bench.hold()])
    assert bench.mode is Mode.ACTIVE and not bench.controller.crane.spool_run.running
    bench.run(2)
    assert abs(bench.controller.reference_position[0] - bench.q[0]) < 0.02


def test_test_does_not_interrupt_a_moving_trajectory() -> None:
    bench = Bench().active()
    refused = bench.controller.gate.refused
    bench.tick([asked(bench, *RAMP, joint=Joint.LIFT)])
    gate = bench.controller.gate
    assert (gate.refusal, gate.detail, gate.refused) == (Reason.TEST_BUSY, Joint.LIFT, refused + 1)
    assert not bench.controller.crane.spool_run.running


def test_test_needs_an_armed_machine() -> None:
    bench = Bench().boot()
    bench.tick([asked(bench, *RAMP)])
    assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is Reason.NOT_ARMED


def test_rotator_without_encoder_is_limited_by_its_integrated_angle() -> None:
    blind = Bench(AORO).armed()
    running(blind, 40.0, 0.6, Joint.ROT)
    assert blind.mode is Mode.ACTIVE and spools(blind) == [0.0, 0.0, 0.0, 0.0, pytest.approx(40.0, abs=0.1)]
    assert blind.controller.crane.spool_run.integrated_rad == pytest.approx(0.667 * 0.42, abs=0.05)


def test_wild_replayed_and_late_tests_are_refused() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 40.0))])
    assert (bench.controller.gate.refusal, bench.controller.gate.detail) == (Reason.TEST_SPOOL, Joint.SLEW)
    assert bench.mode is Mode.ARMED
    first = asked(bench, *RAMP)
    bench.tick([first])
    bench.tick([first])
    assert bench.controller.gate.refusal is Reason.OUT_OF_ORDER
    late = asked(bench, *RAMP, lease_ms=20)
    bench.run(10)
    bench.tick([late])
    assert bench.controller.gate.refusal is Reason.STAMP_OLD


def stopped_by(bench: Bench, reason: Reason, joint: Joint) -> bool:
    supervisor = bench.controller.supervisor
    return bench.mode is Mode.STOP and (supervisor.reason, supervisor.detail) == (reason, joint)


def test_joint_is_stopped_inside_its_range() -> None:
    bench = Bench(home=(1.5, *HOME[1:])).armed()
    running(bench, 50.0, 3.0, step=lambda b: b.mode is Mode.STOP)
    assert stopped_by(bench, Reason.TEST_RANGE, Joint.SLEW)
    bench.run(60)
    assert bench.q[0] < 1.74533


def test_joint_faster_than_the_profile_is_stopped() -> None:
    bench = Bench().armed()
    running(bench, 40.0, 0.7)
    bench.moves_alone[Joint.SLEW] = 0.35
    ticks = count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert stopped_by(bench, Reason.TEST_SPEED, Joint.SLEW)
    assert ticks * T < 100 * MS, "the estimator's filter and a tick"


@pytest.mark.parametrize("joint", JOINTS)
def test_guard_and_monitors_accept_a_test_below_the_dead_band(joint: Joint) -> None:
    bench = Bench(guard=build_guard(profile_path("palms_471"))).armed()
    running(bench, 11.0 if joint != Joint.ROT else 9.0, 2.0, joint)
    assert bench.mode is Mode.ACTIVE and bench.guard.enabled
    running(bench, -30.0, 1.0, joint)
    assert bench.mode is Mode.ACTIVE and bench.guard.enabled and bench.v[joint] < 0.0


# -- a test in force: accepted and refused programs, and reasons to stop

NOW = 5_000 * MS


def program(*points: tuple[float, float], joint: int = Joint.SLEW, stamp_ns: int = NOW) -> SpoolTest:
    """A test from points (ms, %)."""
    return SpoolTest(1, 0, stamp_ns, 200 * MS, joint, knots_of(points))


def reason_of(run: SpoolTestRun, test: SpoolTest, now_ns: int = NOW) -> Reason:
    with pytest.raises(RequestRefused) as refusal:
        run.start(test, now_ns)
    return refusal.value.reason


def test_program_is_linear_between_knots_and_neutral_after_the_last() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (5, 10.0), (105, 20.0)), NOW)
    assert run.percent(NOW) == 0.0
    assert run.percent(NOW + 55 * MS) == pytest.approx(15.0)
    assert run.percent(NOW + 105 * MS) == 20.0
    assert run.percent(NOW + 106 * MS) == 0.0
    assert run.cut_short(NOW + 106 * MS) and not run.ends_neutral(NOW + 106 * MS)


def test_joint_without_encoder_is_refused() -> None:
    tilt = msgspec.structs.replace(AORO.profile.joints["tilt"], encoder=None)
    run = SpoolTestRun(msgspec.structs.replace(AORO.profile, joints={**AORO.profile.joints, "tilt": tilt}))
    assert reason_of(run, program((0, 0.0), joint=Joint.TILT)) is Reason.TEST_FUNCTION
    assert not run.running


def stopped(run: SpoolTestRun, percent: float, most_s: float = 10.0) -> tuple[Reason, float]:
    """Drive a rotator's test tick by tick: reason to stop, and time until then [s]."""
    ramp = 200 * MS
    for now in range(NOW, NOW + int(most_s * 1e9), T):
        if now == NOW:
            run.start(program((0, 0.0), (200, percent), (400, percent), joint=Joint.ROT), now)
        elif now >= NOW + ramp and now % (50 * MS) == 0:
            run.start(program((0, percent), (400, percent), joint=Joint.ROT, stamp_ns=now), now)
        if (reason := run.check(nan, nan, 1.0, now)) is not Reason.NONE:
            return reason, (now - NOW) * 1e-9
        run.drive(1.0, now)
    return Reason.NONE, most_s


def test_rotator_without_encoder_stays_within_its_range_by_its_commands() -> None:
    run = SpoolTestRun(AORO.profile)
    # 70 % is 1.33 rad/s, with 0.4 rad for stopping: 5.88 of 6.28 rad
    reason, after_s = stopped(run, 70.0)
    assert reason is Reason.TEST_RANGE and after_s == pytest.approx(5.88 / 1.333 + 0.1, abs=0.1)
    assert run.integrated_rad == pytest.approx(5.88, abs=0.02)
    run.start(program((0, 0.0), joint=Joint.ROT), NOW)
    run.end()
    assert stopped(run, 70.0)[1] < 0.25, "the angle counts over all tests"
    run.start(program((0, 0.0), joint=Joint.ROT), NOW)
    run.end()
    assert stopped(run, -70.0, most_s=3.0) == (Reason.NONE, 3.0), "turning back is allowed"


def test_rotator_without_encoder_is_tested_five_seconds_at_most() -> None:
    run = SpoolTestRun(AORO.profile)
    reason, after_s = stopped(run, 9.0)
    assert reason is Reason.TEST_TOO_LONG and after_s == pytest.approx(5.0, abs=0.02)
    assert run.integrated_rad == 0.0, "inside the dead-band by the profile"


def test_rotator_without_encoder_keeps_to_speed_and_half_speed() -> None:
    assert reason_of(SpoolTestRun(AORO.profile), program((0, 0.0), (500, 78.0), joint=Joint.ROT)) is Reason.TEST_SPOOL
    run = SpoolTestRun(AORO.profile)
    run.start(program((0, 0.0), (500, 70.0), (600, 70.0), joint=Joint.ROT), NOW)
    assert run.check(nan, nan, 1.0, NOW + 500 * MS) is Reason.NONE
    assert run.check(nan, nan, 0.5, NOW + 500 * MS) is Reason.TEST_SPEED


@pytest.mark.parametrize(
    ("taken", "refused"),
    [
        # 0.35 of 0.5 rad/s: 12 + 88 * 0.7 = 73.6 %
        pytest.param(((0, 0.0), (500, 73.0)), ((0, 0.0), (500, 74.0)), id="speed"),
        pytest.param(((0, 0.0), (5, 12.0), (105, 20.0)), ((0, 0.0), (5, 20.0), (105, 20.0)), id="step over dead-band"),
    ],
)
def test_more_speed_than_the_limit_and_a_step_of_the_opening_are_refused(taken, refused) -> None:
    SpoolTestRun(PROFILE).start(program(*taken), NOW)
    assert reason_of(SpoolTestRun(PROFILE), program(*refused)) is Reason.TEST_SPOOL


def test_step_from_the_present_command_is_refused_and_closing_is_free() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (400, 40.0)), NOW)
    at = NOW + 200 * MS
    assert reason_of(run, program((0, 40.0), (100, 40.0), stamp_ns=at), at) is Reason.TEST_SPOOL
    assert run.percent(at) == pytest.approx(20.0), "the refused one changes nothing"
    run.start(program((0, 0.0), stamp_ns=at), at)
    assert run.percent(at) == 0.0


def test_late_window_of_the_same_program_is_accepted() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (200, 30.0), (400, 60.0)), NOW)
    run.start(program((0, 15.0), (100, 30.0), (300, 60.0), stamp_ns=NOW + 100 * MS), NOW + 110 * MS)
    assert run.percent(NOW + 110 * MS) == pytest.approx(16.5)


def test_another_function_waits_until_the_valve_is_shut() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (400, 30.0)), NOW)
    at = NOW + 300 * MS
    assert reason_of(run, program((0, 0.0), joint=Joint.LIFT, stamp_ns=at), at) is Reason.TEST_BUSY
    later = NOW + 401 * MS
    run.start(program((0, 0.0), joint=Joint.LIFT, stamp_ns=later), later)
    assert run.function == Joint.LIFT


@pytest.mark.parametrize(
    ("position", "velocity", "percent", "cap", "reason"),
    [
        (0.0, 0.3, 30.0, 1.0, Reason.NONE),
        (0.0, 0.45, 30.0, 1.0, Reason.TEST_SPEED),
        (0.0, 0.25, 30.0, 1.0, Reason.NONE),
        (0.0, 0.25, 30.0, 0.5, Reason.TEST_SPEED),
        (1.70, 0.2, 30.0, 1.0, Reason.TEST_RANGE),
        (1.70, 0.2, -30.0, 1.0, Reason.NONE),
        (-1.70, -0.2, -30.0, 1.0, Reason.TEST_RANGE),
    ],
)
def test_range_and_speed_are_checked_by_the_encoder(
    position: float, velocity: float, percent: float, cap: float, reason: Reason
) -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (400, percent)), NOW)
    assert run.check(position, velocity, cap, NOW + 300 * MS) is reason


def test_test_lasts_twenty_seconds_at_most() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (100, 5.0)), NOW)
    now, reason = NOW, Reason.NONE
    while reason is Reason.NONE and now < NOW + 2 * MAX_OPEN_NS:
        now += 50 * MS
        run.start(program((0, 5.0), (100, 5.0), stamp_ns=now), now)
        reason = run.check(0.0, 0.0, 1.0, now)
    assert reason is Reason.TEST_TOO_LONG
    assert MAX_OPEN_NS <= now - NOW <= MAX_OPEN_NS + 200 * MS


def test_command_carries_the_profiles_sign_and_fades() -> None:
    run = SpoolTestRun(PROFILE)
    run.start(program((0, 0.0), (400, 40.0), joint=Joint.LIFT), NOW)
    spool, speed = run.drive(1.0, NOW + 400 * MS)
    assert spool == pytest.approx(40.0 * PROFILE.joints["lift"].valve.sign)
    assert speed == pytest.approx((40.0 - 12.0) / 88.0 * 0.2)
    assert run.drive(0.5, NOW + 500 * MS)[0] == pytest.approx(0.5 * spool)
