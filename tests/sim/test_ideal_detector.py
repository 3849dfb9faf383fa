"""The ideal detector reports in the crane's base frame, which a carrier moves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from machine.loading.profile_file import load_profile
from sim.instruments import detect
from sim.plant import Plant


def test_on_a_fixed_machine_the_base_frame_is_the_world() -> None:
    plant = Plant(load_profile("palms_471"), seed=3)
    (seen,), (log,) = detect(plant), plant.logs()
    assert (seen.position_m, seen.axis) == (log.position_m, log.axis)
    assert (seen.length_m, seen.diameter_m) == (log.length_m, log.diameter_m)


def test_on_a_carrier_logs_lie_below_the_crane_base_and_ahead_means_backwards() -> None:
    """Slew 0 points backward, and the base is its height above the ground."""
    plant = Plant(load_profile("aoro_fc8"), seed=3)
    (seen,), (log,) = detect(plant), plant.logs()
    (x, y, z), _ = plant.base_pose()
    assert seen.position_m == pytest.approx(
        (x - log.position_m[0], y - log.position_m[1], log.position_m[2] - z), abs=0.02
    )
    assert math.hypot(*seen.axis) == pytest.approx(1.0)
    assert np.allclose(seen.axis[:2], np.negative(log.axis[:2]), atol=0.02)
    assert seen.position_m[2] < -1.0
