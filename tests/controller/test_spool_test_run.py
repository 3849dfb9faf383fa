"""A spool test in force: accepted and refused programs, and reasons to stop."""

from __future__ import annotations

from math import nan

import msgspec
import pytest

from can_dbc.messages.crane import SpoolKnot, SpoolTest
from controller.crane.spool_test_run import MAX_OPEN_NS, SpoolTestRun
from controller.requests import RequestRefused
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.status.reasons import Reason

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")
MS = 1_000_000
NOW = 5_000 * MS


def asked(*points: tuple[float, float], joint: int = Joint.SLEW, stamp_ns: int = NOW) -> SpoolTest:
    """A test from points (ms, %)."""
    knots = tuple(SpoolKnot(int(ms * MS), percent) for ms, percent in points)
    return SpoolTest(1, 0, stamp_ns, 200 * MS, joint, knots)


def reason_of(run: SpoolTestRun, test: SpoolTest, now_ns: int = NOW) -> Reason:
    with pytest.raises(RequestRefused) as refusal:
        run.start(test, now_ns)
    return refusal.value.reason


def test_program_is_linear_between_knots_and_neutral_after_the_last() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (5, 10.0), (105, 20.0)), NOW)
    assert run.percent(NOW) == 0.0
    assert run.percent(NOW + 55 * MS) == pytest.approx(15.0)
    assert run.percent(NOW + 105 * MS) == 20.0
    assert run.percent(NOW + 106 * MS) == 0.0
    assert run.cut_short(NOW + 106 * MS) and not run.ends_neutral(NOW + 106 * MS)


def test_joint_without_encoder_is_refused() -> None:
    tilt = msgspec.structs.replace(AORO.joints["tilt"], encoder=None)
    run = SpoolTestRun(msgspec.structs.replace(AORO, joints={**AORO.joints, "tilt": tilt}))
    assert reason_of(run, asked((0, 0.0), joint=Joint.TILT)) is Reason.TEST_FUNCTION
    assert not run.running


def stopped(run: SpoolTestRun, percent: float, most_s: float = 10.0) -> tuple[Reason, float]:
    """Drive a rotator's test tick by tick: reason to stop, and time until then [s]."""
    ramp = 200 * MS
    for now in range(NOW, NOW + int(most_s * 1e9), 5 * MS):
        if now == NOW:
            run.start(asked((0, 0.0), (200, percent), (400, percent), joint=Joint.ROT), now)
        elif now >= NOW + ramp and now % (50 * MS) == 0:
            run.start(asked((0, percent), (400, percent), joint=Joint.ROT, stamp_ns=now), now)
        if (reason := run.check(nan, nan, 1.0, now)) is not Reason.NONE:
            return reason, (now - NOW) * 1e-9
        run.drive(1.0, now)
    return Reason.NONE, most_s


def test_rotator_without_encoder_stays_within_its_range_by_its_commands() -> None:
    run = SpoolTestRun(AORO)
    # 70 % is 1.33 rad/s, with 0.4 rad for stopping: 5.88 of 6.28 rad
    reason, after_s = stopped(run, 70.0)
    assert reason is Reason.TEST_RANGE and after_s == pytest.approx(5.88 / 1.333 + 0.1, abs=0.1)
    assert run.integrated_rad == pytest.approx(5.88, abs=0.02)
    run.start(asked((0, 0.0), joint=Joint.ROT), NOW)
    run.end()
    assert stopped(run, 70.0)[1] < 0.25, "the angle counts over all tests"
    run.start(asked((0, 0.0), joint=Joint.ROT), NOW)
    run.end()
    assert stopped(run, -70.0, most_s=3.0) == (Reason.NONE, 3.0), "turning back is allowed"


def test_rotator_without_encoder_is_tested_five_seconds_at_most() -> None:
    run = SpoolTestRun(AORO)
    reason, after_s = stopped(run, 9.0)
    assert reason is Reason.TEST_TOO_LONG and after_s == pytest.approx(5.0, abs=0.02)
    assert run.integrated_rad == 0.0, "inside the dead-band by the profile"


def test_rotator_without_encoder_keeps_to_speed_and_half_speed() -> None:
    assert reason_of(SpoolTestRun(AORO), asked((0, 0.0), (500, 78.0), joint=Joint.ROT)) is Reason.TEST_SPOOL
    run = SpoolTestRun(AORO)
    run.start(asked((0, 0.0), (500, 70.0), (600, 70.0), joint=Joint.ROT), NOW)
    assert run.check(nan, nan, 1.0, NOW + 500 * MS) is Reason.NONE
    assert run.check(nan, nan, 0.5, NOW + 500 * MS) is Reason.TEST_SPEED


def test_more_speed_than_the_limit_is_refused() -> None:
    run = SpoolTestRun(PALMS)
    # 0.35 of 0.5 rad/s: 12 + 88 * 0.7 = 73.6 %
    run.start(asked((0, 0.0), (500, 73.0)), NOW)
    assert reason_of(SpoolTestRun(PALMS), asked((0, 0.0), (500, 74.0))) is Reason.TEST_SPOOL


def test_dead_band_may_be_stepped_over_and_the_opening_not() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (5, 12.0), (105, 20.0)), NOW)
    assert reason_of(SpoolTestRun(PALMS), asked((0, 0.0), (5, 20.0), (105, 20.0))) is Reason.TEST_SPOOL


def test_step_from_the_present_command_is_refused_and_closing_is_free() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (400, 40.0)), NOW)
    at = NOW + 200 * MS
    assert reason_of(run, asked((0, 40.0), (100, 40.0), stamp_ns=at), at) is Reason.TEST_SPOOL
    assert run.percent(at) == pytest.approx(20.0), "the refused one changes nothing"
    run.start(asked((0, 0.0), stamp_ns=at), at)
    assert run.percent(at) == 0.0


def test_late_window_of_the_same_program_is_accepted() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (200, 30.0), (400, 60.0)), NOW)
    run.start(asked((0, 15.0), (100, 30.0), (300, 60.0), stamp_ns=NOW + 100 * MS), NOW + 110 * MS)
    assert run.percent(NOW + 110 * MS) == pytest.approx(16.5)


def test_another_function_waits_until_the_valve_is_shut() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (400, 30.0)), NOW)
    at = NOW + 300 * MS
    assert reason_of(run, asked((0, 0.0), joint=Joint.LIFT, stamp_ns=at), at) is Reason.TEST_BUSY
    later = NOW + 401 * MS
    run.start(asked((0, 0.0), joint=Joint.LIFT, stamp_ns=later), later)
    assert run.function == Joint.LIFT


@pytest.mark.parametrize(
    ("position", "velocity", "percent", "reason"),
    [
        (0.0, 0.3, 30.0, Reason.NONE),
        (0.0, 0.45, 30.0, Reason.TEST_SPEED),
        (1.70, 0.2, 30.0, Reason.TEST_RANGE),
        (1.70, 0.2, -30.0, Reason.NONE),
        (-1.70, -0.2, -30.0, Reason.TEST_RANGE),
    ],
)
def test_range_and_speed_are_checked_by_the_encoder(
    position: float, velocity: float, percent: float, reason: Reason
) -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (400, percent)), NOW)
    assert run.check(position, velocity, 1.0, NOW + 300 * MS) is reason


def test_half_speed_halves_the_speed_limit() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (400, 30.0)), NOW)
    assert run.check(0.0, 0.25, 1.0, NOW) is Reason.NONE
    assert run.check(0.0, 0.25, 0.5, NOW) is Reason.TEST_SPEED


def test_test_lasts_twenty_seconds_at_most() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (100, 5.0)), NOW)
    now, reason = NOW, Reason.NONE
    while reason is Reason.NONE and now < NOW + 2 * MAX_OPEN_NS:
        now += 50 * MS
        run.start(asked((0, 5.0), (100, 5.0), stamp_ns=now), now)
        reason = run.check(0.0, 0.0, 1.0, now)
    assert reason is Reason.TEST_TOO_LONG
    assert MAX_OPEN_NS <= now - NOW <= MAX_OPEN_NS + 200 * MS


def test_command_carries_the_profiles_sign_and_fades() -> None:
    run = SpoolTestRun(PALMS)
    run.start(asked((0, 0.0), (400, 40.0), joint=Joint.LIFT), NOW)
    spool, speed = run.drive(1.0, NOW + 400 * MS)
    assert spool == pytest.approx(40.0 * PALMS.joints["lift"].valve.sign)
    assert speed == pytest.approx((40.0 - 12.0) / 88.0 * 0.2)
    assert run.drive(0.5, NOW + 500 * MS)[0] == pytest.approx(0.5 * spool)
