"""Plans for a crane whose column leans: the true pin goes where it is asked to go."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.trajectory import straight_line
from machine.geometry.kinematics import pin_position
from machine.geometry.sag import true_pin
from machine.loading.profile_file import load_profile
from machine.profile import Sag

PROFILE = load_profile("palms_471")
LEANING = Arm(msgspec.structs.replace(PROFILE, sag=Sag(0.0054, 0.0036, 0.028, 1.2e-6, 4500.0, 3000.0)))


@pytest.mark.parametrize("load_kg", [0.0, 250.0])
def test_with_sag_known_the_true_pin_goes_straight(load_kg: float) -> None:
    arm = LEANING.loaded(load_kg)
    assert arm.load_kg == load_kg and (arm is LEANING) == (load_kg == 0.0)
    start, goal = Pose(0.8, 3.6, 0.6, 0.9, 0.0), Pose(0.8, 5.2, 0.6, 0.9, 0.0)
    motion = straight_line(arm, start, goal)
    q = np.array(motion.position)
    true = np.array([true_pin(arm.profile.sag, PROFILE.kinematics, row, load_kg) for row in q])
    assert np.max(np.abs(true[:, 2] - 0.6)) < 1e-4, "as level as the column really holds it"
    assert np.hypot(*true[-1, :2]) == pytest.approx(5.2, abs=1e-5)
    assert arm.pose(q[-1])[:3] == pytest.approx(goal[:3], abs=1e-5)
    lifted = np.array([pin_position(PROFILE.kinematics, row)[2] for row in q]) - 0.6
    assert lifted[-1] - lifted[0] > 0.02, "the joints lift it the more, the farther it is out"
