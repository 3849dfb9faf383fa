"""The bridge's types against the definitions that ROS 2's packages publish: hashes, and bytes that others read."""

from __future__ import annotations

from typing import Any

import pytest

from ros2.interfaces import action, builtin, control, diagnostic, graph, sensor
from ros2.interfaces.builtin import UUID, Header, duration_of, nanoseconds, time_of
from ros2.interfaces.trajectory import MultiDOFJointTrajectoryPoint
from ros2.wire.action_server import with_header
from ros2.wire.qos import type_hash
from tests.ros2.goals import goal
from tests.ros2.published_types import ACTION, published

ANNOUNCED = {
    "sensor_msgs/msg/JointState": sensor.JointState,
    "sensor_msgs/msg/CameraInfo": sensor.CameraInfo,
    "sensor_msgs/msg/Image": sensor.Image,
    "tf2_msgs/msg/TFMessage": builtin.TFMessage,
    "diagnostic_msgs/msg/DiagnosticArray": diagnostic.DiagnosticArray,
    "action_msgs/msg/GoalStatusArray": action.GoalStatusArray,
    "rmw_dds_common/msg/ParticipantEntitiesInfo": graph.ParticipantEntitiesInfo,
    "action_msgs/srv/CancelGoal_Request": action.CancelGoalRequest,
    "action_msgs/srv/CancelGoal_Response": action.CancelGoalResponse,
    f"{ACTION}_SendGoal_Request": control.SendGoalRequest,
    f"{ACTION}_SendGoal_Response": control.SendGoalResponse,
    f"{ACTION}_GetResult_Request": control.GetResultRequest,
    f"{ACTION}_GetResult_Response": control.GetResultResponse,
    f"{ACTION}_FeedbackMessage": control.FeedbackMessage,
}
HEADER = Header(time_of(5_000_000_007), "base_link")


@pytest.mark.parametrize("distribution", ["jazzy", "kilted", "lyrical"])
@pytest.mark.parametrize("name", ANNOUNCED)
def test_the_announced_hash_is_that_of_the_published_definition(name: str, distribution: str) -> None:
    ours: Any = ANNOUNCED[name]
    if ours is control.FeedbackMessage and distribution == "jazzy":
        ours = control.FeedbackMessageWithoutIndex
    assert type_hash(ours) == published(distribution).hash_rihs01(name)


def test_a_picture_is_the_bytes_that_rosbags_reads() -> None:
    data = bytes(range(256)) * 3
    sent = sensor.Image(HEADER, 16, 16, "rgb8", 0, 48, data)
    read: Any = published().deserialize_cdr(sent.serialize(), "sensor_msgs/msg/Image")
    assert (read.height, read.width, read.encoding, read.step) == (16, 16, "rgb8", 48)
    assert read.data.tobytes() == data and read.header.stamp.nanosec == 7


def test_joints_are_the_numbers_that_rosbags_reads() -> None:
    sent = sensor.JointState(HEADER, ["slew", "ext"], [0.25, 1.5], [-0.1, 0.0], [])
    read: Any = published().deserialize_cdr(sent.serialize(), "sensor_msgs/msg/JointState")
    assert read.name == ["slew", "ext"] and read.position.tolist() == [0.25, 1.5]
    assert read.velocity.tolist() == [-0.1, 0.0] and len(read.effort) == 0


def test_diagnostics_are_the_text_that_rosbags_reads() -> None:
    status = diagnostic.DiagnosticStatus(2, "machine", "FAULT", "palms", [diagnostic.KeyValue("mode", "FAULT")])
    sent = diagnostic.DiagnosticArray(HEADER, [status])
    read: Any = published().deserialize_cdr(sent.serialize(), "diagnostic_msgs/msg/DiagnosticArray")
    assert read.status[0].level == 2 and read.status[0].values[0].value == "FAULT"


def test_the_header_of_a_call_is_sixteen_bytes_before_the_request() -> None:
    asked = control.SendGoalRequest(UUID(bytes(range(16))), goal((4.0, (0.5,)), joints=("slew",)))
    call = with_header(control.SendGoalRequest)(7, 9, asked.goal_id, asked.goal)
    wire, plain = call.serialize(), asked.serialize()
    assert wire[:4] == plain[:4]
    assert wire[4:20] == (7).to_bytes(8, "little") + (9).to_bytes(8, "little") and wire[20:] == plain[4:]


def test_the_feedback_for_jazzy_has_no_index() -> None:
    none = MultiDOFJointTrajectoryPoint([], [], [], duration_of(0))
    point = goal((1.0, (0.5,)), joints=("slew",)).trajectory.points[0]
    rest = ([], none, none, none)
    new = control.Feedback(HEADER, ["slew"], point, point, point, 3, *rest, 0).serialize()
    old = control.FeedbackWithoutIndex(HEADER, ["slew"], point, point, point, *rest).serialize()
    assert len(new) == len(old) + 8


@pytest.mark.parametrize("ns", [0, 1, 999_999_999, 1_000_000_000, 1_795_690_741_202_842_462])
def test_a_time_comes_back(ns: int) -> None:
    assert nanoseconds(time_of(ns)) == ns == nanoseconds(duration_of(ns))
