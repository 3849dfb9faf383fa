"""Goals: the motion they ask for, why some are not executed, and the table that the action server keeps of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from autonomy.motion.setpoint_stream import SetpointStream
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import decode
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from ros2.execution.execution import MotionCheck, TrajectoryExecution
from ros2.execution.goal_motion import GoalRefused, beyond, goal_motion, tolerances_of
from ros2.interfaces.action import CancelCode, GoalInfo, Status
from ros2.interfaces.builtin import UUID, time_of
from ros2.interfaces.control import ErrorCode, Goal, Result
from ros2.wire.action_server import ALL, KEPT, GoalTable
from tests.codes import coded
from tests.ros2.goals import START, goal, report

PROFILE = load_profile("palms_471")
CHECK = MotionCheck(PROFILE)


def refused(code: str, error_code: int, asked: Goal) -> None:
    with pytest.raises(GoalRefused, check=coded(code)) as caught:
        CHECK.check(goal_motion(asked, START))
    assert caught.value.error_code == error_code


def test_the_motion_passes_the_points_at_their_times_and_rests_at_both_ends() -> None:
    points = ((3.0, (-0.3, 0.8)), (5.0, (-0.4, 0.85)), (8.0, (-0.2, 0.8)))
    made = goal_motion(goal(*points, joints=("slew", "lift")), START)
    for time_s, (slew, lift) in points:
        assert made.trajectory.at(time_s)[0] == pytest.approx((slew, lift, *START[2:]), abs=1e-9)
    assert made.trajectory.at(0.0) == (START, (0.0,) * 5)
    assert made.trajectory.goal == pytest.approx((-0.2, 0.8, *START[2:])) and made.trajectory.velocity[-1] == (0.0,) * 5
    assert made.joints == (Joint.SLEW, Joint.LIFT)


def test_without_velocities_no_joint_goes_beyond_its_points() -> None:
    made = goal_motion(goal((2.0, (0.1,)), (4.0, (0.11,)), (9.0, (0.5,)), joints=("slew",)), START)
    slew = np.array(made.trajectory.position)[:, Joint.SLEW]
    assert np.all(np.diff(slew) >= -1e-12) and slew.max() <= 0.5 + 1e-12


def test_given_velocities_are_those_at_the_points() -> None:
    asked = goal((3.0, (0.2,)), (6.0, (0.5,)), joints=("slew",), velocities=((0.08,), (0.0,)))
    assert goal_motion(asked, START).trajectory.at(3.0)[1][Joint.SLEW] == pytest.approx(0.08)


def test_a_point_at_time_zero_is_where_the_crane_is() -> None:
    there = (4.0, (0.2, *START[1:]))
    made = goal_motion(goal((0.0, tuple(q + 0.005 for q in START)), there), START)
    assert made.trajectory.at(0.0)[0] == START
    refused("ros2.goal-start", ErrorCode.INVALID_GOAL, goal((0.0, tuple(q + 0.1 for q in START)), there))


@pytest.mark.parametrize(
    ("code", "error_code", "asked"),
    [
        ("ros2.goal-joints", ErrorCode.INVALID_JOINTS, goal((4.0, (0.1,)), joints=("nose",))),
        ("ros2.goal-joints", ErrorCode.INVALID_JOINTS, goal((4.0, (0.1, 0.1)), joints=("slew", "slew"))),
        ("ros2.goal-joints", ErrorCode.INVALID_JOINTS, goal((4.0, ()), joints=())),
        ("ros2.goal-points", ErrorCode.INVALID_GOAL, goal(joints=("slew",))),
        ("ros2.goal-values", ErrorCode.INVALID_GOAL, goal((4.0, (0.1, 0.2)), joints=("slew",))),
        ("ros2.goal-values", ErrorCode.INVALID_GOAL, goal((4.0, (math.nan,)), joints=("slew",))),
        ("ros2.goal-times", ErrorCode.INVALID_GOAL, goal((4.0, (0.1,)), (4.0, (0.2,)), joints=("slew",))),
        ("ros2.goal-times", ErrorCode.INVALID_GOAL, goal((-1.0, (0.1,)), joints=("slew",))),
        ("ros2.goal-times", ErrorCode.INVALID_GOAL, goal((601.0, (0.1,)), joints=("slew",))),
        ("ros2.goal-times", ErrorCode.INVALID_GOAL, goal((0.0, (0.0,)), joints=("slew",))),
        ("ros2.goal-moving", ErrorCode.INVALID_GOAL, goal((4.0, (0.1,)), joints=("slew",), velocities=((0.1,),))),
        ("ros2.goal-limits", ErrorCode.INVALID_GOAL, goal((60.0, (9.0,)), joints=("slew",))),
        ("ros2.goal-limits", ErrorCode.INVALID_GOAL, goal((1.0, (1.0,)), joints=("slew",))),
        ("ros2.goal-limits", ErrorCode.INVALID_GOAL, goal((60.0, (-0.2,)), joints=("lift",))),  # into the ground
        ("ros2.goal-acceleration", ErrorCode.INVALID_GOAL, goal((1.2, (0.15,)), joints=("slew",))),
    ],
)
def test_a_goal_that_is_not_executed_says_why(code: str, error_code: int, asked: Goal) -> None:
    refused(code, error_code, asked)


def test_the_check_sees_the_middle_of_a_long_motion() -> None:
    """Both ends are within the range of the slew, and the way between is not."""
    upper = joint(PROFILE, Joint.SLEW).upper
    wrong = goal((40.0, (upper + 0.2,)), (80.0, (0.1,)), joints=("slew",))
    refused("ros2.goal-limits", ErrorCode.INVALID_GOAL, wrong)
    CHECK.check(goal_motion(goal((40.0, (upper - 0.2,)), (80.0, (0.1,)), joints=("slew",)), START))


def test_several_degrees_of_freedom_are_refused() -> None:
    asked = goal((4.0, (0.1,)), joints=("slew",))
    asked.multi_dof_trajectory.joint_names = ["base"]
    refused("ros2.goal-multi-dof", ErrorCode.INVALID_GOAL, asked)


def test_tolerances_by_joint() -> None:
    asked = goal((4.0, (0.1,)), joints=("slew",), path={"slew": 0.1, "ext": -1.0}, final={"lift": 0.2, "slew": 0.0})
    made = tolerances_of(asked)
    assert made.path[Joint.SLEW] == 0.1 and made.path[Joint.EXT] == math.inf == made.path[Joint.LIFT]
    assert made.goal[Joint.LIFT] == 0.2 and 0.0 < made.goal[Joint.SLEW] < 0.1
    assert beyond((0.11, 9.0, 0.0, 9.0, 0.0), made.path) is Joint.SLEW
    assert beyond((0.09, 9.0, 0.0, 9.0, 0.0), made.path) is None
    with pytest.raises(GoalRefused, check=coded("ros2.goal-tolerance")):
        tolerances_of(goal((4.0, (0.1,)), joints=("slew",), final={"nose": 0.1}))
    asked.path_tolerance[0].velocity = 0.1
    with pytest.raises(GoalRefused, check=coded("ros2.goal-tolerance")):
        tolerances_of(asked)


def execution(*reports: StateReport) -> TrajectoryExecution:
    made = TrajectoryExecution(PROFILE, SetpointStream(profile_hash(PROFILE), 200_000_000))
    for each in reports:
        made.step(0, each)
    return made


SLEW = goal((5.0, (-0.3,)), joints=("slew",))


def test_a_goal_needs_an_armed_machine_that_reports() -> None:
    for made in (execution(), execution(report(Mode.STANDBY)), execution(report(Mode.FAULT))):
        with pytest.raises(GoalRefused, check=coded("ros2.goal-not-ready")) as caught:
            made.begin(SLEW, 0, 0)
        assert caught.value.error_code == Reason.NOT_ARMED and not made.busy


def test_a_second_goal_is_refused() -> None:
    made = execution(report())
    made.begin(SLEW, 0, 0)
    with pytest.raises(GoalRefused, check=coded("ros2.goal-busy")):
        made.begin(SLEW, 0, 0)


def test_stamps_of_goals() -> None:
    now_ns = 1_000_000_000_000
    for stamp_ns, code in ((now_ns - 10**9, "ros2.goal-old"), (now_ns + 60 * 10**9, "ros2.goal-ahead")):
        asked = goal((5.0, (-0.3,)), joints=("slew",), stamp_ns=stamp_ns)
        with pytest.raises(GoalRefused, check=coded(code)) as caught:
            execution(report()).begin(asked, 0, now_ns)
        old = ErrorCode.OLD_HEADER_TIMESTAMP
        assert caught.value.error_code == (old if code == "ros2.goal-old" else ErrorCode.INVALID_GOAL)


def test_a_goal_that_is_stamped_ahead_begins_then() -> None:
    made = execution(report())
    made.begin(goal((5.0, (-0.3,)), joints=("slew",), stamp_ns=2 * 10**9), 0, 10**9)
    for now_ns in range(0, 900_000_001, 20_000_000):
        made.step(now_ns, report())
    waiting = made.progress()
    assert waiting is not None and waiting.time_s == 0.0
    for now_ns in range(900_000_000, 1_500_000_001, 20_000_000):
        made.step(now_ns, report())
    begun = made.progress()
    assert begun is not None and begun.time_s == pytest.approx(0.5, abs=0.03) and begun.joints == (Joint.SLEW,)


@pytest.mark.parametrize(("state", "command"), [(1, "NEUTRAL"), (4, "HOLD"), (5, "HOLD")])
def test_closed_jaws_stay_closed(state: int, command: str) -> None:
    made = execution(report(grapple_state=state))
    made.begin(SLEW, 0, 0)
    setpoint, _ = made.step(0, None)
    assert setpoint is not None
    message: Any = decode(setpoint)
    assert message.grapple.name == command and message.lease_ns == 200_000_000


def test_refused_setpoints_end_the_goal_with_the_gates_reason() -> None:
    made = execution(report(refused=7))
    made.begin(SLEW, 0, 0)
    assert made.step(20_000_000, report(refused=9, refusal=Reason.RAISES_MOMENT))[1] is None
    outcome = made.step(40_000_000, report(refused=10, refusal=Reason.RAISES_MOMENT))[1]
    assert outcome is not None and outcome.error_code == Reason.RAISES_MOMENT and "[RAISES_MOMENT]" in outcome.sentence
    assert not made.busy


def test_strangers_who_send_without_the_key_end_no_goal() -> None:
    made = execution(report(refused=7))
    made.begin(SLEW, 0, 0)
    assert made.step(20_000_000, report(refused=900, refusal=Reason.DATAGRAM_AUTHENTICATION))[1] is None


def test_a_silent_controller_ends_the_goal() -> None:
    made = execution(report())
    made.begin(SLEW, 0, 0)
    outcome = made.step(1_000_000_000, None)[1]
    assert outcome is not None and outcome.error_code == Reason.NOT_ARMED


@pytest.mark.parametrize("last", [report(Mode.STOP, reason=250), report(refused=3, refusal=250)])
def test_a_reason_of_another_release_ends_the_goal_and_not_the_bridge(last: StateReport) -> None:
    made = execution(report())
    made.begin(SLEW, 0, 0)
    outcome = made.step(20_000_000, last)[1]
    assert outcome is not None and outcome.error_code == 250 and "unknown reason 250" in outcome.sentence


# -- the goals of the action server
A, B, C = (bytes([i]) * 16 for i in (1, 2, 3))
DONE = Result(0, "done")


def table() -> GoalTable:
    """A has ended, B and C are executed; accepted at 1, 2 and 3 s."""
    made = GoalTable()
    for i, goal_id in enumerate((A, B, C)):
        assert made.accept(goal_id, 0, (i + 1) * 10**9)
    made.finish(A, Status.SUCCEEDED, DONE)
    return made


def asked(goal_id: bytes, until_s: int) -> GoalInfo:
    return GoalInfo(UUID(goal_id), time_of(until_s * 10**9))


@pytest.mark.parametrize(
    ("request_", "code", "named"),
    [
        (asked(B, 0), CancelCode.NONE, [B]),
        (asked(A, 0), CancelCode.GOAL_TERMINATED, []),
        (asked(bytes([9]) * 16, 0), CancelCode.UNKNOWN_GOAL_ID, []),
        (asked(ALL, 0), CancelCode.NONE, [B, C]),
        (asked(ALL, 2), CancelCode.NONE, [B]),
        (asked(C, 2), CancelCode.NONE, [B, C]),
        (asked(ALL, 1), CancelCode.REJECTED, []),
    ],
)
def test_what_a_cancel_request_names(request_: GoalInfo, code: CancelCode, named: list[bytes]) -> None:
    made = table()
    assert made.cancel(request_) == (code, named)
    for goal_id in named:
        goal = made.get(goal_id)
        assert goal is not None and goal.status is Status.CANCELING


def test_an_identifier_is_accepted_once() -> None:
    made = table()
    assert not made.accept(A, 0, 9) and not made.accept(ALL, 0, 9)


def test_the_last_results_are_kept() -> None:
    made = GoalTable()
    for i in range(1, KEPT + 5):
        goal_id = i.to_bytes(16, "little")
        assert made.accept(goal_id, 0, i)
        made.finish(goal_id, Status.ABORTED, DONE)
    first = made.get((1).to_bytes(16, "little"))
    last = made.get((KEPT + 4).to_bytes(16, "little"))
    assert first is None and last is not None and last.result is DONE
    assert len(made.statuses()) <= KEPT + 1
