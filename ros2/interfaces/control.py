"""``control_msgs/action/FollowJointTrajectory``, and the messages that rosidl makes of an action.

The feedback has an index of the trajectory's point since control_msgs 6.3 (2025), and none in those of Jazzy.
"""

from dataclasses import dataclass
from enum import IntEnum

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int8, int32, sequence, uint16

from ros2.interfaces.builtin import UUID, Duration, Header, Time
from ros2.interfaces.trajectory import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)


class ErrorCode(IntEnum):
    """Error codes of a result; the bridge adds the numbers of `machine.status.reasons.Reason`, which are positive."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass
class JointTolerance(IdlStruct, typename="control_msgs::msg::dds_::JointTolerance_"):
    """Tolerances of a joint [rad, m; per s; per s^2]; 0: the server's default, negative: none."""

    name: str
    position: float64
    velocity: float64
    acceleration: float64


@dataclass
class JointComponentTolerance(IdlStruct, typename="control_msgs::msg::dds_::JointComponentTolerance_"):
    """Tolerances of a joint with more than one degree of freedom."""

    joint_name: str
    component: uint16
    position: float64
    velocity: float64
    acceleration: float64


@dataclass
class Goal(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_Goal_"):
    """A trajectory and its tolerances."""

    trajectory: JointTrajectory
    multi_dof_trajectory: MultiDOFJointTrajectory
    path_tolerance: sequence[JointTolerance]
    component_path_tolerance: sequence[JointComponentTolerance]
    goal_tolerance: sequence[JointTolerance]
    component_goal_tolerance: sequence[JointComponentTolerance]
    goal_time_tolerance: Duration


@dataclass
class Result(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_Result_"):
    """An `ErrorCode` and a sentence."""

    error_code: int32
    error_string: str


@dataclass
class Feedback(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_Feedback_"):
    """Desired and measured state now, since control_msgs 6.3."""

    header: Header
    joint_names: sequence[str]
    desired: JointTrajectoryPoint
    actual: JointTrajectoryPoint
    error: JointTrajectoryPoint
    index: int32
    multi_dof_joint_names: sequence[str]
    multi_dof_desired: MultiDOFJointTrajectoryPoint
    multi_dof_actual: MultiDOFJointTrajectoryPoint
    multi_dof_error: MultiDOFJointTrajectoryPoint
    multi_dof_index: int32


@dataclass
class FeedbackWithoutIndex(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_Feedback_"):
    """Desired and measured state now, before control_msgs 6.3."""

    header: Header
    joint_names: sequence[str]
    desired: JointTrajectoryPoint
    actual: JointTrajectoryPoint
    error: JointTrajectoryPoint
    multi_dof_joint_names: sequence[str]
    multi_dof_desired: MultiDOFJointTrajectoryPoint
    multi_dof_actual: MultiDOFJointTrajectoryPoint
    multi_dof_error: MultiDOFJointTrajectoryPoint


@dataclass
class SendGoalRequest(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Request_"):
    """A new goal."""

    goal_id: UUID
    goal: Goal


@dataclass
class SendGoalResponse(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Response_"):
    """Whether the goal is accepted, and when."""

    accepted: bool
    stamp: Time


@dataclass
class GetResultRequest(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_GetResult_Request_"):
    """Which result."""

    goal_id: UUID


@dataclass
class GetResultResponse(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_GetResult_Response_"):
    """The final status and the result."""

    status: int8
    result: Result


@dataclass
class FeedbackMessage(IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_FeedbackMessage_"):
    """The feedback of a goal, since control_msgs 6.3."""

    goal_id: UUID
    feedback: Feedback


@dataclass
class FeedbackMessageWithoutIndex(
    IdlStruct, typename="control_msgs::action::dds_::FollowJointTrajectory_FeedbackMessage_"
):
    """The feedback of a goal, before control_msgs 6.3."""

    goal_id: UUID
    feedback: FeedbackWithoutIndex
