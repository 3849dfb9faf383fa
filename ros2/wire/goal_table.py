"""The goals of an action server and their statuses, as ``rcl_action`` keeps them.

Pure: identifiers and times in, statuses out.  The results of the last `KEPT` goals are kept for clients that ask late.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ros2.interfaces.action import CancelCode, GoalInfo, GoalStatus, Status
from ros2.interfaces.builtin import UUID, nanoseconds, time_of
from ros2.interfaces.control import Result

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
        """A goal, None when it is unknown."""
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
        """The message that names a goal."""
        return GoalInfo(UUID(goal_id), time_of(self._goals[goal_id].accepted_ns))

    def statuses(self) -> list[GoalStatus]:
        """The status of every goal."""
        return [GoalStatus(self.info(name), goal.status) for name, goal in self._goals.items()]
