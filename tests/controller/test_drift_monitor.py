"""The drift monitor: a joint that creeps against its pulses, whatever it was commanded on the way to its pose."""

import pytest

from controller.estimation.drift_monitor import SETTLE_S, DriftMonitor
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
