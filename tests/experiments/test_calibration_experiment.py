"""The calibration experiment on a machine of one's own: its metrics, its page, and poses that say nothing."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from experiments.calibration.metrics import SHIPPED, conclusion, machines_of, metrics_in, metrics_of, sections
from experiments.calibration.tip import touches
from experiments.common.worlds import trial_world
from machine.geometry.kinematics import solve
from machine.loading.profile_file import load_profile
from sim.individual import beside
from tests.machine.own_machine import NAME, made


def test_a_profile_of_ones_own_is_calibrated_alone(tmp_path: Path) -> None:
    profile = str(made(tmp_path))
    assert machines_of("palms_471") == machines_of("aoro_fc8") == SHIPPED
    assert machines_of(profile) == {NAME: profile}
    failed = [{"seed": 1, "seconds": 3.0, "failure": "stopped"}]
    found = metrics_of(NAME, profile, failed)
    assert found[f"{NAME}_complete"] == 0.0 and math.isnan(found[f"{NAME}_tip_max"])
    assert [section.title for section in sections(found)] == [NAME]
    assert not any("_rot_" in metric.name for metric in metrics_in(found)), "its rotator has an encoder"
    assert NAME in conclusion(found)[0]


@pytest.mark.parametrize(("pin_m", "stands"), [((3.0, 0.8, 1.6), True), ((4.4, -2.4, 2.8), False)])
def test_a_pose_with_the_grapple_on_a_stake_is_seen(tmp_path: Path, pin_m: tuple[float, ...], stands: bool) -> None:
    profile = made(tmp_path)
    home = dict(zip(("slew", "lift", "tilt", "ext"), solve(load_profile(profile), *pin_m), strict=True))
    with trial_world(str(profile), beside(str(profile), NAME, "nominal"), 0, home=home) as world:
        assert touches(world) is stands
