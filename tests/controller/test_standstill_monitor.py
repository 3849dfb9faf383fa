"""The standstill monitor alone: slow motion without a command is found, and a joint that only shakes is not."""

import math
import random

import pytest

from controller.estimation.joint_estimator import JointEstimator
from controller.estimation.standstill_monitor import CLOSING_S, StandstillMonitor
from machine.loading.profile_file import load_profile
from machine.sensing.encoder import counts_from_position, position_from_counts
from tests.controller.bench import T

PERIOD_S = T * 1e-9
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
