"""The whole cycle on a crane that follows exactly: the log ends in the bunk, and nothing is hit during the motion."""

from __future__ import annotations

import random
from dataclasses import replace
from math import atan2, cos, hypot, nan, pi, remainder, sin

import msgspec
import numpy as np
import pytest

from autonomy.crane_job.activity import Phase
from autonomy.crane_job.phase_motions import corrected_grasp
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand
from can_dbc.messages.datagrams import decode
from machine.geometry.sag import true_pin
from machine.joints import JOINTS, Joint
from machine.profile import Sag, joint
from tests.autonomy.crane_stand_in import CYCLE, GROUND_LOG, TICK_NS, StandIn, activity, clearances
from tests.autonomy.grasp_scenes import ARM, PROFILE


def random_log(seed: int) -> LogObservation:
    rng = random.Random(f"scene {seed}")
    (cx, cy), half = PROFILE.workspace.pick_center_m, PROFILE.workspace.pick_half_size_m
    x, y = cx + rng.uniform(-half, half), cy + rng.uniform(-half, half)
    diameter, yaw = rng.uniform(0.1, 0.3), rng.uniform(-pi, pi)
    z = PROFILE.workspace.ground_z_m + diameter / 2
    return LogObservation(0, (x, y, z), (cos(yaw), sin(yaw), 0.0), rng.uniform(2.5, 2.8), diameter)


def test_a_column_that_leans_under_the_log_is_known_where_the_log_is_laid_down() -> None:
    sag = Sag(0.0054, 0.0036, 0.028, 2.0e-6, 4500.0, 3000.0)
    profile = msgspec.structs.replace(PROFILE, sag=sag)
    crane = StandIn(profile, [GROUND_LOG], log_kg=260.0)
    planner = activity(profile=profile)
    crane.run(planner)
    assert planner.done and planner.failure is None and planner.missed == 0
    assert lies_in_bunk(profile.bunk, crane.logs[0])
    last = {m.phase: m for m in crane.trace}
    assert last["DESCEND"].pin[2] == pytest.approx(planner.grasp.pose.z_m, abs=1e-3)
    lowered, place = last["LOWER"], planner.place
    assert lowered.pin[2] == pytest.approx(place.z_m, abs=1e-3)
    assert hypot(*lowered.pin[:2]) == pytest.approx(place.r_m, abs=1e-3)
    assert true_pin(sag, profile.kinematics, lowered.q)[2] > place.z_m + 0.03, "planned for the load, not without it"


@pytest.mark.parametrize("load_kg", [nan, -3.0, 1e5])
def test_an_implausible_load_is_not_planned_for(load_kg: float) -> None:
    profile = msgspec.structs.replace(PROFILE, sag=Sag(0.0054, 0.0036, 0.028, 2.0e-6))
    crane = StandIn(profile, [GROUND_LOG], log_kg=load_kg)
    planner = activity(profile=profile)
    crane.run(planner)
    assert planner.done and planner.failure is None


RIGID_TONG_NEAR_STAKES = 35
"""A log for which the predicted swing alone would keep the tong clear of the stakes."""


@pytest.mark.parametrize(
    "seed",
    [
        *range(12),
        RIGID_TONG_NEAR_STAKES,
        *(pytest.param(k, marks=pytest.mark.long) for k in range(12, 40) if k != RIGID_TONG_NEAR_STAKES),
    ],
)
def test_a_random_log_goes_from_the_ground_into_the_bunk(seed: int) -> None:
    crane, planner = StandIn(PROFILE, [random_log(seed)]), activity()
    seconds = crane.run(planner)
    assert planner.done and planner.failure is None and planner.missed == 0
    assert crane.phases() == CYCLE and 15.0 < seconds < 30.0
    assert lies_in_bunk(PROFILE.bunk, crane.logs[0])
    least = clearances(PROFILE, crane.trace[::2])
    assert least["tip"] > 0.005 and least["log"] > 0.0
    assert least["tips_in_stakes"] > 0.15 and least["stakes"] > 0.08 and least["base"] > 1.5
    q = np.array([m.q for m in crane.trace])
    velocity = np.diff(q, axis=0) / (TICK_NS * 1e-9)
    acceleration = np.diff(velocity, axis=0) / (TICK_NS * 1e-9)
    for j in JOINTS:
        assert np.max(np.abs(velocity[:, j])) < joint(PROFILE, j).speed_limit
        assert np.max(np.abs(acceleration[:, j])) < 1.2 * joint(PROFILE, j).acceleration_limit


@pytest.mark.parametrize("seed", range(6))
def test_separate_motions_lead_there_too(seed: int) -> None:
    crane, planner = StandIn(PROFILE, [random_log(seed)]), activity(direct=False)
    crane.run(planner)
    assert planner.done and crane.phases() == CYCLE and lies_in_bunk(PROFILE.bunk, crane.logs[0])
    heights = {m.phase: m.pin[2] for m in crane.trace}
    assert heights["LIFT"] == pytest.approx(heights["CLOSE"] + VERIFY_LIFT_M, abs=0.08), "it stands there to be judged"
    least = clearances(PROFILE, crane.trace[::2])
    assert least["tip"] > 0.005 and least["stakes"] > 0.08


def test_with_another_log_in_view_the_crane_stays_in_the_bunk_and_continues_from_there() -> None:
    other = replace(GROUND_LOG, id=1, center_m=(1.5, 4.8, GROUND_LOG.center_m[2]))
    crane = StandIn(PROFILE, [GROUND_LOG, other])
    wanted: list[int] = []

    def onward(log: LogObservation) -> bool:
        wanted.append(log.id)
        return not lies_in_bunk(PROFILE.bunk, log)

    first, second = (activity(fetches_next=onward) for _ in range(2))
    first_s = crane.run(first)
    assert first.done and "RETREAT" not in crane.phases()
    assert first.place is not None and crane.pin()[2] == pytest.approx(first.place.z_m, abs=0.02)
    assert first.grasp is not None and first.grasp.log.id not in wanted, "what was laid down is not asked about"
    begin = len(crane.trace)
    crane.run(second)
    assert second.done and crane.phases()[-2:] == ["RETREAT", "DONE"] and first_s < 30.0
    assert all(lies_in_bunk(PROFILE.bunk, log) for log in crane.logs)
    least = clearances(PROFILE, crane.trace[begin::2])
    assert least["tip"] > 0.005 and least["stakes"] > 0.08


def test_a_log_that_hangs_askew_is_turned_during_the_motion() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.LIFT)
    crane._psi += 0.15  # it slipped while it was gripped
    crane.run(planner)
    assert planner.done and crane.phases().count("CARRY") == 1
    yaw = atan2(crane.logs[0].axis[1], crane.logs[0].axis[0])
    assert abs(remainder(yaw - PROFILE.bunk.yaw_rad, pi)) < 0.02
    rate = np.abs(np.diff([m.q[Joint.SLEW] for m in crane.trace if m.phase in ("LIFT", "CARRY")]))
    moving = np.flatnonzero(rate > 1e-4)
    assert np.all(np.diff(moving) == 1), "without a stop"


def test_nothing_is_released_in_the_air_while_a_joint_lags() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CARRY)
    stuck = crane.q[Joint.SLEW]
    for _ in range(60):
        assert crane.misreport(planner, position=(stuck, *crane.q[1:])).grapple is GrappleCommand.HOLD


def test_without_grapple_feedback_time_alone_decides() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG], feedback=False), activity()
    crane.run(planner)
    assert planner.done and crane.phases() == CYCLE


def test_datagrams_come_every_50_ms_however_often_it_is_called() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    sent = []
    for n in range(400):
        now_ns = crane.now_ns + n * 5_000_000
        data = planner.step(now_ns, crane.report_with(stamp_ns=now_ns), crane.seen() if n % 50 == 0 else ())
        if data is not None:
            sent.append((now_ns, decode(data)))
    times = [now_ns for now_ns, _ in sent]
    assert set(np.diff(times).tolist()) == {50_000_000}
    assert all(isinstance(m, CraneSetpoint) and m.stamp_ns == now_ns for now_ns, m in sent)


def test_a_log_that_lies_a_little_elsewhere_is_gripped_there() -> None:
    """As where the machine leans towards the crane that reaches out."""
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.ABOVE, more_s=1.0)
    x, y, z = GROUND_LOG.center_m
    crane.logs[0] = replace(GROUND_LOG, center_m=(x + 0.03, y - 0.05, z + 0.04))
    crane.until(planner, Phase.CLOSE)
    above = crane.trace[-1].pin
    assert hypot(above[0] - x - 0.03, above[1] - y + 0.05) < 0.005
    crane.run(planner)
    assert planner.done


GRASP = plan_single_log_grasp(ARM, GROUND_LOG, 0.0)


@pytest.mark.parametrize(
    ("moved_m", "why"),
    [((0.01, 0.0, 0.01), "the tongs forgive it"), ((0.25, 0.2, 0.0), "another log"), ((0.0, 0.0, -0.9), "another log")],
)
def test_other_changes_of_a_log_leave_the_aim(moved_m: tuple[float, float, float], why: str) -> None:
    seen = replace(GROUND_LOG, center_m=tuple(c + d for c, d in zip(GROUND_LOG.center_m, moved_m, strict=True)))
    assert corrected_grasp(ARM, GRASP, [seen]) is GRASP, why
    assert corrected_grasp(ARM, GRASP, []) is GRASP


def test_nothing_is_aimed_at_below_the_ground() -> None:
    x, y, z = GROUND_LOG.center_m
    lower = corrected_grasp(ARM, GRASP, [replace(GROUND_LOG, center_m=(x, y, z - 0.2))])
    assert lower.support_z_m == pytest.approx(PROFILE.workspace.ground_z_m)
    assert lower.pose.z_m == pytest.approx(GRASP.pose.z_m + lower.support_z_m - GRASP.support_z_m)


def test_a_log_on_the_ground_that_is_measured_higher_is_gripped_where_it_lies() -> None:
    x, y, z = GROUND_LOG.center_m
    grasp = replace(GRASP, support_z_m=PROFILE.workspace.ground_z_m)
    higher = corrected_grasp(ARM, grasp, [replace(GROUND_LOG, center_m=(x + 0.03, y, z + 0.1))])
    assert higher.support_z_m == grasp.support_z_m and higher.pose.z_m == pytest.approx(grasp.pose.z_m)
    assert higher.log.center_m[0] == x + 0.03, "beside it, it is corrected"
    stacked = replace(grasp, support_z_m=PROFILE.workspace.ground_z_m + 0.2)
    assert corrected_grasp(ARM, stacked, [higher.log]).support_z_m == pytest.approx(stacked.support_z_m + 0.1)


def test_a_log_at_its_place_is_released_at_once() -> None:
    profile = msgspec.structs.replace(PROFILE, sag=Sag(0.0054, 0.0036, 0.028, 2.0e-6))
    crane = StandIn(profile, [GROUND_LOG], log_kg=90.0)
    planner = activity(profile=profile)
    crane.until(planner, Phase.CARRY, more_s=1.0)
    crane.log_kg = 70.0  # it swings, and weighs less for the moment in which the scale is asked
    crane.run(planner)
    lowers_s = sum(moment.phase == "LOWER" for moment in crane.trace) * TICK_NS * 1e-9
    assert planner.done and 0.0 < lowers_s < 0.3


def test_the_pin_waits_for_slow_jaws() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CLOSE)
    heights = []
    for _ in range(40):  # tongs that do not close yet
        setpoint = crane.misreport(planner, opening_pct=100.0)
        assert setpoint.grapple is GrappleCommand.CLOSE
        heights.append(setpoint.knots[0].position[Joint.LIFT])
    assert heights[-1] == pytest.approx(heights[-5], abs=5e-4)
    crane.run(planner)
    assert planner.done


def test_planning_twice_from_the_same_inputs_gives_the_same_bytes() -> None:
    runs = []
    for _ in range(2):
        crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
        runs.append([crane.step(planner) for _ in range(250)])
    assert runs[0] == runs[1] and None not in runs[0]
