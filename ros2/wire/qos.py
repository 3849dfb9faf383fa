"""Quality of service, as ROS 2's profiles translate to DDS, with what ROS 2 tells in USER_DATA."""

from __future__ import annotations

from typing import Final

from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct

from ros2.interfaces.control import FeedbackMessageWithoutIndex

BLOCKED_NS: Final = 20_000_000
"""Longest time that a write waits for a slow reader; what does not fit then is lost, and the next sample follows."""
_XCDR1: Final = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)


def endpoint_qos(message: type[IdlStruct], profile: Qos, identity: str = "") -> Qos:
    """Return the QoS of a reader or writer of ``message``.

    ``identity`` is ``clientid=...;`` or ``serviceid=...;`` where the endpoint is half of a service.
    """
    return Qos(_XCDR1, Policy.Userdata(f"{identity}typehash={type_hash(message)};".encode()), base=profile)


def reliable(depth: int) -> Qos:
    """Return a reliable and volatile QoS, the default of ROS 2 and of its services."""
    return Qos(Policy.Reliability.Reliable(BLOCKED_NS), Policy.Durability.Volatile, Policy.History.KeepLast(depth))


def latched(depth: int) -> Qos:
    """Return a reliable and transient local QoS: a late reader gets the last ``depth`` samples."""
    return Qos(
        Policy.Reliability.Reliable(BLOCKED_NS),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(depth),
    )


def sensor_data() -> Qos:
    """Return a best-effort QoS, of whose samples only the newest matter: pictures."""
    return Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))


# -- The RIHS01 hash of each type that the bridge announces (REP 2016), as the distributions publish them.
#
# Readers and writers match without it; it appears in ``ros2 topic info --verbose``, and without it other processes
# warn.

_HASHES: Final = {
    "sensor_msgs::msg::dds_::JointState_": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs::msg::dds_::CameraInfo_": "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs::msg::dds_::Image_": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "tf2_msgs::msg::dds_::TFMessage_": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "diagnostic_msgs::msg::dds_::DiagnosticArray_": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "action_msgs::msg::dds_::GoalStatusArray_": "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
    "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_":
        "e725f4a506958c79f95dd693b965722c57b19cd18e7eff984f49561b93dc985d",
    "action_msgs::srv::dds_::CancelGoal_Request_": "3d3c84653c1f96918086887e1dcb236faec88b81a5b14fd4cf4840065bcdf8af",
    "action_msgs::srv::dds_::CancelGoal_Response_": "35e682cf3f510e83c70a82a4aac888496dedee56773bf9d8e5e0aa81f9e1c960",
    "control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Request_":
        "179c93691f1f6d1d115881ff88c3917b7cc6eac2ba4bf56766cc7c4389e19ef1",
    "control_msgs::action::dds_::FollowJointTrajectory_SendGoal_Response_":
        "e6a48ba740ae254500129a877f0b071be8663a115da1a539b74599cc97921fbf",
    "control_msgs::action::dds_::FollowJointTrajectory_GetResult_Request_":
        "ecf7ea8463d3beec7084bca75216d0b01b87b6e1e4e09679bb26093041efcbe9",
    "control_msgs::action::dds_::FollowJointTrajectory_GetResult_Response_":
        "08eefbaa146ce02ba45898d5e99160afd6c4c54a30d159aee0f2ca6035b1580f",
    "control_msgs::action::dds_::FollowJointTrajectory_FeedbackMessage_":
        "95618cc73912d99b9acaa17d2da5e832cb0bfdeede7534fa8ec600feca2a6c4b",
}  # fmt: skip
"""By the type's name on the wire."""
_FEEDBACK_WITHOUT_INDEX: Final = "80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71"


def type_hash(message: type[IdlStruct]) -> str:
    """Return the hash of a type, as in ``RIHS01_...``; raises KeyError for one that the bridge does not announce."""
    if message is FeedbackMessageWithoutIndex:
        return f"RIHS01_{_FEEDBACK_WITHOUT_INDEX}"
    return f"RIHS01_{_HASHES[message.__idl_typename__]}"
