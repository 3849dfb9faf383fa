"""``action_msgs``: what all actions share."""

from dataclasses import dataclass
from enum import IntEnum

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int8, sequence

from ros2.interfaces.builtin import UUID, Time


class Status(IntEnum):
    """The status of a goal (``action_msgs/msg/GoalStatus``)."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class CancelCode(IntEnum):
    """The return code of a cancel request (``action_msgs/srv/CancelGoal``)."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


@dataclass
class GoalInfo(IdlStruct, typename="action_msgs::msg::dds_::GoalInfo_"):
    """A goal and the time of its acceptance."""

    goal_id: UUID
    stamp: Time


@dataclass
class GoalStatus(IdlStruct, typename="action_msgs::msg::dds_::GoalStatus_"):
    """A goal and its `Status`."""

    goal_info: GoalInfo
    status: int8


@dataclass
class GoalStatusArray(IdlStruct, typename="action_msgs::msg::dds_::GoalStatusArray_"):
    """The goals of a server."""

    status_list: sequence[GoalStatus]


@dataclass
class CancelGoalRequest(IdlStruct, typename="action_msgs::srv::dds_::CancelGoal_Request_"):
    """Which goals to cancel: this one, those accepted up to a time, or with neither all."""

    goal_info: GoalInfo


@dataclass
class CancelGoalResponse(IdlStruct, typename="action_msgs::srv::dds_::CancelGoal_Response_"):
    """A `CancelCode`, and the goals that are being cancelled."""

    return_code: int8
    goals_canceling: sequence[GoalInfo]
