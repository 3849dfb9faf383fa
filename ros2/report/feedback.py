"""The feedback of a goal: where the crane shall be now, where it is, and the difference."""

from __future__ import annotations

from collections.abc import Sequence

from ros2.execution.execution import Progress
from ros2.interfaces.builtin import NS_PER_S, UUID, Header, duration_of, time_of
from ros2.interfaces.control import (
    Feedback,
    FeedbackMessage,
    FeedbackMessageWithoutIndex,
    FeedbackWithoutIndex,
)
from ros2.interfaces.trajectory import JointTrajectoryPoint, MultiDOFJointTrajectoryPoint


def feedback_message(
    goal_id: bytes, progress: Progress, with_index: bool, stamp_ns: int
) -> FeedbackMessage | FeedbackMessageWithoutIndex:
    """The message of a goal's progress; ``with_index`` as of control_msgs 6.3 and later."""
    head = Header(time_of(stamp_ns), "")
    names = [j.name.lower() for j in progress.joints]
    error = (_difference(progress, 0), _difference(progress, 1))
    desired, actual, off = (_point(state, progress.time_s) for state in (progress.desired, progress.actual, error))
    none = MultiDOFJointTrajectoryPoint([], [], [], duration_of(0))
    if with_index:
        feedback = Feedback(head, names, desired, actual, off, progress.point, [], none, none, none, 0)
        return FeedbackMessage(UUID(goal_id), feedback)
    plain = FeedbackWithoutIndex(head, names, desired, actual, off, [], none, none, none)
    return FeedbackMessageWithoutIndex(UUID(goal_id), plain)


def _difference(progress: Progress, derivative: int) -> tuple[float, ...]:
    pairs = zip(progress.desired[derivative], progress.actual[derivative], strict=True)
    return tuple(wanted - found for wanted, found in pairs)


def _point(state: tuple[Sequence[float], Sequence[float]], time_s: float) -> JointTrajectoryPoint:
    position, velocity = state
    return JointTrajectoryPoint(list(position), list(velocity), [], [], duration_of(round(time_s * NS_PER_S)))
