"""The chosen grasp of a crane job as it is shown to a person."""

from __future__ import annotations

from math import cos, sin
from typing import Final, Protocol

from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from can_dbc.messages.mission import MAX_GRASP_LOGS, MAX_REASON_CHARS, ChosenGrasp
from machine.geometry.grapple import grapple_yaw
from machine.profile import Profile

SHOWN_PHASES: Final = (Phase.ABOVE, Phase.DESCEND, Phase.CLOSE)
"""From the choice until the jaws have closed; afterwards the logs are no longer where the grasp was planned."""


class CraneJobState(Protocol):
    """`autonomy.crane_job.activity.Activity`."""

    phase: Phase

    @property
    def profile(self) -> Profile: ...

    @property
    def grasp(self) -> Grasp | None: ...


def chosen_grasp(activity: CraneJobState | None) -> ChosenGrasp | None:
    """The grasp of a crane job, None without one or when it is over; of None no crane job runs."""
    if activity is None or activity.grasp is None or activity.phase not in SHOWN_PHASES:
        return None
    profile, grasp, pose = activity.profile, activity.grasp, activity.grasp.pose
    theta = pose.slew_rad + profile.kinematics.theta1_offset_rad
    x_m, y_m, z_m = (round(float(v), 4) for v in (pose.r_m * cos(theta), pose.r_m * sin(theta), pose.z_m))
    return ChosenGrasp(
        1,
        (x_m, y_m, z_m),
        round(float(grapple_yaw(profile, (pose.slew_rad, 0.0, 0.0, pose.ext_m, pose.rot_rad))), 4),
        tuple(log.id for log in grasp.logs[:MAX_GRASP_LOGS]),
        grasp.reason[:MAX_REASON_CHARS],
    )
