"""Energy: no part gains any by itself, and what the pump gives is found again."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from experiments.common.pool import Job
from experiments.common.worlds import step_neutral, trial_world
from experiments.plant import runs
from experiments.plant.grasps import DRIVEN, Driver, pick_logs
from sim.world import STEP_S

OPTIONS = {"profile": "palms_471", "truth": "nominal", "quick": False}
NOISE_J = 0.05  # windows with less kinetic energy are at rest


@pytest.mark.long
def test_the_peaks_of_the_kinetic_energy_fall_after_all_spools_are_closed():
    joules = runs.left_alone(Job("left_alone", "left_alone", 1, OPTIONS))["traces"]["kinetic_j"]
    n = round(2.0 / runs.SAMPLE_S)  # longer than the slowest swing
    peaks = [max(joules[i : i + n]) for i in range(0, len(joules) - n + 1, n)]
    assert len(peaks) == 10 and peaks[0] > 10.0
    assert all(after <= before for before, after in pairwise(peaks) if after > NOISE_J)


def test_a_falling_pile_creates_no_energy():
    joules = np.array(runs.falling(Job("falling", "falling", 1, OPTIONS))["traces"]["falling_j"])
    assert joules[0] > 100.0 and abs(joules[-1]) < 0.02 * joules[0]
    assert np.max(joules - np.minimum.accumulate(joules)) < 0.01 * joules[0]


@pytest.mark.long
def test_the_energy_of_the_pump_is_found_in_the_load_the_losses_and_the_oil():
    """Pump energy = work on the joints + losses + energy stored in the chambers, while the boom raises a log."""
    with trial_world("palms_471", "nominal", 1, "single", 1) as w:
        driver, oil = Driver(w), w.hydraulics

        def rest() -> tuple[float, float, float]:
            step_neutral(w, round(2.0 / STEP_S))
            driver.reference = {name: w.q[name] for name in DRIVEN}
            height_j = runs.machine_energy_j(w)[1] + runs.logs_energy_j(w)[1]
            return height_j, oil.energy_j, oil.energy_out_j + oil.loss_j + oil.stored_j

        pick_logs(w, driver)
        before = rest()
        driver.move({"lift": driver.reference["lift"] + 0.2})
        gained, pumped, spent = (b - a for a, b in zip(before, rest(), strict=True))
    assert spent == pytest.approx(pumped, rel=0.02)
    assert 0.0 < gained < 0.9 * pumped
