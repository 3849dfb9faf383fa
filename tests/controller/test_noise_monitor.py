"""The noise monitor: encoders that become worse than their profile, or than they were; and what is no noise.

Expected values are the catalogue's: ten times the noise within 500 ms (docs/reference/safety.md case 4).
"""

import math
import random

import pytest

from controller.estimation.joint_estimator import JointEstimator
from machine.loading.profile_file import load_profile
from machine.sensing import counts_from_position, position_from_counts
from tests.controller.bench import T

SENSED = [
    pytest.param(s, id=f"{name} {s.encoder.message}")
    for name in ("palms_471", "aoro_fc8")
    for s in load_profile(name).joints.values()
    if s.encoder
]
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
    for _ in range(60):
        rig.run(1, 10.0)
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
