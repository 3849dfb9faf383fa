"""The monitors of a joint alone: what a good machine does is no fault, and every fault is found in time."""

import math
import random
from collections import deque

import pytest

from controller.estimation.joint_estimator import JointEstimator
from controller.estimation.joint_monitors import (
    CLOSING_S,
    EARLY_DELAY_S,
    LATE_DELAY_S,
    SETTLE_S,
    YIELD_LIMIT_RAD,
    DriftMonitor,
    MotionMonitor,
    SlopeYield,
    StandstillMonitor,
)
from controller.laws.joint import INCH_SHARE
from machine.loading.profile_file import load_profile
from machine.sensing import counts_from_position, position_from_counts
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from tests.controller.bench import SPECS, T

PERIOD_S = T * 1e-9
SLEW = SPECS[0]


# -- Motion monitor: no fault on any valve within the spread, and a fault when a joint does not follow

JOINTS = SPECS[:4]


class Valve:
    """Dead time, spool, a dead-band unlike the profile's, metering curve, gain, and compressible oil."""

    def __init__(self, spec, delay_s, gain=1.0, exponent=1.04, missing=0.0, oil_rad_s=8.0, zeta=0.3):
        self.full, self.gain, self.exponent, self.missing = spec.valve.full_speed_plus, gain, exponent, missing
        self.line = deque([0.0] * max(1, round(delay_s / PERIOD_S)))
        self.spool = self.v = self.x = self.q = 0.0
        self.oil, self.zeta = oil_rad_s, zeta

    def move(self, command):
        self.line.append(command)
        self.spool += PERIOD_S / 0.04 * (self.line.popleft() - self.spool)
        share = max(0.0, abs(self.spool) / self.full - self.missing)
        metered = math.copysign(self.gain * self.full * share**self.exponent, self.spool)
        self.x += metered * PERIOD_S
        a = self.oil**2 * (self.x - self.q) + 2.0 * self.zeta * self.oil * (metered - self.v)
        self.v += a * PERIOD_S
        self.q += self.v * PERIOD_S
        return self.v


def smooth(t_s, total_s):
    x = t_s / total_s
    return 140.0 / 2.1875 * (x * (1.0 - x)) ** 3 if 0.0 < x < 1.0 else 0.0


def alarm(spec, valve, commands):
    monitor = MotionMonitor(spec, PERIOD_S)
    for command in commands:
        reason = monitor.step(command, valve.move(command))
        if reason is not Reason.NONE:
            return reason
    return Reason.NONE


def there_and_back(spec, total_s=2.5, rest_s=0.3):
    """Motion at the speed limit and back at once; then an inch and a jerky stop."""
    n, top = round(total_s / PERIOD_S), spec.speed_limit
    out = [top * smooth(k * PERIOD_S, total_s) for k in range(n)]
    rest = [0.0] * round(rest_s / PERIOD_S)
    inch = [INCH_SHARE * spec.valve.full_speed_plus] * 60
    jerky = [min(top, 4.0 * spec.acceleration_limit * k * PERIOD_S) for k in range(200)]
    return out + [-v for v in out] + rest + inch + rest + jerky + [0.0] * 400


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
@pytest.mark.parametrize("delay_s", [0.03, 0.04, 0.095, 0.15])
@pytest.mark.parametrize(
    ("gain", "exponent", "missing"), [(1.0, 1.04, 0.0), (0.8, 1.1, 0.027), (1.2, 1.0, -0.027), (0.7, 1.1, 0.0)]
)
def test_valves_within_the_spread_raise_no_fault(spec, delay_s, gain, exponent, missing):
    valve = Valve(spec, delay_s, gain, exponent, missing)
    assert alarm(spec, valve, there_and_back(spec)) is Reason.NONE


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_stuck_joint_is_detected_in_time(spec):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, 0.08)
    command = 0.8 * spec.speed_limit
    for _ in range(400):
        assert monitor.step(command, valve.move(command)) is Reason.NONE
    ticks = next(k for k in range(200) if monitor.step(command, 0.0) is Reason.JOINT_STUCK)
    assert ticks * T <= FAULTS[Reason.JOINT_STUCK].bound_ms * 1_000_000 * 1.6, "from full motion"


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_uncommanded_motion_is_detected_in_time(spec):
    monitor = MotionMonitor(spec, PERIOD_S)
    ticks = next(k for k in range(200) if monitor.step(0.0, spec.speed_limit) is Reason.JOINT_RUNAWAY)
    assert ticks * T <= FAULTS[Reason.JOINT_RUNAWAY].bound_ms * 1_000_000


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_motion_against_the_command_is_detected(spec):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, 0.08)
    command = 0.4 * spec.speed_limit
    reasons = [monitor.step(command, -valve.move(command)) for _ in range(120)]
    assert Reason.JOINT_REVERSED in reasons
    assert reasons.index(Reason.JOINT_REVERSED) * T <= (LATE_DELAY_S + 0.2) * 1e9


def test_reset_clears_the_history_of_a_motion():
    monitor = MotionMonitor(SPECS[0], PERIOD_S)
    for _ in range(20):
        monitor.step(0.3, -0.3)
    monitor.reset()
    assert [monitor.step(0.0, 0.0) for _ in range(100)] == [Reason.NONE] * 100
    assert EARLY_DELAY_S < LATE_DELAY_S


@pytest.mark.parametrize(("yields", "limit_rad"), [(False, 0.06), (True, 0.4)])
def test_a_rotator_that_a_log_turns_runs_away_by_more(yields, limit_rad):
    """A quarter of its speed limit is no runaway; what it turns beyond that counts."""
    spec, velocity = SPECS[4], 1.25 * SPECS[4].speed_limit
    monitor = MotionMonitor(spec, PERIOD_S)
    ticks = next(k for k in range(1, 400) if monitor.step(0.0, velocity, yields) is Reason.JOINT_RUNAWAY)
    memory_s = 0.5
    beyond_rad = memory_s * (1.0 - math.exp(-ticks * PERIOD_S / memory_s)) * spec.speed_limit
    assert beyond_rad == pytest.approx(limit_rad * spec.speed_limit, abs=2.0 * PERIOD_S * spec.speed_limit)


@pytest.mark.parametrize(("yields", "stuck"), [(False, True), (True, False)])
def test_a_rotator_that_a_log_turns_back_is_not_stuck(yields: bool, stuck: bool) -> None:
    """As measured: a log that catches turns it back for 0.4 s at 25 deg/s, and it turns on at half of its command."""
    monitor, command = MotionMonitor(SPECS[4], PERIOD_S, against_s=1.0), 0.21
    for _ in range(400):
        assert monitor.step(command, command, yields) is Reason.NONE
    reasons = [monitor.step(command, -0.43, yields) for _ in range(80)]
    reasons += [monitor.step(command, 0.5 * command, yields) for _ in range(80)]
    assert (Reason.JOINT_STUCK in reasons) is stuck
    assert Reason.JOINT_STUCK in [monitor.step(command, 0.0, yields) for _ in range(400)]


# -- Standstill monitor: slow motion without a command is found, and a joint that only shakes is not

SENSED = [
    pytest.param(spec, id=f"{name} {joint}")
    for name in ("palms_471", "aoro_fc8")
    for joint, spec in load_profile(name).joints.items()
    if spec.encoder
]
BOUND_S = 0.6
FAST_BOUND_S = 0.15


class Joint:
    """A joint with its encoder's noise, its estimator and its monitor; `run` gives the time until it moves."""

    def __init__(self, spec, seed=1):
        self.spec, self.rng = spec, random.Random(seed)
        self.estimator, self.monitor = JointEstimator(spec, PERIOD_S), StandstillMonitor(spec, PERIOD_S)
        self.now_ns = 0

    def tick(self, position, neutral=True, shaken=False, pressed=False):
        self.now_ns += T
        encoder = self.spec.encoder
        seen = position_from_counts(encoder, counts_from_position(encoder, position + self.rng.gauss(0, encoder.noise)))
        self.estimator.predict(self.now_ns)
        self.estimator.update(seen, self.now_ns)
        return self.monitor.step(neutral, shaken, self.estimator.position, pressed=pressed)

    def run(self, motion, seconds, **how):
        """Seconds until the monitor says that it moves, None if it never does."""
        for k in range(round(seconds / PERIOD_S)):
            if self.tick(motion(k * PERIOD_S), **how):
                return k * PERIOD_S
        return None


def middle(spec):
    return 0.5 * (spec.lower + spec.upper)


@pytest.mark.parametrize("spec", SENSED)
@pytest.mark.parametrize(("pressed", "seen"), [(False, True), (True, False)])
def test_what_jaws_press_aside_is_no_motion_while_they_press(spec, pressed, seen):
    """Measured on a forwarder: a slew by the way of 0.04 s at its limit, within 0.3 s."""
    joint, far = Joint(spec), 0.04 * spec.speed_limit
    assert joint.run(lambda _: middle(spec), 4.0) is None, "at rest"
    found_s = joint.run(lambda t: middle(spec) + min(t / 0.3, 1.0) * far, 0.8, shaken=True, pressed=pressed)
    assert (found_s is not None) is seen


@pytest.mark.parametrize("spec", SENSED)
@pytest.mark.parametrize("share", [0.03, -0.03, 0.06, 0.12, 0.25])
def test_motion_without_a_command_is_found_in_time_at_any_speed(spec, share):
    for seed in range(3):
        joint, v = Joint(spec, seed), share * spec.speed_limit
        assert joint.run(lambda _: middle(spec), 4.0) is None, "at rest"
        found_s = joint.run(lambda t, v=v: middle(spec) + v * t, 2.0)
        assert found_s is not None and found_s <= BOUND_S
        if abs(share) >= 0.25:
            assert found_s <= FAST_BOUND_S


@pytest.mark.parametrize("spec", SENSED)
def test_a_joint_that_shakes_rings_or_creeps_does_not_move(spec):
    limit, start = spec.speed_limit, middle(spec)
    still = {
        "noise alone": lambda t: start,
        "creep": lambda t: start + 0.003 * limit * t,
        "a load that hangs on": lambda t: start + 0.008 * limit * (1.0 - math.exp(-t / 0.1)),
        "a log lets go and the boom rings on": lambda t: (
            start + 0.012 * limit * (1.0 - math.exp(-(t - 5) / 0.15) * math.cos(16 * math.pi * (t - 5))) * (t > 5)
        ),
        "swinging grapple": lambda t: start + 0.009 * limit * math.sin(2 * math.pi * t / 1.8),
        "a stop that rings": lambda t: start + 0.1 * limit * math.exp(-0.4 * t) * math.sin(2 * math.pi * 1.5 * t),
    }
    for what, motion in still.items():
        joint = Joint(spec)
        joint.run(lambda _: start, 0.1, neutral=False)
        assert joint.run(motion, 20.0) is None, what


@pytest.mark.parametrize("spec", SENSED)
def test_a_shaken_joint_may_move_further_and_a_runaway_is_found_all_the_same(spec):
    start, limit = middle(spec), spec.speed_limit
    joint = Joint(spec)
    assert joint.run(lambda _: start, 2.0, shaken=True) is None
    swing = lambda t: start + 0.02 * limit * math.sin(2 * math.pi * t / 1.8)  # noqa: E731
    assert joint.run(swing, 10.0, shaken=True) is None
    found_s = joint.run(lambda t: swing(10.0) + 0.2 * limit * t, 2.0, shaken=True)
    assert found_s is not None and found_s <= BOUND_S + 0.2


def test_a_valve_that_does_not_close_is_found_once_it_should_have():
    spec = SENSED[0].values[0]
    joint, v = Joint(spec), 0.2 * spec.speed_limit
    assert joint.run(lambda t: v * t, 2.0, neutral=False) is None
    found_s = joint.run(lambda t: v * (2.0 + t), 2.0)
    assert found_s is not None and CLOSING_S < found_s < CLOSING_S + BOUND_S


def test_reset_forgets_where_the_joint_was():
    spec = SENSED[0].values[0]
    joint = Joint(spec)
    joint.run(lambda _: 0.0, 3.0)
    joint.estimator.reset()
    joint.monitor.reset()
    assert joint.run(lambda _: 0.5, 3.0) is None and joint.monitor.quiet_s > 2.0


# -- Slope yield: nothing on level ground, and never far enough to hide a runaway

LEVEL, SLOPE = (0.005, -0.01), (0.0, 0.12)


def after(seconds, pressed=False, tilt=LEVEL, one=None):
    one = one or SlopeYield(PERIOD_S)
    for _ in range(max(1, round(seconds / PERIOD_S))):
        one.step(pressed, *tilt)
    return one


def test_on_level_ground_nothing_changes():
    one = after(1.0)
    for pressed in (True, False):
        assert after(0.5, pressed, one=one).rad == 0.0


def test_on_a_slope_the_slew_yields_while_jaws_or_a_load_press():
    one = after(20.0, tilt=SLOPE)
    assert one.rad == 0.0, "nothing turns it"
    assert after(0.0, pressed=True, tilt=SLOPE, one=one).rad == pytest.approx(0.4 * 0.10)
    assert after(0.0, tilt=SLOPE, one=one).rad == 0.0


def test_it_yields_when_a_wheel_climbs_a_stump_and_rests_soon_after():
    one = after(20.0)
    after(0.3, tilt=(0.095, -0.01), one=one)
    assert 0.02 < one.rad < 0.04
    assert after(8.0, tilt=(0.095, -0.01), one=one).rad == 0.0


def test_it_never_yields_far_and_an_unknown_inclination_is_level():
    one = after(0.1, True, tilt=(1.0, -1.0))
    assert one.rad == YIELD_LIMIT_RAD
    assert after(0.1, True, tilt=(math.nan, math.nan)).rad == 0.0


@pytest.mark.parametrize(("slack", "bound_s"), [(0.0, 0.2), (YIELD_LIMIT_RAD, 0.35)])
def test_a_valve_stuck_open_is_seen_with_all_the_slack(slack, bound_s):
    monitor, position = StandstillMonitor(SLEW, PERIOD_S), 0.0
    for _ in range(600):
        monitor.step(True, True, position, slack)
    seen_s = 0.0
    while not monitor.step(True, True, position, slack) and seen_s < 2.0:
        position += SLEW.speed_limit * PERIOD_S
        seen_s += PERIOD_S
    assert monitor.moves and seen_s < bound_s


def test_a_slew_that_yields_on_a_slope_does_not_run_away():
    for slack, moves in ((0.03, False), (0.0, True)):
        monitor = StandstillMonitor(SLEW, PERIOD_S)
        for _ in range(600):
            monitor.step(True, True, 0.0, slack)
        seen = any(monitor.step(True, True, 0.02 * min(1.0, k * PERIOD_S), slack) for k in range(400))
        assert seen is moves


# -- Drift monitor: a joint that creeps against its pulses, whatever it was commanded on the way to its pose

DRIFT = 0.00873


class Held:
    """A joint at its pose: the encoder drifts, and a pulse of 0.1 s every 1.5 s takes the drift back."""

    def __init__(self) -> None:
        self.monitor, self.position, self.k = DriftMonitor(SLEW, PERIOD_S), 0.0, 0

    def move(self, seconds, speed):
        for _ in range(round(seconds / PERIOD_S)):
            self.position += speed * PERIOD_S
            assert not self.monitor.step(False, speed, self.position, calm=True)

    def hold(self, seconds, drift, pulsed=True, calm=True):
        """Time until the drift is seen, None if it is not."""
        for k in range(round(seconds / PERIOD_S)):
            opens = pulsed and k * PERIOD_S % 1.5 >= 1.4
            speed = -15.0 * drift if opens else 0.0
            self.position += (drift + speed) * PERIOD_S
            if self.monitor.step(not opens, speed, self.position, calm):
                return k * PERIOD_S
        return None


@pytest.mark.parametrize("before", [0.0, 0.15, -0.15])
@pytest.mark.parametrize("drift", [DRIFT, -DRIFT])
def test_the_way_to_the_pose_hides_no_drift(before, drift):
    held = Held()
    held.hold(1.0, 0.0)
    held.move(3.0, before)
    rested = Held()
    rested.hold(SETTLE_S, 0.0)
    alone = rested.hold(30.0, drift)
    assert alone is not None
    assert held.hold(30.0, drift) == pytest.approx(alone, abs=0.1)


def test_motion_and_settling_are_no_drift():
    held = Held()
    for _ in range(5):
        held.move(2.0, 0.1)
        assert held.hold(3.0, 0.0004) is None
        held.move(2.0, -0.1)
        assert held.hold(3.0, -0.0004) is None


def test_a_joint_that_creeps_and_is_not_taken_back_is_for_other_monitors():
    assert Held().hold(10.0, DRIFT, pulsed=False) is None


@pytest.mark.parametrize(("calm", "seen"), [(True, True), (False, False)])
def test_a_joint_that_jaws_push_aside_at_once_does_not_drift(calm, seen):
    """Measured on a forwarder: closing jaws pressed the telescope out by 5 mm within 0.1 s."""
    monitor = DriftMonitor(SPECS[3], PERIOD_S, 0.25)
    position, found = 0.0, False
    for speed, neutral, seconds in ((0.0, True, 1.5), (-0.02, False, 0.2), (0.0, True, 0.5), (0.05, True, 0.12)):
        for _ in range(round(seconds / PERIOD_S)):
            position += speed * PERIOD_S
            found |= monitor.step(neutral, 0.0 if neutral else speed, position, calm)
    assert found is seen


@pytest.mark.parametrize("drift", [DRIFT, -DRIFT])
def test_a_drift_is_seen_once_everything_else_rests(drift):
    held = Held()
    alone = Held().hold(30.0, drift)
    assert held.hold(30.0, drift, calm=False) is None
    assert SETTLE_S <= held.hold(30.0, drift) <= alone + 1.5, "the same time, and one more pulse"


def test_what_goes_on_until_just_now_still_shakes():
    held = Held()
    held.hold(5.0, 0.0)
    for _ in range(20):
        held.hold(0.2, 0.0, calm=False)
        assert held.hold(0.9 * SETTLE_S, DRIFT) is None
