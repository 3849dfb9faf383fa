"""The goals of the action server: identifiers, statuses, and what a cancel request means."""

from __future__ import annotations

import pytest

from ros2.interfaces.action import CancelCode, GoalInfo, Status
from ros2.interfaces.builtin import UUID, time_of
from ros2.interfaces.control import Result
from ros2.wire.action_server import ALL, KEPT, GoalTable

A, B, C = (bytes([i]) * 16 for i in (1, 2, 3))
DONE = Result(0, "done")


def table() -> GoalTable:
    """A has ended, B and C are executed; accepted at 1, 2 and 3 s."""
    made = GoalTable()
    for i, goal_id in enumerate((A, B, C)):
        assert made.accept(goal_id, 0, (i + 1) * 10**9)
    made.finish(A, Status.SUCCEEDED, DONE)
    return made


def asked(goal_id: bytes, until_s: int) -> GoalInfo:
    return GoalInfo(UUID(goal_id), time_of(until_s * 10**9))


@pytest.mark.parametrize(
    ("request_", "code", "named"),
    [
        (asked(B, 0), CancelCode.NONE, [B]),
        (asked(A, 0), CancelCode.GOAL_TERMINATED, []),
        (asked(bytes([9]) * 16, 0), CancelCode.UNKNOWN_GOAL_ID, []),
        (asked(ALL, 0), CancelCode.NONE, [B, C]),
        (asked(ALL, 2), CancelCode.NONE, [B]),
        (asked(C, 2), CancelCode.NONE, [B, C]),
        (asked(ALL, 1), CancelCode.REJECTED, []),
    ],
)
def test_what_a_cancel_request_names(request_: GoalInfo, code: CancelCode, named: list[bytes]) -> None:
    made = table()
    assert made.cancel(request_) == (code, named)
    for goal_id in named:
        goal = made.get(goal_id)
        assert goal is not None and goal.status is Status.CANCELING


def test_an_identifier_is_accepted_once() -> None:
    made = table()
    assert not made.accept(A, 0, 9) and not made.accept(ALL, 0, 9)


def test_the_last_results_are_kept() -> None:
    made = GoalTable()
    for i in range(1, KEPT + 5):
        goal_id = i.to_bytes(16, "little")
        assert made.accept(goal_id, 0, i)
        made.finish(goal_id, Status.ABORTED, DONE)
    first = made.get((1).to_bytes(16, "little"))
    last = made.get((KEPT + 4).to_bytes(16, "little"))
    assert first is None and last is not None and last.result is DONE
    assert len(made.statuses()) <= KEPT + 1
