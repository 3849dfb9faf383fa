"""The clock of a tracked motion is where the controller is on it."""

from __future__ import annotations

import pytest

from autonomy.crane_job.trajectory_tracker import BRAKE_S, TrajectoryTracker
from autonomy.motion.trajectory import hold
from machine.loading.profile_file import load_profile

LOADER = load_profile("palms_471")
HOME = (0.0, 1.0, -1.8, 0.5, 0.0)


@pytest.mark.parametrize("steps", [1, 5, 7])
def test_while_it_brakes_every_datagram_begins_where_the_last_one_has_led(steps: int) -> None:
    """Steps of the planner for each datagram of 50 ms: the controller goes on at the rate that was announced."""
    tracker, step_s = TrajectoryTracker(LOADER, HOME), 0.05 / steps
    tracker.begin(hold(HOME))
    at_s = tracker.clock_s
    for period in range(60):
        assert tracker.clock_s == pytest.approx(at_s, abs=1e-12)
        at_s += 0.05 * tracker.announce()
        for _ in range(steps):
            tracker.advance(step_s, 1.0 if period < 20 else 0.0, HOME)
    assert tracker.is_stopped and at_s == pytest.approx(20 * 0.05 + BRAKE_S / 2, abs=0.05)


def test_a_clock_stands_until_its_motion_is_announced() -> None:
    tracker = TrajectoryTracker(LOADER, HOME)
    tracker.begin(hold(HOME))
    tracker.advance(0.04, 1.0, HOME)
    assert tracker.clock_s == 0.0 and not tracker.is_stopped
    assert tracker.announce() == 1.0
    tracker.advance(0.04, 1.0, HOME)
    assert tracker.clock_s == pytest.approx(0.04)
