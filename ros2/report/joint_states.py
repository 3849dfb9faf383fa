"""``/joint_states``: the measured joints, by the names of the profile."""

from __future__ import annotations

from math import isfinite

from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS
from ros2.interfaces.builtin import Header, time_of
from ros2.interfaces.sensor import JointState


def joint_state(report: StateReport, stamp_ns: int) -> JointState:
    """The joints of a report with known positions; ``stamp_ns`` is the report's time since the epoch."""
    known = [j for j in JOINTS if isfinite(report.position[j]) and isfinite(report.velocity[j])]
    return JointState(
        Header(time_of(stamp_ns), ""),
        [j.name.lower() for j in known],
        [report.position[j] for j in known],
        [report.velocity[j] for j in known],
        [],
    )
