"""The drift monitor: a joint that creeps against its pulses, whatever it was commanded on the way to its pose."""

from types import SimpleNamespace

import pytest

from controller.estimation.drift_monitor import DriftMonitor
from tests.controller.bench import SPECS, T

PERIOD_S = T * 1e-9
DRIFT = 0.00873
SLEW = SPECS[0]


class Held:
    """A joint at its pose: the encoder drifts, and a pulse of 0.1 s every 1.5 s takes the drift back."""

    def __init__(self) -> None:
        self.monitor, self.position, self.k = DriftMonitor(SLEW, PERIOD_S), 0.0, 0

    def move(self, seconds, speed):
        for _ in range(round(seconds / PERIOD_S)):
            self.position += speed * PERIOD_S
            assert not self.monitor.step(False, speed, self.position)

    def hold(self, seconds, drift, pulsed=True):
        """Time until the drift is seen, None if it is not."""
        for k in range(round(seconds / PERIOD_S)):
            opens = pulsed and k * PERIOD_S % 1.5 >= 1.4
            speed = -15.0 * drift if opens else 0.0
            self.position += (drift + speed) * PERIOD_S
            if self.monitor.step(not opens, speed, self.position):
                return k * PERIOD_S
        return None


@pytest.mark.parametrize("before", [0.0, 0.15, -0.15])
@pytest.mark.parametrize("drift", [DRIFT, -DRIFT])
def test_the_way_to_the_pose_hides_no_drift(before, drift):
    held = Held()
    held.hold(1.0, 0.0)
    held.move(3.0, before)
    alone = Held().hold(30.0, drift)
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


def test_a_joint_that_yields_to_a_load_is_no_drift_and_a_drift_is_seen_after_it():
    held = Held()
    held.monitor.step(False, 0.02, 0.0)
    for k in range(round(1.0 / PERIOD_S)):
        held.position -= 0.02 * PERIOD_S
        assert not held.monitor.step(k < 20, 0.02, held.position, yields=True)
    assert held.hold(30.0, DRIFT) is not None


@pytest.mark.parametrize(("pressed", "seen"), [(False, True), (True, False)])
def test_a_joint_that_jaws_push_aside_at_once_does_not_drift(pressed, seen):
    """Measured on a forwarder: closing jaws pressed the telescope out by 5 mm within 0.1 s."""
    monitor = DriftMonitor(SPECS[3], PERIOD_S, 0.25)
    position, found = 0.0, False
    for speed, neutral, seconds in ((0.0, True, 1.0), (-0.02, False, 0.2), (0.0, True, 0.5), (0.05, True, 0.12)):
        for _ in range(round(seconds / PERIOD_S)):
            position += speed * PERIOD_S
            found |= monitor.step(neutral, 0.0 if neutral else speed, position, pressed=pressed)
    assert found is seen


@pytest.mark.parametrize("drift", [DRIFT, -DRIFT])
def test_jaws_at_work_hide_no_drift(drift):
    held = Held()
    alone = Held().hold(30.0, drift)
    step = held.monitor.step
    held.monitor = SimpleNamespace(step=lambda *now: step(*now, pressed=True))
    assert held.hold(30.0, drift) == pytest.approx(alone, abs=0.1)
