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

from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.core import DDSException

from ros2.interfaces.action import CancelGoalRequest, CancelGoalResponse, GoalStatusArray, Status
from ros2.interfaces.builtin import time_of
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
from ros2.wire.goal_table import ENDED, GoalTable
from ros2.wire.node import Node, send
from ros2.wire.qos import latched, reliable
from ros2.wire.service import Caller, ServiceServer

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
        for caller, asked in self._send_goal.requests():
            goal_id = bytes(asked.goal_id.uuid)
            accepted = self._goals.accept(goal_id, caller.writer, wall_ns)
            self._send_goal.respond(caller, SendGoalResponse(accepted, time_of(wall_ns)))
            if accepted:
                begun.append(NewGoal(goal_id, asked.goal))
        for caller, request in self._cancel_goal.requests():
            code, named = self._goals.cancel(request.goal_info)
            self._cancel_goal.respond(caller, CancelGoalResponse(code, [self._goals.info(g) for g in named]))
            cancelled += named
        for caller, wanted in self._get_result.requests():
            self._answer_result(caller, bytes(wanted.goal_id.uuid))
        if begun or cancelled:
            self._publish_status()
        return begun, cancelled

    def executing(self, goal_id: bytes) -> None:
        """A goal is being executed."""
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
        """Whether the client of a goal is gone, as in the module docstring; call it between two feedbacks."""
        goal = self._goals.get(goal_id)
        if goal is None or goal.client not in self._send_goal.callers():
            return True
        if self._told and self._all_acknowledged():
            self._acknowledged_ns = now_ns
        return self._acknowledged_ns is not None and now_ns - self._acknowledged_ns > SILENCE_NS

    def _all_acknowledged(self) -> bool:
        """Whether every reliable reader has what was sent.

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
