"""The server of one FollowJointTrajectory action on DDS: three services, feedback and status (``rcl_action``).

It answers by the book and leaves the work to its owner: `step` hands out goals to begin and goals to cancel.  A goal is
accepted whenever it can be read, because ROS 2 gives a rejected goal no result: a goal that the owner refuses ends as
ABORTED, and its result says why.

A client that is gone is noticed by two signs.  Its writer disappears: at once when it ends orderly, after its DDS lease
(Cyclone 10 s) when it is killed.  Or feedback is not acknowledged any more: every action client has a reliable reader
of it, and DDS acknowledges for the process as long as it runs.  DDS tells only whether all readers have acknowledged,
so the second sign counts once they did, and one that is gone from an earlier goal delays it until its lease is over.
"""

from __future__ import annotations

import secrets
import types
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Final, Generic, TypeVar

from cyclonedds.core import DDSException
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64

from ros2.interfaces.action import (
    CancelCode,
    CancelGoalRequest,
    CancelGoalResponse,
    GoalInfo,
    GoalStatus,
    GoalStatusArray,
    Status,
)
from ros2.interfaces.builtin import UUID, nanoseconds, time_of
from ros2.interfaces.control import (
    FeedbackMessage,
    FeedbackMessageWithoutIndex,
    GetResultRequest,
    GetResultResponse,
    Goal,
    Result,
    SendGoalRequest,
    SendGoalResponse,
)
from ros2.wire.node import Node, send
from ros2.wire.qos import latched, reliable

# -- A service on DDS as ``rmw_cyclonedds_cpp`` maps it: two topics, and a header before each request and response.
#
# The header is a number of the client and one of the call, which the response returns (``serdata.hpp``,
# ``cdds_request_header_t``).  Fast DDS sends them beside the data instead, so its services are other ones on the
# wire: a client of this server needs ``RMW_IMPLEMENTATION=rmw_cyclonedds_cpp``.


_DEPTH: Final = 10
_64_BITS: Final = (1 << 64) - 1
"""Cyclone's Python binding gives a handle with a sign in one place and without in another."""
MAX_REQUESTS: Final = 16
"""Requests that are taken at a time."""

Request = TypeVar("Request", bound=IdlStruct)
Response = TypeVar("Response", bound=IdlStruct)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who waits for a response: the client and its call, and the handle of the client's writer."""

    client: int
    call: int
    writer: int


def with_header(message: type[IdlStruct]) -> Any:
    """Make the type that travels for ``message``: numbers of the client and of its call, and the message's fields.

    It has the name of the message alone, because ``cdds_request_header_t`` is no part of the type.
    """

    def body(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] |= {"client": uint64, "call": int64} | message.__annotations__

    return dataclass(types.new_class("Call", (IdlStruct,), {"typename": message.__idl_typename__}, body))


def fields_of(message: Any) -> dict[str, Any]:
    """Return the fields of a message by name."""
    return {field.name: getattr(message, field.name) for field in fields(message)}


class ServiceServer(Generic[Request, Response]):
    """The server of ``/name``: hands out requests with their callers, and answers each when its owner is ready to."""

    def __init__(self, node: Node, name: str, request: type[Request], response: type[Response]) -> None:
        identity = f"serviceid={secrets.token_hex(16)};"
        self._request_type, self._reply_type = request, with_header(response)
        self._reader = node.reader(f"rq/{name}Request", with_header(request), reliable(_DEPTH), identity)
        self._writer = node.writer(f"rr/{name}Reply", self._reply_type, reliable(_DEPTH), identity)

    def requests(self) -> Iterator[tuple[Caller, Request]]:
        """Take the requests that arrived since the last call."""
        for sample in self._reader.take(MAX_REQUESTS):
            info = sample.sample_info
            if info.valid_data:
                caller = Caller(sample.client, sample.call, info.publication_handle & _64_BITS)
                yield caller, self._request_type(*list(fields_of(sample).values())[2:])

    def respond(self, caller: Caller, response: Response) -> None:
        """Answer a call; a caller that is gone hears nothing."""
        send(self._writer, self._reply_type(caller.client, caller.call, **fields_of(response)))

    def callers(self) -> set[int]:
        """Return the writers of the clients that are there."""
        return {handle & _64_BITS for handle in self._reader.get_matched_publications()}


# -- The goals of an action server and their statuses, as ``rcl_action`` keeps them.
#
# Pure: identifiers and times in, statuses out.  The results of the last `KEPT` goals are kept for clients that ask
# late.


KEPT: Final = 16
ALL: Final = bytes(16)
"""The identifier that stands for no certain goal."""
ENDED: Final = (Status.SUCCEEDED, Status.CANCELED, Status.ABORTED)
_ACTIVE: Final = (Status.ACCEPTED, Status.EXECUTING)


@dataclass(slots=True)
class GoalRecord:
    """A goal: when it was accepted, the handle of its client's writer, its status, and its result in the end."""

    accepted_ns: int
    client: int
    status: Status = Status.ACCEPTED
    result: Result | None = None


class GoalTable:
    """Goals by identifier, the oldest first."""

    def __init__(self) -> None:
        self._goals: dict[bytes, GoalRecord] = {}

    def accept(self, goal_id: bytes, client: int, wall_ns: int) -> bool:
        """Enter a new goal; False when the identifier is known or stands for none."""
        if goal_id == ALL or goal_id in self._goals:
            return False
        self._goals[goal_id] = GoalRecord(wall_ns, client)
        for old in [name for name, goal in self._goals.items() if goal.status in ENDED][:-KEPT]:
            del self._goals[old]
        return True

    def get(self, goal_id: bytes) -> GoalRecord | None:
        """Return a goal, None when it is unknown."""
        return self._goals.get(goal_id)

    def finish(self, goal_id: bytes, status: Status, result: Result) -> None:
        """End a goal."""
        goal = self._goals[goal_id]
        goal.status, goal.result = status, result

    def cancel(self, asked: GoalInfo) -> tuple[CancelCode, list[bytes]]:
        """Set the goals that a request names to CANCELING (``action_msgs/srv/CancelGoal``): an identifier, a time up to
        which they were accepted, both, or with neither all of them.
        """
        goal_id, until_ns = bytes(asked.goal_id.uuid), nanoseconds(asked.stamp)
        if goal_id != ALL and until_ns == 0:
            goal = self._goals.get(goal_id)
            if goal is None:
                return CancelCode.UNKNOWN_GOAL_ID, []
            if goal.status in ENDED:
                return CancelCode.GOAL_TERMINATED, []
        everything = goal_id == ALL and until_ns == 0
        named = [
            name
            for name, goal in self._goals.items()
            if goal.status in _ACTIVE and (everything or name == goal_id or goal.accepted_ns <= until_ns)
        ]
        for name in named:
            self._goals[name].status = Status.CANCELING
        return (CancelCode.NONE if named else CancelCode.REJECTED), named

    def info(self, goal_id: bytes) -> GoalInfo:
        """Make the message that names a goal."""
        return GoalInfo(UUID(goal_id), time_of(self._goals[goal_id].accepted_ns))

    def statuses(self) -> list[GoalStatus]:
        """List the status of every goal."""
        return [GoalStatus(self.info(name), goal.status) for name, goal in self._goals.items()]


# -- The server of one FollowJointTrajectory action on DDS


SILENCE_NS: Final = 1_000_000_000
"""Feedback that is not acknowledged for so long means that the client is gone."""
_FEEDBACK_DEPTH: Final = 10
_NO_RESULT: Final = Result(0, "")


@dataclass(frozen=True, slots=True)
class NewGoal:
    """A goal to begin."""

    goal_id: bytes
    goal: Goal


class ActionServer:
    """The action ``/name``; ``with_index``: feedback as of control_msgs 6.3 and later."""

    def __init__(self, node: Node, name: str, with_index: bool) -> None:
        action = f"{name}/_action"
        self._send_goal = ServiceServer(node, f"{action}/send_goal", SendGoalRequest, SendGoalResponse)
        self._cancel_goal = ServiceServer(node, f"{action}/cancel_goal", CancelGoalRequest, CancelGoalResponse)
        self._get_result = ServiceServer(node, f"{action}/get_result", GetResultRequest, GetResultResponse)
        kind: Any = FeedbackMessage if with_index else FeedbackMessageWithoutIndex
        self._feedback = node.publisher(f"{action}/feedback", kind, reliable(_FEEDBACK_DEPTH))
        self._status = node.publisher(f"{action}/status", GoalStatusArray, latched(1))
        self._goals = GoalTable()
        self._waiting: dict[bytes, list[Caller]] = {}
        self._told = False
        """Whether feedback of the present goal was sent."""
        self._acknowledged_ns: int | None = None
        """When all readers had that feedback."""

    def step(self, wall_ns: int) -> tuple[list[NewGoal], list[bytes]]:
        """Answer what has arrived; returns the goals to begin and those to cancel."""
        begun, cancelled = [], []
        for caller, goal_request in self._send_goal.requests():
            goal_id = bytes(goal_request.goal_id.uuid)
            accepted = self._goals.accept(goal_id, caller.writer, wall_ns)
            self._send_goal.respond(caller, SendGoalResponse(accepted, time_of(wall_ns)))
            if accepted:
                begun.append(NewGoal(goal_id, goal_request.goal))
        for caller, cancel_request in self._cancel_goal.requests():
            code, named = self._goals.cancel(cancel_request.goal_info)
            self._cancel_goal.respond(caller, CancelGoalResponse(code, [self._goals.info(g) for g in named]))
            cancelled += named
        for caller, result_request in self._get_result.requests():
            self._answer_result(caller, bytes(result_request.goal_id.uuid))
        if begun or cancelled:
            self._publish_status()
        return begun, cancelled

    def executing(self, goal_id: bytes) -> None:
        """Mark a goal as being executed."""
        goal = self._goals.get(goal_id)
        if goal is not None:
            goal.status = Status.EXECUTING
            self._told, self._acknowledged_ns = False, None
            self._publish_status()

    def finish(self, goal_id: bytes, status: Status, result: Result) -> None:
        """End a goal and give its result to those who wait for it."""
        self._goals.finish(goal_id, status, result)
        for caller in self._waiting.pop(goal_id, []):
            self._get_result.respond(caller, GetResultResponse(status, result))
        self._publish_status()

    def publish_feedback(self, message: FeedbackMessage | FeedbackMessageWithoutIndex) -> None:
        """Send the feedback of a goal."""
        self._told = send(self._feedback, message) or self._told

    def client_is_gone(self, goal_id: bytes, now_ns: int) -> bool:
        """Tell whether the client of a goal is gone, as in the module docstring; call it between two feedbacks."""
        goal = self._goals.get(goal_id)
        if goal is None or goal.client not in self._send_goal.callers():
            return True
        if self._told and self._all_acknowledged():
            self._acknowledged_ns = now_ns
        return self._acknowledged_ns is not None and now_ns - self._acknowledged_ns > SILENCE_NS

    def _all_acknowledged(self) -> bool:
        """Tell whether every reliable reader has what was sent.

        Not ``DataWriter.wait_for_acks``: in release 11.0.1 it fails with an AttributeError when the time is up.
        """
        code = int(self._feedback._wait_for_acks(self._feedback._ref, 0))
        if code not in (0, DDSException.DDS_RETCODE_TIMEOUT):
            raise DDSException(code, "while looking for the acknowledgement of feedback")
        return code == 0

    def _answer_result(self, caller: Caller, goal_id: bytes) -> None:
        goal = self._goals.get(goal_id)
        if goal is None:
            self._get_result.respond(caller, GetResultResponse(Status.UNKNOWN, _NO_RESULT))
        elif goal.status in ENDED and goal.result is not None:
            self._get_result.respond(caller, GetResultResponse(goal.status, goal.result))
        else:
            self._waiting.setdefault(goal_id, []).append(caller)

    def _publish_status(self) -> None:
        send(self._status, GoalStatusArray(self._goals.statuses()))
