"""Goals of FollowJointTrajectory for tests, and reports of the machine that executes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS
from machine.status.modes import Mode
from ros2.interfaces.builtin import Header, duration_of, time_of
from ros2.interfaces.control import Goal, JointTolerance
from ros2.interfaces.trajectory import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory
from tests.autonomy.crane_stand_in import QUIET

START = (0.0, 0.75, -1.6, 0.3, 0.0)
NAMES = tuple(j.name.lower() for j in JOINTS)


def goal(
    *points: tuple[float, Sequence[float]],
    joints: Sequence[str] = NAMES,
    velocities: Sequence[Sequence[float]] = (),
    stamp_ns: int = 0,
    path: dict[str, float] | None = None,
    final: dict[str, float] | None = None,
    time_tolerance_s: float = 0.0,
) -> Goal:
    """A goal of points (time [s], positions); tolerances by joint."""
    made = [
        JointTrajectoryPoint(
            list(positions), list(velocities[i]) if velocities else [], [], [], duration_of(round(time_s * 1e9))
        )
        for i, (time_s, positions) in enumerate(points)
    ]
    none = MultiDOFJointTrajectory(Header(time_of(0), ""), [], [])
    tolerances = [
        [JointTolerance(name, value, 0.0, 0.0) for name, value in (given or {}).items()] for given in (path, final)
    ]
    trajectory = JointTrajectory(Header(time_of(stamp_ns), ""), list(joints), made)
    late = duration_of(round(time_tolerance_s * 1e9))
    return Goal(trajectory, none, tolerances[0], [], tolerances[1], [], late)


def report(mode: Mode = Mode.ARMED, **changes: Any) -> StateReport:
    """Of a crane that stands at the start."""
    return replace(QUIET, **{"mode": mode, "position": START, "reference": START} | changes)
