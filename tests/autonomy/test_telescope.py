"""The telescope does what the boom need not: ways with it are shorter, stay in reach and keep from the stops."""

from __future__ import annotations

from itertools import pairwise
from math import hypot

import numpy as np
import pytest

from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion.arm_kinematics import (
    OUTER_RESERVE_M,
    STOP_MARGIN,
    Arm,
    Pose,
    fastest_extension,
    full_speed_times,
    with_fastest_extensions,
)
from autonomy.motion.trajectory import Trajectory, hold, with_rotation
from machine.geometry.kinematics import Unreachable
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import joint_limits

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


def test_a_turn_is_added_to_the_rotator_alone_and_smoothly() -> None:
    still = hold((0.1, 0.2, -1.0, 0.5, 0.3))
    motion = Trajectory([still.position[0]] * 151, [still.velocity[0]] * 151)
    more = with_rotation(AORO, motion, 1.0, 0.2)
    assert more is not None
    q, v = np.array(more.position), np.array(more.velocity)
    assert np.array_equal(q[:, : Joint.ROT], np.array(motion.position)[:, : Joint.ROT])
    assert np.all(q[:51, Joint.ROT] == 0.3) and q[-1, Joint.ROT] == pytest.approx(0.5)
    assert np.gradient(q[:, Joint.ROT], 0.02)[1:-1] == pytest.approx(v[1:-1, Joint.ROT], abs=2e-3)


@pytest.mark.parametrize(("from_s", "by_rad"), [(2.9, 0.2), (3.0, 0.2), (3.2, 0.01), (2.0, 2.0)])
def test_no_turn_is_added_that_the_rest_of_the_motion_is_too_short_for(from_s: float, by_rad: float) -> None:
    """It would be a jump of the setpoint, which the controller refuses."""
    still = hold((0.1, 0.2, -1.0, 0.5, 0.3))
    motion = Trajectory([still.position[0]] * 151, [still.velocity[0]] * 151)
    assert with_rotation(AORO, motion, from_s, by_rad) is None
