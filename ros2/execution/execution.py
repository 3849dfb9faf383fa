"""The execution of one goal after the other: setpoints with a lease, as every planner sends them.

The crane follows the goal's motion on a clock that waits for joints that fall behind
(`autonomy.crane_job.trajectory_tracker`).  A goal that is cancelled, or whose client is gone, ends in a smooth stop on
its path, and then in a hold.  Once the crane holds no setpoint is sent: the last one said that it is final, so the end
of its lease is no fault.  When the controller stops, or refuses, the goal ends with the controller's reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import Final

from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.trajectory_tracker import TrajectoryTracker
from autonomy.motion.setpoint_stream import HORIZON_KNOT_COUNT, PERIOD_NS, Motion, SetpointStream
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, StateReport
from controller.crane.reference_governor import Trajectory
from controller.crane.trajectory_check import MAX_KNOTS_CHECKED, TrajectoryCheck, WorkspaceCheck
from controller.laws.grapple import GrappleState
from controller.requests import REFUSED_LIMIT_COUNT, RequestRefused
from machine.joints import JOINTS, N_JOINTS, Joint
from machine.profile import Profile, joint
from machine.status.explanation import describe, sentence_of
from machine.status.modes import Mode
from machine.status.reasons import Reason, known
from ros2.execution.goal_motion import GoalMotion, GoalRefused, Tolerances, beyond, goal_motion, tolerances_of, unit_of
from ros2.interfaces.action import Status
from ros2.interfaces.builtin import NS_PER_S, nanoseconds
from ros2.interfaces.control import ErrorCode, Goal

# -- A goal's motion before it begins: the checks that the controller's gate makes of its setpoints, over all of it.
#
# The gate remains the judge: it checks every setpoint again when it comes.  Here a goal that it would refuse half
# way is refused before the crane moves.  Accelerations the gate does not check; here they must be within the
# profile's.


ROUNDING_SHARE: Final = 1.0 + 1e-6
_UNKNOWN: Final = (nan,) * N_JOINTS
_KNOTS: Final = min(HORIZON_KNOT_COUNT, MAX_KNOTS_CHECKED)
"""Knots of a window: few enough that the check of the workspace looks at each."""


class MotionCheck:
    """Checks motions against one profile."""

    def __init__(self, profile: Profile) -> None:
        self._trajectory, self._workspace = TrajectoryCheck(profile), WorkspaceCheck(profile)
        self._candidate = Trajectory()
        self._acceleration = [joint(profile, j).acceleration_limit for j in JOINTS]

    def check(self, asked: GoalMotion) -> None:
        """Check a motion from its start to its end.

        Raises:
            GoalRefused: the gate would refuse a setpoint of it, or it accelerates more than a joint can.
        """
        self._check_setpoints(asked.trajectory)
        for j, limit in zip(JOINTS, self._acceleration, strict=True):
            if asked.accelerations[j] > limit * ROUNDING_SHARE:
                raise GoalRefused(
                    "ros2.goal-acceleration",
                    f"the goal accelerates {j.name.lower()} by {asked.accelerations[j]:.2f} {unit_of(j)}/s^2 and "
                    f"{limit:.2f} are allowed; give it more time",
                    ErrorCode.INVALID_GOAL,
                )

    def _check_setpoints(self, motion: Motion) -> None:
        """Check the setpoints of a motion, one window after the other; raise GoalRefused."""
        self._workspace.forget()
        window_s = _KNOTS * PERIOD_NS * 1e-9
        for window in range(int(motion.duration_s / window_s) + 1):
            begin_s = window * window_s
            try:
                self._check_window(motion, begin_s)
            except RequestRefused as refused:
                raise GoalRefused(
                    "ros2.goal-limits",
                    f"{sentence_of(refused.reason, refused.detail)}, {begin_s:.1f} to {begin_s + window_s:.1f} s after "
                    "the start; change the goal",
                    ErrorCode.INVALID_GOAL,
                ) from None

    def _check_window(self, motion: Motion, begin_s: float) -> None:
        """Check the setpoint of the window that begins at ``begin_s``; raise RequestRefused."""
        knots = tuple(Knot(i * PERIOD_NS, *motion.at(begin_s + i * PERIOD_NS * 1e-9)) for i in range(_KNOTS + 1))
        final = begin_s + _KNOTS * PERIOD_NS * 1e-9 >= motion.duration_s
        setpoint = CraneSetpoint(0, 0, 0, 0, GrappleCommand.NEUTRAL, final, knots)
        self._trajectory.load_and_check(setpoint, self._candidate, _UNKNOWN, _UNKNOWN, 0)
        self._workspace.check(knots[0].position, knots)


# -- The execution of one goal after the other


HOLD_NS: Final = 500_000_000
"""Time for which the hold at the end is sent."""
MAX_AGE_NS: Final = 100_000_000
"""Greatest age of a goal's stamp: the message was under way."""
MAX_WAIT_NS: Final = 10_000_000_000
"""A goal may be stamped this far ahead."""
_GRIPS: Final = (GrappleState.CLOSED, GrappleState.HOLDING)

Axes = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a goal ended: its status, the error code of its result, and a sentence."""

    status: Status
    error_code: int
    sentence: str


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a goal is: seconds on its motion, the number of the point ahead, and joints in the goal's order."""

    time_s: float
    point: int
    joints: tuple[Joint, ...]
    desired: tuple[Axes, Axes]
    """Positions and velocities."""
    actual: tuple[Axes, Axes]


@dataclass(slots=True)
class _Run:
    """The goal that is executed; ``ending`` is its outcome once the crane slows down or holds."""

    motion: GoalMotion
    tolerances: Tolerances
    start_ns: int
    refused_before: int
    late_ns: int | None = None
    """When the crane must have arrived."""
    ending: Outcome | None = None
    held_ns: int | None = None
    """Since when it holds."""


class TrajectoryExecution:
    """Executes goals on one machine; a second goal is refused while there is one."""

    def __init__(self, profile: Profile, stream: SetpointStream) -> None:
        self._profile, self._stream = profile, stream
        self._inbox, self._check = Inbox(profile), MotionCheck(profile)
        self._tracker: TrajectoryTracker | None = None
        self._run: _Run | None = None
        self._before_ns = 0

    @property
    def busy(self) -> bool:
        """Whether a goal is being executed."""
        return self._run is not None

    def begin(self, goal: Goal, now_ns: int, wall_ns: int) -> None:
        """Begin to execute a goal; ``wall_ns`` is the time by which goals are stamped.

        Raises:
            GoalRefused: it is not executed, and the crane does not move.
        """
        if self._run is not None:
            raise GoalRefused(
                "ros2.goal-busy",
                "another goal is being executed; cancel it, or wait for its result",
                ErrorCode.INVALID_GOAL,
            )
        start = self._start(now_ns)
        wait_ns = _wait_ns(goal, wall_ns)
        tolerances = tolerances_of(goal)
        motion = goal_motion(goal, start)
        self._check.check(motion)
        self._tracker = TrajectoryTracker(self._profile, start)
        self._tracker.begin(motion.trajectory)
        self._run = _Run(motion, tolerances, now_ns + wait_ns, self._inbox.report.refused)
        self._before_ns = now_ns

    def end(self, outcome: Outcome) -> None:
        """Slow down to a hold and end the goal with an outcome; nothing without a goal, or when it ends already."""
        if self._run is not None and self._run.ending is None:
            self._run.ending = outcome

    def step(self, now_ns: int, report: StateReport | None) -> tuple[bytes | None, Outcome | None]:
        """Return the setpoint to send now, and the outcome when the goal has ended."""
        self._inbox.accept(now_ns, report, ())
        run, tracker = self._run, self._tracker
        if run is None or tracker is None:
            return None, None
        measured = self._inbox.position(tracker.setpoint)
        if stopped := self._stopped(run, now_ns, tracker.setpoint):
            self._run = None
            return None, stopped
        moving = run.ending is None and now_ns >= run.start_ns
        if tracker.clock_s == 0.0:
            tracker.rate = float(moving)  # it begins at rest, so no ramp is needed
        tracker.advance((now_ns - self._before_ns) * 1e-9, 1.0 if moving else 0.0, measured)
        self._before_ns = now_ns
        self._judge(run, tracker, measured, now_ns)
        if run.held_ns is not None and now_ns - run.held_ns >= HOLD_NS:
            self._run = None
            return None, run.ending
        if not self._stream.due(now_ns):
            return None, None
        grips = self._inbox.report.grapple_state in _GRIPS
        command = GrappleCommand.HOLD if grips else GrappleCommand.NEUTRAL
        return self._stream.datagram(now_ns, tracker.motion, tracker.clock_s, command, tracker.announce()), None

    def progress(self) -> Progress | None:
        """Return where the goal is; None without one."""
        run, tracker = self._run, self._tracker
        if run is None or tracker is None:
            return None
        joints = run.motion.joints
        position, velocity = tracker.motion.at(tracker.clock_s)
        report = self._inbox.report
        return Progress(
            min(tracker.clock_s, tracker.motion.duration_s),
            sum(time_s < tracker.clock_s for time_s in run.motion.times_s[:-1]),
            joints,
            (_of(position, joints), _of([tracker.rate * v for v in velocity], joints)),
            (_of(report.position, joints), _of(report.velocity, joints)),
        )

    def _start(self, now_ns: int) -> Axes:
        """Return where a motion begins: at the reference that the crane follows, else where it is."""
        rest = (0.0,) * len(JOINTS)
        problem = self._inbox.blocked_reason(now_ns, rest)
        if problem is not None:
            raise GoalRefused("ros2.goal-not-ready", f"{problem.sentence}; an operator arms it", Reason.NOT_ARMED)
        report = self._inbox.report
        if report.mode == Mode.ACTIVE and all(map(math.isfinite, report.reference)):
            return report.reference
        # A rotator without an encoder is where the controller has counted it to be.
        return self._inbox.position([p if math.isfinite(p) else 0.0 for p in report.position])

    def _stopped(self, run: _Run, now_ns: int, setpoint: Axes) -> Outcome | None:
        """Return the outcome when the controller executes nothing any more, or refuses what is sent."""
        problem = self._inbox.blocked_reason(now_ns, setpoint)
        report = self._inbox.report
        if problem is not None:
            reason = report.reason & 0xFF
            text = f"{problem.sentence}: {described(report.reason, report.numbers)}" if reason else problem.sentence
            return Outcome(Status.ABORTED, reason or Reason.NOT_ARMED, text)
        strangers = report.refusal == Reason.DATAGRAM_AUTHENTICATION  # whom every process can be
        if (report.refused - run.refused_before) & 0xFFFF >= REFUSED_LIMIT_COUNT and not strangers:
            return Outcome(Status.ABORTED, report.refusal & 0xFF, described(report.refusal))
        return None

    def _judge(self, run: _Run, tracker: TrajectoryTracker, measured: Sequence[float], now_ns: int) -> None:
        """Judge whether the crane leaves its path, has arrived, is too late, or holds."""
        if run.ending is None:
            self._judge_motion(run, tracker, measured, now_ns)
        if run.ending is not None and run.held_ns is None and (tracker.is_stopped or tracker.left_s <= 0.0):
            run.held_ns = now_ns

    @staticmethod
    def _judge_motion(run: _Run, tracker: TrajectoryTracker, measured: Sequence[float], now_ns: int) -> None:
        errors = [w - p for w, p in zip(tracker.setpoint, measured, strict=True)]
        if path_error := _sentence(errors, run.tolerances.path):
            run.ending = Outcome(
                Status.ABORTED, ErrorCode.PATH_TOLERANCE_VIOLATED, f"{path_error} its path; the crane holds"
            )
            return
        if tracker.left_s > 0.0:
            return
        if run.late_ns is None:
            run.late_ns = now_ns + round(min(run.tolerances.time_s, 1e9) * NS_PER_S)
        goal_error = _sentence(errors, run.tolerances.goal)
        if not goal_error:
            run.ending = Outcome(Status.SUCCEEDED, ErrorCode.SUCCESSFUL, "the crane has arrived")
        elif now_ns >= run.late_ns:
            text = f"{goal_error} its goal, {run.tolerances.time_s:.1f} s after the motion's end; the crane holds"
            run.ending = Outcome(Status.ABORTED, ErrorCode.GOAL_TOLERANCE_VIOLATED, text)


def _wait_ns(goal: Goal, wall_ns: int) -> int:
    """Compute the time until the goal's stamp; 0 without one."""
    stamp_ns = nanoseconds(goal.trajectory.header.stamp)
    if stamp_ns == 0:
        return 0
    if stamp_ns < wall_ns - MAX_AGE_NS:
        raise GoalRefused(
            "ros2.goal-old",
            f"the goal's stamp is {(wall_ns - stamp_ns) / NS_PER_S:.1f} s old; stamp it 0 to begin at once",
            ErrorCode.OLD_HEADER_TIMESTAMP,
        )
    if stamp_ns > wall_ns + MAX_WAIT_NS:
        raise GoalRefused(
            "ros2.goal-ahead",
            f"the goal's stamp is {(stamp_ns - wall_ns) / NS_PER_S:.0f} s ahead; do the clocks agree?",
            ErrorCode.INVALID_GOAL,
        )
    return max(0, stamp_ns - wall_ns)


def _sentence(errors: Sequence[float], tolerance: Axes) -> str:
    """Begin a sentence about the joint that is farthest beyond its tolerance; empty when none is."""
    worst_joint = beyond(errors, tolerance)
    if worst_joint is None:
        return ""
    return f"{worst_joint.name.lower()} is {abs(errors[worst_joint]):.3f} {unit_of(worst_joint)} from"


def described(reason: int, numbers: Sequence[float] = ()) -> str:
    """Describe a reason of the controller, also one that this release does not know."""
    if known(reason) is None:
        return f"The controller reports the unknown reason {reason & 0xFF}; run controller and bridge of one release."
    return describe(reason, numbers=numbers)


def _of(values: Sequence[float], joints: tuple[Joint, ...]) -> Axes:
    return tuple(values[j] for j in joints)
