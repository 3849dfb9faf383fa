"""The arm: its telescope does what the boom need not, a column that leans, and a machine that does not stand level."""

from __future__ import annotations

from itertools import pairwise
from math import hypot

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion.arm_kinematics import (
    OUTER_RESERVE_M,
    STOP_MARGIN,
    Arm,
    Pose,
    fastest_extension,
    full_speed_times,
    slope_of,
    with_fastest_extensions,
)
from autonomy.motion.trajectory import Trajectory, hold, straight_line, with_rotation
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable, pin_position
from machine.geometry.sag import true_pin
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Sag, joint_limits

AORO = Arm(load_profile("aoro_fc8"))
START, GOAL = Pose(0.7, 4.5, 0.2, 1.2, 0.0), Pose(0.0, 2.4, 1.7, 0.2, 0.0)


def way(height_m: float) -> tuple[Pose, ...]:
    return START, START.at_height(height_m), GOAL.at_height(height_m), GOAL


def worked_s(via: tuple[Pose, ...]) -> float:
    return sum(full_speed_times(AORO, a, b, np.array([a.ext_m]), np.array([b.ext_m]))[0, 0] for a, b in pairwise(via))


@pytest.mark.parametrize("height_m", [2.6, 3.0])
def test_chosen_extensions_leave_less_work_and_change_only_the_corners(height_m: float) -> None:
    plain = way(height_m)
    easy = with_fastest_extensions(AORO, plain)
    assert worked_s(easy) < 0.9 * worked_s(plain)
    assert easy[0] == START and easy[-1] == GOAL
    assert [p._replace(ext_m=0.0) for p in easy] == [p._replace(ext_m=0.0) for p in plain]
    low, high = joint_limits(AORO.profile)[Joint.EXT]
    assert all(low + STOP_MARGIN < p.ext_m < high - STOP_MARGIN for p in easy)


def test_a_path_without_corners_or_out_of_reach_stays_as_it_is() -> None:
    assert with_fastest_extensions(AORO, (START, GOAL)) == (START, GOAL)
    assert with_fastest_extensions(AORO, way(9.0)) == way(9.0)


def test_above_a_log_the_telescope_is_out_for_a_fast_path_home() -> None:
    high_m, home_m = travel_height_m(AORO.profile), hypot(*AORO.profile.bunk.center_m)
    pose = AORO.pose_above(3.3, 3.0, 0.2, high_m)
    short = pose._replace(ext_m=0.05)
    over = pose.at_height(high_m)
    home = over._replace(r_m=home_m)
    best, worst = (
        float(np.min(full_speed_times(AORO, p, p.at_height(high_m), np.array([p.ext_m]), np.linspace(0.1, 2.0, 9))))
        for p in (pose, short)
    )
    assert pose.ext_m > 0.8 and best < 0.8 * worst
    assert fastest_extension(AORO, pose, over, home) == pytest.approx(pose.ext_m, abs=0.25)
    high = joint_limits(AORO.profile)[Joint.EXT][1]
    assert pose.ext_m <= high - OUTER_RESERVE_M + 1e-9


def test_a_goal_at_a_stop_is_refused_but_a_start_there_is_not() -> None:
    high = joint_limits(AORO.profile)[Joint.EXT][1]
    inside = Pose(0.0, 5.5, 1.0, high - 0.1, 0.0)
    at_stop = inside._replace(ext_m=high)
    for joints in (AORO.joints, AORO.approximate_joints):
        assert joints(np.array([at_stop, inside]))[0, Joint.EXT] == high
        with pytest.raises(Unreachable):
            joints(np.array([inside, at_stop]))


def three_seconds_of_rest() -> Trajectory:
    still = hold((0.1, 0.2, -1.0, 0.5, 0.3))
    return Trajectory([still.position[0]] * 151, [still.velocity[0]] * 151)


def test_a_turn_is_added_to_the_rotator_alone_and_smoothly() -> None:
    motion = three_seconds_of_rest()
    more = with_rotation(AORO, motion, 1.0, 0.2)
    q, v = np.array(more.position), np.array(more.velocity)
    assert np.array_equal(q[:, : Joint.ROT], np.array(motion.position)[:, : Joint.ROT])
    assert np.all(q[:51, Joint.ROT] == 0.3) and q[-1, Joint.ROT] == pytest.approx(0.5)
    assert np.gradient(q[:, Joint.ROT], 0.02)[1:-1] == pytest.approx(v[1:-1, Joint.ROT], abs=2e-3)


@pytest.mark.parametrize(("from_s", "by_rad"), [(2.9, 0.2), (3.0, 0.2), (3.2, 0.01), (2.0, 2.0)])
def test_no_turn_is_added_that_the_rest_of_the_motion_is_too_short_for(from_s: float, by_rad: float) -> None:
    """It would be a jump of the setpoint, which the controller refuses."""
    assert with_rotation(AORO, three_seconds_of_rest(), from_s, by_rad) is None


# -- a column that leans
LOADER = load_profile("palms_471")
LEANING = Arm(msgspec.structs.replace(LOADER, sag=Sag(0.0054, 0.0036, 0.028, 1.2e-6, 4500.0, 3000.0)))


@pytest.mark.parametrize("load_kg", [0.0, 250.0])
def test_with_sag_known_the_true_pin_goes_straight(load_kg: float) -> None:
    arm = LEANING.loaded(load_kg)
    assert arm.load_kg == load_kg and (arm is LEANING) == (load_kg == 0.0)
    start, goal = Pose(0.8, 3.6, 0.6, 0.9, 0.0), Pose(0.8, 5.2, 0.6, 0.9, 0.0)
    motion = straight_line(arm, start, goal)
    q = np.array(motion.position)
    true = np.array([true_pin(arm.profile.sag, LOADER.kinematics, row, load_kg) for row in q])
    assert np.max(np.abs(true[:, 2] - 0.6)) < 1e-4, "as level as the column really holds it"
    assert np.hypot(*true[-1, :2]) == pytest.approx(5.2, abs=1e-5)
    assert arm.pose(q[-1])[:3] == pytest.approx(goal[:3], abs=1e-5)
    lifted = np.array([pin_position(LOADER.kinematics, row)[2] for row in q]) - 0.6
    assert lifted[-1] - lifted[0] > 0.02, "the joints lift it the more, the farther it is out"


# -- a machine that does not stand level
FORWARDER = load_profile("aoro_fc8")
LOW_M = 0.4


@pytest.mark.parametrize("roll_deg", [-10.0, 0.0, 10.0])
@pytest.mark.parametrize("pitch_deg", [-5.0, 8.0])
def test_the_jaws_hang_above_the_place_that_was_asked_for(roll_deg: float, pitch_deg: float) -> None:
    rotation = Rotation.from_euler("zyx", (150.0, pitch_deg, roll_deg), degrees=True).as_matrix()
    arm = Arm(FORWARDER, slope=slope_of(rotation))
    pose = arm.pose_above(3.0, 3.5, LOW_M, LOW_M + 1.0)
    down = rotation.T @ np.array([0.0, 0.0, -1.0])
    below_m = lowest_tip_below_pin_m(FORWARDER.grapple.jaws)
    level = Arm(FORWARDER)
    pin = np.array([*level.xy(pose), pose.z_m])
    tips = pin + down / -down[2] * below_m
    assert tips[:2] == pytest.approx((3.0, 3.5), abs=1e-6) and arm.xy(pose) == pytest.approx((3.0, 3.5), abs=1e-6)
    assert hypot(*(tips - pin)[:2]) == pytest.approx(below_m * hypot(*slope_of(rotation)))
    assert arm.loaded(100.0).slope == arm.slope
