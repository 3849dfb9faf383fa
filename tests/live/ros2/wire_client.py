"""A client of the bridge's wire in a process of its own: nothing of the bridge, types as published, own mangling.

``python -m tests.live.ros2.wire_client DOMAIN COMMAND``: ``listen`` prints a message of each topic; ``go SLEW SECONDS
[cancel|die]`` sends a goal for the slew and prints answer, number of feedbacks, and result; with ``cancel`` or ``die``
it cancels the goal, or kills itself, after two seconds of motion.  JSON lines on stdout.
"""

from __future__ import annotations

import json
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from tests.ros2.published_types import ACTION, IdlTypes, published

WAIT_S = 30.0
CONFIGURATION = (
    '<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
RELIABLE = Policy.Reliability.Reliable(100_000_000)
DEFAULT = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10))
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))
NAME = "crane_controller/follow_joint_trajectory/_action"
TOPICS = {
    "rt/joint_states": ("sensor_msgs/msg/JointState", DEFAULT),
    "rt/tf": ("tf2_msgs/msg/TFMessage", DEFAULT),
    "rt/tf_static": ("tf2_msgs/msg/TFMessage", LATCHED),
    "rt/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", DEFAULT),
    "ros_discovery_info": ("rmw_dds_common/msg/ParticipantEntitiesInfo", LATCHED),
}
CAMERA_TOPICS = {
    "rt/d435/image_rect_color": ("sensor_msgs/msg/Image", SENSOR),
    "rt/d435/depth/image_rect": ("sensor_msgs/msg/Image", SENSOR),
    "rt/d435/camera_info": ("sensor_msgs/msg/CameraInfo", SENSOR),
}


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


def plain(value: Any) -> Any:
    """Structures as dictionaries; long sequences of bytes by their length and sum."""
    if hasattr(value, "__idl__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, bytes | bytearray) or (isinstance(value, list) and len(value) > 1000):
        return [len(value), sum(value)] if len(value) > 16 else bytes(value).hex()
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value


class Wire:
    """A participant of the domain."""

    def __init__(self, domain: int) -> None:
        self._domain = Domain(domain, CONFIGURATION)
        self.participant = DomainParticipant(domain)
        self.types = IdlTypes(published())

    def reader(self, topic: str, name: str, qos: Qos, call: bool = False) -> DataReader:
        made = Topic(self.participant, topic, self.types.get(name, call))
        return DataReader(self.participant, made, qos=qos)

    def writer(self, topic: str, name: str, call: bool = False) -> DataWriter:
        made = Topic(self.participant, topic, self.types.get(name, call))
        xcdr1 = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
        return DataWriter(self.participant, made, qos=Qos(xcdr1, base=DEFAULT))


def wait(for_what: Callable[[], Any], seconds: float = WAIT_S) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := for_what():
            return found
        time.sleep(0.01)
    raise TimeoutError("nothing came")


class Service:
    """A client of one service, as ``rmw_cyclonedds_cpp`` maps it."""

    def __init__(self, wire: Wire, service: str, request: str, response: str) -> None:
        self._type = wire.types.get(request, True)
        self._writer = wire.writer(f"rq/{NAME}/{service}Request", request, True)
        self._reader = wire.reader(f"rr/{NAME}/{service}Reply", response, DEFAULT, True)
        self._guid, self._seq = secrets.randbits(63), 0

    def matched(self) -> bool:
        return bool(self._writer.get_matched_subscriptions() and self._reader.get_matched_publications())

    def send(self, *fields: Any) -> None:
        self._seq += 1
        self._writer.write(self._type(self._guid, self._seq, *fields))

    def answer(self) -> Any:
        ours = [a for a in self._reader.take(10) if (a.client, a.call) == (self._guid, self._seq)]
        return ours[0] if ours else None


def listen(wire: Wire, topics: dict[str, tuple[str, Qos]]) -> None:
    readers = {topic: wire.reader(topic, *spec) for topic, spec in topics.items()}
    for topic, reader in readers.items():
        message = wait(lambda reader=reader: next(iter(reader.take(1)), None))
        say(topic=topic, now_s=time.time(), message=plain(message))


def go(wire: Wire, slew: float, seconds: float, ending: str) -> None:
    get = wire.types.get
    send_goal = Service(wire, "send_goal", f"{ACTION}_SendGoal_Request", f"{ACTION}_SendGoal_Response")
    cancel = Service(wire, "cancel_goal", "action_msgs/srv/CancelGoal_Request", "action_msgs/srv/CancelGoal_Response")
    result = Service(wire, "get_result", f"{ACTION}_GetResult_Request", f"{ACTION}_GetResult_Response")
    feedback = wire.reader(f"rt/{NAME}/feedback", f"{ACTION}_FeedbackMessage", DEFAULT)
    status = wire.reader(f"rt/{NAME}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
    services = (send_goal, cancel, result)
    wait(lambda: all(s.matched() for s in services) and feedback.get_matched_publications())
    time_type, duration = get("builtin_interfaces/msg/Time"), get("builtin_interfaces/msg/Duration")
    header = get("std_msgs/msg/Header")(time_type(0, 0), "")
    point = get("trajectory_msgs/msg/JointTrajectoryPoint")([slew], [], [], [], duration(int(seconds), 0))
    trajectory = get("trajectory_msgs/msg/JointTrajectory")(header, ["slew"], [point])
    none = get("trajectory_msgs/msg/MultiDOFJointTrajectory")(header, [], [])
    goal = get(f"{ACTION}_Goal")(trajectory, none, [], [], [], [], duration(0, 0))
    goal_id = get("unique_identifier_msgs/msg/UUID")(secrets.token_bytes(16))
    send_goal.send(goal_id, goal)
    say(accepted=wait(send_goal.answer).accepted)
    result.send(goal_id)
    begun, heard, statuses, done = time.monotonic(), [], [], None
    while done is None and time.monotonic() < begun + seconds + WAIT_S:
        heard += feedback.take(10)
        statuses += [s.status for array in status.take(10) for s in array.status_list[-1:]]
        done = result.answer()
        if ending and time.monotonic() > begun + 2.0:
            if ending == "die":
                say(dead_s=time.monotonic(), feedbacks=len(heard))
                os.kill(os.getpid(), signal.SIGKILL)
            cancel.send(get("action_msgs/msg/GoalInfo")(goal_id, time_type(0, 0)))
            answer = wait(cancel.answer)
            say(cancelled=answer.return_code, goals=len(answer.goals_canceling))
            ending = ""
        time.sleep(0.01)
    assert done is not None, "no result came"
    statuses += [s.status for array in status.take(10) for s in array.status_list[-1:]]
    last = plain(heard[-1].feedback) if heard else None
    say(
        status=done.status,
        code=done.result.error_code,
        text=done.result.error_string,
        feedbacks=len(heard),
        last=last,
        statuses=statuses,
    )


def main() -> None:
    wire = Wire(int(sys.argv[1]))
    match sys.argv[2:]:
        case ["listen"]:
            listen(wire, TOPICS)
        case ["look"]:
            listen(wire, CAMERA_TOPICS)
        case ["go", slew, seconds, *ending]:
            go(wire, float(slew), float(seconds), ending[0] if ending else "")


if __name__ == "__main__":
    main()
