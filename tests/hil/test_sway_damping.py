"""A grapple that swings after an unshaped motion is brought to hang still by what its inertial sensor says."""

from __future__ import annotations

from functools import cache
from math import degrees
from pathlib import Path

import numpy as np
import pytest

from machine.status.modes import Mode
from sim.plant import Plant
from tests.hil.swinging_grapple import SHIPPED, sensing_profile, stop_at

pytestmark = pytest.mark.long

GOAL_M = (4.6, 2.0, 1.4)
"""The way there leads clear over the stakes."""
PERIOD_S = 1.8
CUT_S = 1.0

run = cache(stop_at)


@pytest.fixture(scope="module")
def sensing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The profile of a forwarder with the sensor."""
    return sensing_profile(tmp_path_factory.mktemp("sensing"))


@pytest.mark.parametrize(("truth", "seed"), [("nominal", 1), ("sampled", 2), ("sampled", 4)])
def test_two_periods_after_an_unshaped_motion_less_than_half_of_the_swing_is_left(
    sensing: Path, truth: str, seed: int
) -> None:
    plain, damped = (run(file, GOAL_M, truth=truth, seed=seed) for file in (SHIPPED, sensing))
    later = (2.0 * PERIOD_S, 3.0 * PERIOD_S)
    assert plain.swing(0.0, 0.5) == pytest.approx(damped.swing(0.0, 0.5), rel=0.1), "the same motion"
    assert degrees(plain.swing(*later)) > 1.5
    assert damped.swing(*later) < 0.5 * plain.swing(*later)
    assert damped.off_m[-1] < 0.02
    assert damped.modes == {Mode.ACTIVE}
    rested = damped.time_s > 8.0
    assert degrees(damped.lean_rad[rested].max()) < 1.0
    assert np.mean(np.all(damped.valves_pct[rested] == 0.0, axis=1)) > 0.95, "no limit cycle"


def test_a_sensor_that_falls_silent_lets_the_damping_fade(sensing: Path) -> None:
    def cut(plant: Plant, since_s: float) -> None:
        assert plant.imu is not None
        plant.imu.silent = since_s > CUT_S

    whole, broken = run(sensing, GOAL_M, truth="nominal", seed=1), stop_at(sensing, GOAL_M, each=cut)
    before, after = broken.time_s < CUT_S, broken.time_s > CUT_S + 0.3
    assert np.array_equal(whole.valves_pct[before], broken.valves_pct[before])
    assert not np.array_equal(whole.valves_pct[after], broken.valves_pct[after])
    assert broken.modes == {Mode.ACTIVE}
    assert broken.off_m[-1] < 0.02
    # The pin goes back and the joints come to rest: nothing is faster than with the sensor.
    assert np.max(np.abs(broken.valves_pct[after])) <= np.max(np.abs(whole.valves_pct))
