"""The bridge between the controller's datagrams and a ROS 2 node.

What the machine reports goes out as topics.  A goal comes in as an action, and leaves as setpoints that the gate of the
controller checks like those of any planner.  The bridge arms nothing, and it sends setpoints only for a goal.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import nan
from typing import Final

from autonomy.process.controller_link import ControllerLink
from can_dbc.messages.crane import StateReport
from machine.profile import Profile
from machine.status.reasons import Reason
from ros2.execution.execution import Outcome, TrajectoryExecution
from ros2.execution.goal_motion import GoalRefused
from ros2.interfaces.action import Status
from ros2.interfaces.builtin import TFMessage
from ros2.interfaces.control import ErrorCode, Result
from ros2.interfaces.diagnostic import DiagnosticArray
from ros2.interfaces.sensor import JointState
from ros2.report import SILENT_NS, diagnostics, feedback_message, joint_state, moving_transforms, static_transforms
from ros2.wire.action_server import ActionServer, NewGoal
from ros2.wire.node import Node, send
from ros2.wire.qos import latched, reliable

ACTION: Final = "crane_controller/follow_joint_trajectory"
"""Named as ros2_control's joint trajectory controller names it: ``/controller/follow_joint_trajectory``."""
POLL_S: Final = 0.01
FEEDBACK_NS: Final = 100_000_000
DIAGNOSTICS_NS: Final = 1_000_000_000
_TF_DEPTH: Final = 100
"""As of ``tf2_ros``."""
GONE: Final = Outcome(Status.ABORTED, Reason.LEASE_LOST, "the client of the goal is gone; the crane holds")
ENDED: Final = Outcome(Status.ABORTED, Reason.LEASE_LOST, "the bridge is ended; the crane holds")

Emit = Callable[..., None]


class Bridge:
    """One machine as a ROS 2 node; without ``execution`` it only publishes.

    ``emit`` is told of every goal and how it ended.
    """

    def __init__(
        self,
        profile: Profile,
        link: ControllerLink,
        node: Node,
        execution: TrajectoryExecution | None,
        with_index: bool,
        emit: Emit,
    ) -> None:
        self._node = node  # its endpoints end with it
        self._profile, self._link, self._execution, self._emit = profile, link, execution, emit
        self._joint_states = node.publisher("joint_states", JointState, reliable(10))
        self._tf = node.publisher("tf", TFMessage, reliable(_TF_DEPTH))
        self._tf_static = node.publisher("tf_static", TFMessage, latched(1))
        self._diagnostics = node.publisher("diagnostics", DiagnosticArray, reliable(10))
        self._server = None if execution is None else ActionServer(node, ACTION, with_index)
        self._with_index = with_index
        node.announce()
        send(self._tf_static, static_transforms(profile, time.time_ns()))
        self._goal_id = b""
        self._report: StateReport | None = None
        self._report_ns = self._feedback_ns = self._diagnostics_ns = 0
        self._refused = ""
        self._shown: tuple[int, int] | None = None

    @property
    def busy(self) -> bool:
        """Whether a goal is being executed."""
        return self._execution is not None and self._execution.busy

    def stop(self) -> None:
        """Slow down to a hold; the bridge is about to end."""
        if self._execution is not None:
            self._execution.end(ENDED)

    def step(self, now_ns: int, wall_ns: int) -> None:
        """Do one step: reports out, goals in, setpoints out.  ``wall_ns`` is the time since the epoch."""
        report = self._link.newest()
        if report is not None:
            self._report, self._report_ns = report, now_ns
            self._publish_report(report, report.stamp_ns + wall_ns - now_ns)
        self._publish_diagnostics(now_ns, wall_ns)
        if self._server is not None and self._execution is not None:
            self._serve(self._server, self._execution, report, now_ns, wall_ns)

    def _serve(
        self,
        server: ActionServer,
        execution: TrajectoryExecution,
        report: StateReport | None,
        now_ns: int,
        wall_ns: int,
    ) -> None:
        begun, cancelled = server.step(wall_ns)
        for new in begun:
            self._begin(server, execution, new, now_ns, wall_ns)
        if self._goal_id in cancelled:
            execution.end(Outcome(Status.CANCELED, ErrorCode.SUCCESSFUL, "the goal was cancelled; the crane holds"))
        if execution.busy and now_ns - self._feedback_ns >= FEEDBACK_NS:
            if server.client_is_gone(self._goal_id, now_ns):
                execution.end(GONE)
            self._feedback_ns = now_ns
            progress = execution.progress()
            if progress is not None:
                server.publish_feedback(feedback_message(self._goal_id, progress, self._with_index, wall_ns))
        setpoint, outcome = execution.step(now_ns, report)
        if setpoint is not None:
            self._link.send(setpoint)
        if outcome is not None:
            self._finish(server, self._goal_id, outcome)

    def _begin(
        self, server: ActionServer, execution: TrajectoryExecution, new: NewGoal, now_ns: int, wall_ns: int
    ) -> None:
        try:
            execution.begin(new.goal, now_ns, wall_ns)
        except GoalRefused as refused:
            self._refused = f"{refused} [{refused.code}]"
            self._finish(server, new.goal_id, Outcome(Status.ABORTED, refused.error_code, self._refused))
            return
        self._goal_id, self._feedback_ns = new.goal_id, now_ns
        server.executing(new.goal_id)
        self._emit("goal", id=new.goal_id.hex(), points=len(new.goal.trajectory.points))

    def _finish(self, server: ActionServer, goal_id: bytes, outcome: Outcome) -> None:
        server.finish(goal_id, outcome.status, Result(outcome.error_code, outcome.sentence))
        self._emit(
            "ended", id=goal_id.hex(), status=outcome.status.name, error=outcome.error_code, reason=outcome.sentence
        )

    def _publish_report(self, report: StateReport, stamp_ns: int) -> None:
        vehicle = self._link.vehicle
        send(self._joint_states, joint_state(report, stamp_ns))
        articulation_rad = nan if vehicle is None else vehicle.articulation_rad
        send(self._tf, moving_transforms(self._profile, report.position, articulation_rad, stamp_ns))

    def _publish_diagnostics(self, now_ns: int, wall_ns: int) -> None:
        """Publish diagnostics once a second, and at once when mode or reason change."""
        report = self._report if now_ns - self._report_ns < SILENT_NS else None
        shown = None if report is None else (report.mode, report.reason)
        if shown == self._shown and now_ns - self._diagnostics_ns < DIAGNOSTICS_NS:
            return
        self._shown, self._diagnostics_ns = shown, now_ns
        send(self._diagnostics, diagnostics(self._profile.name, report, self._refused, wall_ns))


def run(bridge: Bridge, link: ControllerLink, signals: list[int]) -> None:
    """Run until a signal arrives and the crane holds, or the controller turns out to have another profile."""
    while not link.foreign:
        if signals:
            if not bridge.busy:
                return
            bridge.stop()
        link.wait(POLL_S)
        bridge.step(time.monotonic_ns(), time.time_ns())
