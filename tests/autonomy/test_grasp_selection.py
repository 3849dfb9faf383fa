"""Grasp and place from a log's pose: where, how turned, how high; and one clear sentence when it is impossible."""

from __future__ import annotations

import random
from dataclasses import replace
from math import atan2, cos, pi, remainder, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.grasp.bunk_load import BELOW_STAKE_TOP_M, lies_in_bunk, plan_place
from autonomy.grasp.grapple_heights import closing_height_curve, hover_height_m, travel_height_m
from autonomy.grasp.planner import BunkFull, hangs_below
from autonomy.grasp.selection import NoGrasp, plan_single_log_grasp, select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import half_gap_m, lowest_tip_below_pin_m, tip_below_pin_m
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import GROUND_LOG, log_ends, over_bunk
from tests.codes import coded

PROFILE = load_profile("palms_471")
ARM = Arm(PROFILE)
JAWS = PROFILE.grapple.jaws
GROUND = PROFILE.workspace.ground_z_m
BUNK = PROFILE.bunk
GRASP = plan_single_log_grasp(ARM, GROUND_LOG, 0.0)


def log_at(x: float, y: float, yaw: float = 0.7, number: int = 0, diameter: float = 0.2) -> LogObservation:
    return LogObservation(number, (x, y, GROUND + diameter / 2), (cos(yaw), sin(yaw), 0.0), 2.6, diameter)


def in_bunk(number: int, top_z_m: float) -> LogObservation:
    axis = (cos(BUNK.yaw_rad), sin(BUNK.yaw_rad), 0.0)
    return LogObservation(number, (*BUNK.center_m, top_z_m - 0.1), axis, 2.6, 0.2)


def layer(top_z_m: float) -> list[LogObservation]:
    """Logs side by side from stake to stake, so close that none rolls in between, so far over the top of the stakes."""
    log = in_bunk(0, BUNK.floor_z_m + BUNK.stake_height_m + top_z_m)
    places = [k * 0.05 for k in range(-20, 21) if abs(k * 0.05) <= BUNK.width_m / 2]
    c, s = cos(BUNK.yaw_rad), sin(BUNK.yaw_rad)
    x, y, z = log.center_m
    return [replace(log, id=k, center_m=(x - s * a, y + c * a, z)) for k, a in enumerate(places, 1)]


def random_logs(n: int) -> list[LogObservation]:
    rng = random.Random("logs")
    (cx, cy), half = PROFILE.workspace.pick_center_m, PROFILE.workspace.pick_half_size_m
    out = []
    for _ in range(n):
        x, y = cx + rng.uniform(-half, half), cy + rng.uniform(-half, half)
        log = log_at(x, y, rng.uniform(-pi, pi), 0, rng.uniform(0.1, 0.3))
        out.append(replace(log, length_m=rng.uniform(2.5, 2.8)))
    return out


@pytest.mark.parametrize("log", random_logs(200), ids=range(200))
def test_every_log_of_the_pick_area_has_a_grasp_and_a_place(log: LogObservation) -> None:
    grasp = plan_single_log_grasp(ARM, log, 0.0)
    assert grasp.along_m == 0.0 and grasp.support_z_m == pytest.approx(GROUND)
    assert ARM.xy(grasp.pose) == pytest.approx(log.center_m[:2])
    opening = grasp.pose.slew_rad + grasp.pose.rot_rad
    assert abs(remainder(opening - atan2(log.axis[1], log.axis[0]), pi)) == pytest.approx(pi / 2)
    place = plan_place(ARM, CraneJob(), grasp, [log])
    assert ARM.xy(place) == pytest.approx(BUNK.center_m)
    assert remainder(place.slew_rad + place.rot_rad - BUNK.yaw_rad - pi / 2, pi) == pytest.approx(0.0)
    assert abs(place.rot_rad - grasp.pose.rot_rad) <= pi / 2 + 1e-9
    for pose in (grasp.pose, place):
        ARM.joints(np.array([pose, pose.at_height(travel_height_m(PROFILE))]))  # raises when out of reach
    assert hover_height_m(PROFILE, grasp) - tip_below_pin_m(JAWS, 0.0) > GROUND + log.diameter_m + 0.1


@settings(max_examples=50, deadline=None)
@given(st.floats(0.97, 1.03), st.floats(0.1, 0.3), st.floats(0.05, 0.15))
def test_the_tips_sweep_between_the_ground_and_the_middle_of_the_log(pace, diameter, delay_s) -> None:
    height = closing_height_curve(PROFILE, GROUND, diameter)
    rate = JAWS.angle_rad[-1] / PROFILE.grapple.close_time_s
    tips = []
    for t in np.arange(0.0, 3.5, 0.01):
        angle = min(rate * pace * t, JAWS.angle_rad[-1])
        z = height(max(t - delay_s, 0.0)) - tip_below_pin_m(JAWS, angle) - GROUND
        tips.append((half_gap_m(JAWS, angle), z))
    assert tips[0][1] < 0.2
    assert min(tip for gap, tip in tips if gap > diameter / 2) > 0.012
    assert max(tip for gap, tip in tips if 0.3 * diameter < gap < 0.5 * diameter) < 0.45 * diameter


def test_the_closing_height_starts_at_rest_and_is_smooth() -> None:
    height = closing_height_curve(PROFILE, GROUND, 0.2)
    z = np.array([height(t) for t in np.arange(0.0, 3.5, 0.02)])
    speed = np.gradient(z, 0.02)
    assert abs(speed[0]) < 0.02 and np.max(np.abs(speed)) < 0.2
    assert np.max(np.abs(np.gradient(speed, 0.02))) < 1.0


def test_a_log_on_others_is_gripped_at_its_own_height() -> None:
    high = replace(GROUND_LOG, center_m=(-1.8, 4.4, -0.9))
    assert plan_single_log_grasp(ARM, high, 0.0).pose.z_m - GRASP.pose.z_m == pytest.approx(0.39)


def test_a_log_whose_centre_is_just_out_of_reach_is_gripped_off_its_centre() -> None:
    grasps = (plan_single_log_grasp(ARM, log_at(0.0, float(r), pi / 2), 0.0) for r in np.arange(6.2, 7.2, 0.05))
    grasp = next(grasp for grasp in grasps if grasp.along_m != 0.0)
    far = grasp.log
    assert grasp.along_m < 0.0 and ARM.xy(grasp.pose)[1] < far.center_m[1] - 0.05
    place = plan_place(ARM, CraneJob(), grasp, [])
    for point in log_ends(laid(grasp.log, grasp.pose, place)):
        assert over_bunk(PROFILE, point, 0.001)


def laid(log: LogObservation, grasp: Pose, place: Pose) -> LogObservation:
    """The log after it went rigidly with the grapple from one pose to the other."""
    (gx, gy), (px, py) = ARM.xy(grasp), ARM.xy(place)
    turn = place.slew_rad + place.rot_rad - grasp.slew_rad - grasp.rot_rad
    x, y = log.center_m[0] - gx, log.center_m[1] - gy
    c, s = cos(turn), sin(turn)
    axis = (c * log.axis[0] - s * log.axis[1], s * log.axis[0] + c * log.axis[1], 0.0)
    return replace(log, center_m=(px + c * x - s * y, py + s * x + c * y, -0.9), axis=axis)


@pytest.mark.parametrize(
    ("log", "code", "value"),
    [
        (log_at(-6.0, 6.0), "grasp.log-out-of-reach", "log 0"),
        (log_at(0.5, -4.0), "grasp.log-out-of-reach", "slew"),
        (replace(GROUND_LOG, axis=(0.0, 0.6, 0.8)), "grasp.log-too-steep", "53 deg"),
        (replace(log_at(0.0, 6.0), length_m=5.0, diameter_m=0.45), "grasp.too-heavy", "log 0 may weigh 503 kg"),
    ],
)
def test_an_impossible_log_gives_one_error(log: LogObservation, code: str, value: str) -> None:
    with pytest.raises(NoGrasp, check=lambda error: error.code == code and value in str(error)):
        select_direct(ARM, CraneJob(), [log], 0.0, 0.0)


def test_the_top_log_comes_first_then_the_nearest_and_never_one_in_the_bunk() -> None:
    near, far = log_at(0.0, 4.5, number=1), log_at(-2.5, 4.5, number=2)
    top = replace(log_at(-2.0, 4.0, number=3), center_m=(-2.0, 4.0, -0.9))
    loaded = in_bunk(4, -0.8)
    assert select_direct(ARM, CraneJob(), [far, near, loaded], 0.0, 0.0).log.id == 1
    assert select_direct(ARM, CraneJob(), [near, far, top, loaded], 0.0, 0.0).log.id == 3
    assert select_direct(ARM, CraneJob(log_id=2), [near, far, top], 0.0, 0.0).log.id == 2
    with pytest.raises(NoGrasp, check=coded("grasp.job-log-not-in-view")):
        select_direct(ARM, CraneJob(log_id=9), [near], 0.0, 0.0)
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-outside-bunk")):
        select_direct(ARM, CraneJob(), [loaded], 0.0, 0.0)
    unreachable = log_at(-6.0, 6.0, number=5)
    assert select_direct(ARM, CraneJob(), [unreachable, near], 0.0, 0.0).log.id == 1


def test_a_place_is_above_what_is_in_the_bunk_until_the_bunk_is_full() -> None:
    deepest = lowest_tip_below_pin_m(JAWS)
    empty = plan_place(ARM, CraneJob(), GRASP, [GROUND_LOG])
    assert 0.04 < empty.z_m - deepest - BUNK.floor_z_m < 0.1
    half = plan_place(ARM, CraneJob(), GRASP, layer(-0.5))
    assert half.z_m - empty.z_m == pytest.approx(0.5)
    top_m, radius_m = BUNK.floor_z_m + BUNK.stake_height_m, GROUND_LOG.diameter_m / 2
    last = plan_place(ARM, CraneJob(), GRASP, layer(-BELOW_STAKE_TOP_M - radius_m - 0.01))
    assert last.z_m - deepest + radius_m < top_m + 0.03, "its middle comes to lie below the top of the stakes"
    with pytest.raises(BunkFull, check=coded("grasp.bunk-full")):
        plan_place(ARM, CraneJob(), GRASP, layer(-BELOW_STAKE_TOP_M - radius_m + 0.01))
    heaped = plan_place(ARM, CraneJob(), GRASP, layer(0.1), knows_load=False)
    assert heaped.z_m > last.z_m + 0.1, "on top of the load, as high as that is"


def test_a_job_may_name_the_place() -> None:
    assert ARM.xy(plan_place(ARM, CraneJob(place_m=(3.2, 1.0)), GRASP, [])) == pytest.approx((3.2, 1.0))
    with pytest.raises(NoGrasp, check=coded("grasp.place-out-of-reach")):
        plan_place(ARM, CraneJob(place_m=(9.0, 1.0)), GRASP, [])


def test_lying_in_the_bunk_and_hanging_from_the_grapple() -> None:
    assert lies_in_bunk(BUNK, in_bunk(0, -0.8)) and not lies_in_bunk(BUNK, in_bunk(0, 0.4))
    assert not lies_in_bunk(BUNK, GROUND_LOG)
    up = GRASP.pose.at_height(travel_height_m(PROFILE))
    assert not hangs_below(ARM, GROUND_LOG, up)
    assert hangs_below(ARM, replace(GROUND_LOG, center_m=(-1.7, 4.5, up.z_m - 1.1)), up)
    assert not hangs_below(ARM, replace(GROUND_LOG, center_m=(1.0, 4.5, up.z_m - 1.1)), up)


HELD_YAW = 0.9


def hanging(skew: float) -> LogObservation:
    """The log so far askew between the jaws."""
    yaw = HELD_YAW - pi / 2 + skew
    return replace(GROUND_LOG, axis=(cos(yaw), sin(yaw), 0.0))


@pytest.mark.parametrize("skew", [-0.5, 0.0, 0.4])
def test_a_log_that_hangs_askew_is_turned_along_the_bunk(skew):
    place = plan_place(ARM, CraneJob(), GRASP, [hanging(skew)], HELD_YAW)
    laid = skew - pi / 2 + place.slew_rad + place.rot_rad
    assert remainder(laid - BUNK.yaw_rad, pi) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("stands", "turn"), [(-0.2, 0.0), (2.3, pi), (1.2, pi), (0.8, 0.0)])
def test_of_two_turns_it_makes_the_shorter_one_from_where_the_rotator_stands(stands: float, turn: float) -> None:
    """The grasp's angle may be nearer to the other one, half a turn away: a thin log would not follow so far."""
    first, second = (plan_place(ARM, CraneJob(), GRASP, [hanging(0.6)], HELD_YAW, at) for at in (-0.6, stands))
    assert first.rot_rad == pytest.approx(-0.6, abs=0.01)
    assert second.rot_rad - first.rot_rad == pytest.approx(turn, abs=1e-6)
