"""The monitors of a joint alone: what a good machine does is no fault, every fault is found in time; its estimator."""

import math
import random
from collections import deque

import msgspec
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
from controller.estimation.joint_monitors import (
    CLOSING_S,
    LATE_DELAY_S,
    SETTLE_S,
    USUAL_SPEED,
    YIELD_LIMIT_RAD,
    DriftMonitor,
    MotionMonitor,
    SlopeYield,
    StandstillMonitor,
)
from controller.estimation.valve_monitors import SPEED_WINDOW_S, SpeedMonitor
from controller.laws.joint import INCH_SHARE
from machine.loading.profile_file import load_profile
from machine.sensing import counts_from_position, position_from_counts
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from tests.controller.bench import MS, SPECS, T

PERIOD_S = T * 1e-9
SLEW = SPECS[0]


# -- Motion monitor: no fault on any valve within the spread, and a fault when a joint does not follow

of_each_joint = pytest.mark.parametrize("spec", SPECS[:4], ids=["slew", "lift", "tilt", "ext"])


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


def there_and_back(spec, total_s=2.5, rest_s=0.3):
    """Motion at the speed limit and back at once; then an inch and a jerky stop."""
    n, top = round(total_s / PERIOD_S), spec.speed_limit
    out = [top * smooth(k * PERIOD_S, total_s) for k in range(n)]
    rest = [0.0] * round(rest_s / PERIOD_S)
    inch = [INCH_SHARE * spec.valve.full_speed_plus] * 60
    jerky = [min(top, 4.0 * spec.acceleration_limit * k * PERIOD_S) for k in range(200)]
    return out + [-v for v in out] + rest + inch + rest + jerky + [0.0] * 400


@of_each_joint
@pytest.mark.parametrize("delay_s", [0.03, 0.04, 0.095, 0.15])
@pytest.mark.parametrize(
    ("gain", "exponent", "missing"), [(1.0, 1.04, 0.0), (0.8, 1.1, 0.027), (1.2, 1.0, -0.027), (0.7, 1.1, 0.0)]
)
def test_valves_within_the_spread_raise_no_fault(spec, delay_s, gain, exponent, missing):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, delay_s, gain, exponent, missing)
    assert {monitor.step(command, valve.move(command)) for command in there_and_back(spec)} == {Reason.NONE}


@of_each_joint
def test_stuck_joint_is_detected_in_time(spec):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, 0.08)
    command = 0.8 * spec.speed_limit
    for _ in range(400):
        assert monitor.step(command, valve.move(command)) is Reason.NONE
    ticks = next(k for k in range(200) if monitor.step(command, 0.0) is Reason.JOINT_STUCK)
    assert ticks * T <= FAULTS[Reason.JOINT_STUCK].bound_ms * 1_000_000 * 1.6, "from full motion"


@of_each_joint
def test_uncommanded_motion_is_detected_in_time(spec):
    monitor = MotionMonitor(spec, PERIOD_S)
    ticks = next(k for k in range(200) if monitor.step(0.0, spec.speed_limit) is Reason.JOINT_RUNAWAY)
    assert ticks * T <= FAULTS[Reason.JOINT_RUNAWAY].bound_ms * 1_000_000


@of_each_joint
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
    pytest.param(spec, id=f"{name} {which}")
    for name in ("palms_471", "aoro_fc8")
    for which, spec in load_profile(name).joints.items()
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


def at_rest(slack):
    """A slew that has stood still for three seconds, shaken."""
    monitor = StandstillMonitor(SLEW, PERIOD_S)
    assert not any(monitor.step(True, True, 0.0, slack) for _ in range(600))
    return monitor


@pytest.mark.parametrize(("slack", "bound_s"), [(0.0, 0.2), (YIELD_LIMIT_RAD, 0.35)])
def test_a_valve_stuck_open_is_seen_with_all_the_slack(slack, bound_s):
    monitor, position = at_rest(slack), 0.0
    seen_s = 0.0
    while not monitor.step(True, True, position, slack) and seen_s < 2.0:
        position += SLEW.speed_limit * PERIOD_S
        seen_s += PERIOD_S
    assert monitor.moves and seen_s < bound_s


@pytest.mark.parametrize(("slack", "moves"), [(0.03, False), (0.0, True)])
def test_a_slew_that_yields_on_a_slope_does_not_run_away(slack, moves):
    monitor = at_rest(slack)
    assert any(monitor.step(True, True, 0.02 * min(1.0, k * PERIOD_S), slack) for k in range(400)) is moves


# -- Drift monitor: a joint that creeps against its pulses, whatever it was commanded on the way to its pose

DRIFT = 0.00873


class Held:
    """A joint at its pose: the encoder drifts, and a pulse of 0.1 s every 1.5 s takes the drift back."""

    def __init__(self, spec=SLEW, least_speed: float = 0.0) -> None:
        self.monitor, self.position = DriftMonitor(spec, PERIOD_S, least_speed), 0.0

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


# -- Noise monitor: encoders that become worse than their profile, or than they were; and what is no noise
#    (ten times the noise within 500 ms: docs/reference/safety.md case 4)

SECOND = round(1e9 / T)
BOUND = round(0.5 * SECOND)


class Rig:
    """An encoder with white noise on a joint that swings at half its limits, or stands."""

    def __init__(self, spec, noise_share, seed=1, swings=True):
        self.spec, self.noise = spec, noise_share * spec.encoder.noise
        self.random, self.estimator, self.k = random.Random(seed), JointEstimator(spec, T * 1e-9), 0
        w = 0.5 * spec.acceleration_limit / spec.speed_limit
        self.half, self.w = (0.5 * spec.speed_limit / w, w) if swings else (0.0, 0.0)

    def run(self, ticks, factor=1.0, knock_at=-1, knock=0.0):
        """Number of samples until it is noisy, or jumps, which is worse; None if it never was."""
        encoder = self.spec.encoder
        for k in range(1, ticks + 1):
            self.k += 1
            true = 0.3 * encoder.unit_per_count + self.half * math.sin(self.w * self.k * T * 1e-9)
            true += self.random.gauss(0.0, factor * self.noise) + (knock if k == knock_at else 0.0)
            self.estimator.predict(self.k * T)
            self.estimator.update(position_from_counts(encoder, counts_from_position(encoder, true)), self.k * T)
            if self.estimator.noisy or self.estimator.jumped:
                return k
        return None


@pytest.mark.parametrize("spec", SENSED)
@pytest.mark.parametrize("swings", [True, False])
@pytest.mark.parametrize("warm_s", [1, 20])
def test_an_encoder_far_better_than_its_profile_is_noisy_at_ten_times_its_noise(spec, swings, warm_s):
    for seed in range(8):
        rig = Rig(spec, 0.15, seed, swings)
        assert rig.run(warm_s * SECOND) is None
        found = rig.run(BOUND, 10.0)
        assert found is not None and found <= BOUND


@pytest.mark.parametrize("spec", SENSED)
def test_an_encoder_as_noisy_as_its_profile_is_not_noisy_and_ten_times_that_is(spec):
    rig = Rig(spec, 1.0)
    assert rig.run(60 * SECOND) is None
    assert rig.run(BOUND, 10.0) is not None


@pytest.mark.parametrize("spec", SENSED)
def test_motion_rest_and_double_noise_are_no_noise(spec):
    for swings in (True, False):
        rig = Rig(spec, 0.15, swings=swings)
        assert rig.run(20 * SECOND) is None
        assert rig.run(20 * SECOND, 2.0) is None


@pytest.mark.parametrize("spec", SENSED)
def test_a_joint_that_rests_between_two_counts_is_not_noisy(spec):
    rig = Rig(spec, 0.0, swings=False)
    encoder = spec.encoder
    assert rig.run(5 * SECOND) is None
    for _ in range(20 * SECOND):
        rig.k += 1
        rig.estimator.predict(rig.k * T)
        rig.estimator.update(rig.random.randrange(2) * encoder.unit_per_count, rig.k * T)
        assert not rig.estimator.noisy


@pytest.mark.parametrize("spec", SENSED)
def test_one_knock_is_no_noise(spec):
    rig = Rig(spec, 0.15)
    assert rig.run(20 * SECOND) is None
    assert rig.run(SECOND, knock_at=100, knock=3.0 * spec.encoder.noise) is None


def test_noise_that_stays_is_not_learned_away():
    rig = Rig(SENSED[0].values[0], 0.15)
    rig.run(20 * SECOND)
    rig.run(BOUND, 10.0)
    quiet = sum(rig.run(1, 10.0) is None for _ in range(60 * SECOND))
    assert quiet < 0.02 * 60 * SECOND


@pytest.mark.parametrize("punctual", [True, False])
def test_samples_that_come_late_scatter_and_behind_a_plc_that_is_no_noise(punctual):
    """A PLC's samples are stamped 1 ms early or late, from some moment on, while the joint moves at its speed limit."""
    spec = load_profile("palms_471").joints["slew"]
    encoder, jitter, found = spec.encoder, random.Random(1), False
    estimator = JointEstimator(spec, T * 1e-9, punctual)
    for k in range(1, 4 * SECOND):
        late_s = jitter.choice((-1e-3, 1e-3)) if k > 2 * SECOND else 0.0
        measured = spec.speed_limit * (k * T * 1e-9 + late_s) - 1.0 + jitter.gauss(0.0, 0.1 * encoder.noise)
        estimator.predict(k * T)
        estimator.update(measured, k * T)
        found = found or estimator.noisy
    assert found is punctual


# -- A machine a third as fast as usual: its oil and steel yield as far as those of any other, and no monitor minds

LIFT = SPECS[1]
SLOW_VALVE = msgspec.structs.replace(
    LIFT.valve, full_speed_plus=LIFT.valve.full_speed_plus / 3, full_speed_minus=LIFT.valve.full_speed_minus / 3
)
SLOW = msgspec.structs.replace(LIFT, speed_limit=LIFT.speed_limit / 3, valve=SLOW_VALVE)
USUAL = USUAL_SPEED[1]


def test_the_usual_speed_is_that_of_the_slower_shipped_machine() -> None:
    limits = [[spec.speed_limit for spec in load_profile(name).joints.values()] for name in ("palms_471", "aoro_fc8")]
    assert list(USUAL_SPEED) == [min(pair) for pair in zip(*limits, strict=True)], "no shipped machine is judged anew"


def yields_s(least_speed: float, mrad: float = 4.0) -> float | None:
    """The boom rises on its oil as jaws let a log go, and stays there; when that counts as motion without a command."""
    monitor = StandstillMonitor(SLOW, PERIOD_S, least_speed=least_speed)
    for k in range(round(3.0 / PERIOD_S)):
        t = k * PERIOD_S - 1.0
        risen = 0.0 if t < 0.0 else 1e-3 * mrad * (1.0 - math.exp(-t / 0.15))
        if monitor.step(True, True, risen):
            return t
    return None


def test_a_boom_that_a_log_leaves_does_not_run_away() -> None:
    assert yields_s(USUAL) is None
    assert yields_s(0.0) is not None, "it was one by the speed limit of the slow machine"
    assert yields_s(USUAL, 12.0) is not None, "three times as far is a motion on any machine"


def first_fault(monitor: MotionMonitor | SpeedMonitor, command: float, velocity: float, seconds: float) -> Reason:
    found = (monitor.step(command, velocity) for _ in range(round(seconds / PERIOD_S)))
    return next((reason for reason in found if reason is not Reason.NONE), Reason.NONE)


def reacts(least_speed: float, command: float, velocity: float, seconds: float) -> Reason:
    return first_fault(MotionMonitor(SLOW, PERIOD_S, least_speed=least_speed), command, velocity, seconds)


def test_ringing_oil_is_no_runaway_and_a_fast_joint_is() -> None:
    assert reacts(USUAL, 0.0, 0.03, 0.25) is Reason.NONE
    assert reacts(0.0, 0.0, 0.03, 0.25) is Reason.JOINT_RUNAWAY
    assert reacts(USUAL, 0.0, 0.10, 0.25) is Reason.JOINT_RUNAWAY


def test_oil_that_is_pressed_first_is_no_stuck_joint_and_one_that_never_moves_is() -> None:
    assert reacts(USUAL, 0.02, 0.0, 1.0) is Reason.NONE
    assert reacts(0.0, 0.02, 0.0, 1.0) is Reason.JOINT_STUCK
    assert reacts(USUAL, SLOW.speed_limit, 0.0, 1.0) is Reason.JOINT_STUCK


@pytest.mark.parametrize(("least_speed", "reason"), [(USUAL, Reason.NONE), (0.0, Reason.JOINT_STUCK)])
def test_the_spool_of_a_slow_joint_is_open_before_it_moves(least_speed: float, reason: Reason) -> None:
    monitor = SpeedMonitor(SLOW_VALVE, SLOW.speed_limit, PERIOD_S, SPEED_WINDOW_S, least_speed)
    assert first_fault(monitor, 0.018, 0.001, 0.6) is reason
    assert first_fault(monitor, SLOW.speed_limit, 0.0, 0.6) is Reason.JOINT_STUCK


def test_an_encoder_drifts_when_it_drifts_as_far_as_on_any_machine() -> None:
    def drifts(least_speed: float, mrad_s: float) -> bool:
        return Held(SLOW, least_speed).hold(6.0, 1e-3 * mrad_s) is not None

    assert not drifts(USUAL, 1.8) and drifts(0.0, 1.8)
    assert drifts(USUAL, 3.0)


# -- the Kalman filter of a joint: gains against independent solvers, and estimates from encoder samples

H = np.array([[1.0, 0.0]])


def model(period_s, density):
    """Transition and process noise of a white acceleration."""
    q = density * np.array([[period_s**3 / 3, period_s**2 / 2], [period_s**2 / 2, period_s]])
    return np.array([[1.0, period_s], [0.0, 1.0]]), q


def riccati_gains(period_s, density, variance):
    f, q = model(period_s, density)
    p = solve_discrete_are(f.T, H.T, q, np.array([[variance]]))
    return p @ H.T / (p[0, 0] + variance)


@given(st.floats(1e-3, 0.02), st.floats(1e-6, 1.0), st.floats(1e-10, 1e-4))
def test_gains_are_stable_for_any_noise(period_s, density, variance):
    wanted = riccati_gains(period_s, density, variance).ravel().tolist()
    assert steady_gains(period_s, density, variance) == pytest.approx(wanted, rel=1e-4)


@given(
    st.sampled_from([case.values[0] for case in SENSED]),
    st.floats(-0.9, 0.9),
    st.floats(0.05, 2.0),
    st.sets(st.integers(1, 199), max_size=60),
)
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
