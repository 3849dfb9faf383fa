"""A crane that does not stand level: the grapple hangs straight down, and the plan aims with it."""

from __future__ import annotations

from math import hypot

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autonomy.motion.arm_kinematics import Arm, slope_of
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.loading.profile_file import load_profile

PROFILE = load_profile("aoro_fc8")
LOW_M = 0.4


@pytest.mark.parametrize("roll_deg", [-10.0, 0.0, 10.0])
@pytest.mark.parametrize("pitch_deg", [-5.0, 8.0])
def test_the_jaws_hang_above_the_place_that_was_asked_for(roll_deg: float, pitch_deg: float) -> None:
    rotation = Rotation.from_euler("zyx", (150.0, pitch_deg, roll_deg), degrees=True).as_matrix()
    arm = Arm(PROFILE, slope=slope_of(rotation))
    pose = arm.pose_above(3.0, 3.5, LOW_M, LOW_M + 1.0)
    down = rotation.T @ np.array([0.0, 0.0, -1.0])
    below_m = lowest_tip_below_pin_m(PROFILE.grapple.jaws)
    level = Arm(PROFILE)
    pin = np.array([*level.xy(pose), pose.z_m])
    tips = pin + down / -down[2] * below_m
    assert tips[:2] == pytest.approx((3.0, 3.5), abs=1e-6) and arm.xy(pose) == pytest.approx((3.0, 3.5), abs=1e-6)
    assert hypot(*(tips - pin)[:2]) == pytest.approx(below_m * hypot(*slope_of(rotation)))
    assert arm.loaded(100.0).slope == arm.slope
