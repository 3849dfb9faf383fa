"""Grasp verification by the newest log list: which logs came up, and whether the path planned for them still holds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import dist, hypot
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import is_over_bunk, lies_across_stakes, lies_in_bunk, plan_place
from autonomy.grasp.planner import Grasp, NoGrasp, hangs_below, restricted_to
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import END, START, LogObservation, unpack_covariance
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m
from machine.profile import Bunk

COLUMN_RADIUS_M: Final = 0.15
"""A column or a place farther than this from the intended one is another one."""
MAX_EXTRA_SAG_M: Final = 0.20
"""Where one end of a log hangs lower than assumed by more than this, the path is planned again."""
LOAD_MARGIN_M: Final = 0.15
"""A log in the jaws is measured this near to them, although the jaws hide its middle."""
GHOST_HEIGHT_M: Final = 1.0
"""Open jaws that are lower may stand around a log that lies."""
MIN_CORRECTION_RAD: Final = 0.03
MAX_CORRECTION_RAD: Final = 0.4
"""The rotator corrects the log's direction during the motion between these angles; more asks for a new path."""


def visible_grasped_logs(grasp: Grasp, logs: Sequence[LogObservation]) -> list[LogObservation]:
    """Return the logs of the grasp that are visible now; a hidden log is left out, as its remembered pose is out of
    date.
    """
    grasped_ids = [log.id for log in grasp.logs]
    return [log for log in logs if log.seen and log.id in grasped_ids]


def lifted_part(arm: Arm, grasp: Grasp, seen: Sequence[LogObservation], pins: Iterable[Pose]) -> Grasp | None:
    """Restrict the grasp to the logs that hang below one of the pins, and the hidden ones; None when none is seen to
    hang.
    """
    poses = list(pins)
    held = [log.id for log in seen if any(hangs_below(arm, log, pin) for pin in poses)]
    if not held:
        return None
    hidden = [log.id for log in grasp.logs if log.id not in [o.id for o in seen]]
    return restricted_to(arm, grasp, held + hidden)


def is_between_jaws(arm: Arm, log: LogObservation, pin: Pose, margin_m: float = 0.0) -> bool:
    """Tell whether a log lies on the centre line of closed jaws under a pin: only what they hold can.  A list may
    contain the held log twice when it was measured wrongly during the motion and tracked as another one.

    ``margin_m``: how far beside the jaws, and beyond its ends, it may be measured; never lower, where other logs lie.
    """
    (x, y), c, a = arm.xy(pin), log.center_m, log.axis
    level2 = a[0] ** 2 + a[1] ** 2
    along_m = ((x - c[0]) * a[0] + (y - c[1]) * a[1]) / level2 if level2 > 0.0 else 0.0
    half_m = 0.5 * log.length_m + margin_m
    along_m = min(max(along_m, -half_m), half_m)
    below_m = pin.z_m - c[2] - along_m * a[2]
    aside_m = hypot(c[0] + along_m * a[0] - x, c[1] + along_m * a[1] - y)
    near = aside_m < 0.5 * log.diameter_m + margin_m
    return near and 0.0 < below_m < lowest_tip_below_pin_m(arm.profile.grapple.jaws)


def ghosts(arm: Arm, logs: Iterable[LogObservation], pin: Pose) -> set[int]:
    """Return the numbers of the logs that a camera sees high over the ground between open jaws under a pin: nothing can
    hang there, and the grapple itself may look like a log.
    """
    high_m = arm.profile.workspace.ground_z_m + GHOST_HEIGHT_M
    return {
        log.id
        for log in logs
        if log.covariance is not None and log.center_m[2] > high_m and is_between_jaws(arm, log, pin, LOAD_MARGIN_M)
    }


def is_part_of_load(arm: Arm, load: LogObservation, found: LogObservation, pin: Pose) -> bool:
    """Tell whether a found log is a visible part of the load under the pin: grapple and crane hide the rest of it."""
    return is_between_jaws(arm, _made_whole(arm, load, found, pin), pin, LOAD_MARGIN_M)


def _made_whole(arm: Arm, load: LogObservation, found: LogObservation, pin: Pose) -> LogObservation:
    """Make what is found as long as the load: its end away from the pin is a true end, the other one is hidden."""
    missing_m = load.length_m - found.length_m
    if missing_m <= 0.0:
        return found
    (x, y), c, a = arm.xy(pin), found.center_m, found.axis
    towards = 1.0 if (x - c[0]) * a[0] + (y - c[1]) * a[1] > 0.0 else -1.0
    shift_m = 0.5 * towards * missing_m
    center = (c[0] + shift_m * a[0], c[1] + shift_m * a[1], c[2] + shift_m * a[2])
    return replace(found, center_m=center, length_m=load.length_m)


def with_load_recognized(
    arm: Arm, grasp: Grasp, logs: Sequence[LogObservation], pins: Iterable[Pose]
) -> tuple[Sequence[LogObservation], int]:
    """Return the list with the log that hangs in the jaws under the number of the gripped one, and its number in the
    list.

    A log that was hidden on its way is found again as another one: its track stayed where it was gripped.  Only a part
    of it may be visible, or both its ends as two logs, so its length stays that of the gripped log.  The newest picture
    need not show it: what was found in the air between the jaws cannot be another log while they are there.
    """
    gripped = grasp.log
    if any(log.seen and log.id == gripped.id for log in logs):
        return logs, gripped.id
    known, poses = {log.id for log in grasp.logs}, list(pins)
    for pin in poses:
        parts = [o for o in logs if o.id not in known and is_part_of_load(arm, gripped, o, pin)]
        if parts:
            shown = max(parts, key=lambda part: (part.seen, part.length_m))
            load = replace(_made_whole(arm, gripped, shown, pin), id=gripped.id, seen=True)
            gone = {gripped.id, *(part.id for part in parts)}
            return [load, *(log for log in logs if log.id not in gone)], shown.id
    return logs, gripped.id


def is_at_target(job: CraneJob, target: Bunk, log: LogObservation) -> bool:
    """Tell whether a released log lies where it should: in the target and not across its stakes, or, where a job only
    clears its source, low beside the source, for it may roll.
    """
    if lies_in_bunk(target, log) or job.source is None:
        return lies_in_bunk(target, log) and not lies_across_stakes(target, log)
    return (
        not is_over_bunk(job.source, *log.center_m[:2]) and log.center_m[2] < target.floor_z_m + target.stake_height_m
    )


def corrected_place(
    arm: Arm, job: CraneJob, grasp: Grasp, place: Pose, logs: Sequence[LogObservation], position: Sequence[float]
) -> Pose | None:
    """Return the place with the rotator corrected for how the log is seen to hang; None when a new path is needed.

    ``position``: the measured joints, rad (EXT m).
    """
    visible_log = next((log for log in visible_grasped_logs(grasp, logs) if log.id == grasp.log.id), None)
    if visible_log is None:
        return place
    if 0.5 * visible_log.length_m * (abs(visible_log.axis[2]) - abs(grasp.log.axis[2])) > MAX_EXTRA_SAG_M:
        return None
    try:
        planned_pose = plan_place(arm, job, grasp, logs, grapple_yaw(arm.profile, position), place.rot_rad)
    except NoGrasp:
        return None  # planning the phase again reports why
    turn = abs(planned_pose.rot_rad - place.rot_rad)
    if turn > MAX_CORRECTION_RAD or dist(arm.xy(planned_pose), arm.xy(place)) > COLUMN_RADIUS_M:
        return None
    return place._replace(rot_rad=planned_pose.rot_rad) if turn > MIN_CORRECTION_RAD else place


# -- Recovery from a failed grasp: what closed jaws tell before anything is lifted, and what is tried then.
#
# Jaws that stall too wide open clasp the sides of a pile.  They are lifted all the same, while they keep closing: the
# pile comes loose, and they close under what they hold; to open and to close again higher up, around what lies on top,
# lifted less and took three closings.  Where they slip off and come up empty, the logs are detected once more from
# above, and the next grasp takes one at the end of a row.  The same happens where jaws close on nothing, or turn out to
# be empty as they rise.  Jaws that pinch the upper half of a log in a row drag it out and close on it there.  All this
# applies only to logs that a camera measured: a log that is given exactly lies where it should.  Without an opening
# sensor nothing is known of the jaws.

MAX_RESTARTS: Final = 2
"""Missed logs are gripped again this often before the crane goes up empty."""


@dataclass(slots=True)
class GraspRecovery:
    """The attempts at one grasp.

    ``clasps``: the jaws stalled at the sides of what lies between them.  ``restart_count`` counts the restarts from
    above.  ``excluded_logs`` are the numbers of logs that the next selection leaves out: an extraction of them failed,
    or they are inside of a row that the jaws failed to lift.
    """

    clasps: bool = False
    restart_count: int = 0
    excluded_logs: tuple[int, ...] = ()

    def after_closing(self, grasp: Grasp, grapple: GrappleSequence) -> tuple[Phase | None, Grasp]:
        """Choose the next phase, None while the jaws still move, and the grasp as it is tried next."""
        if not is_camera_measured(grasp):
            return Phase.LIFT, grasp
        clasps = grapple.is_stalled_wide(grasp)
        missed = not clasps and grapple.has_missed(grasp) and self.restart_count < MAX_RESTARTS
        if (clasps or missed) and not grapple.is_still:
            return None, grasp
        self.clasps = clasps
        if not missed:
            return Phase.LIFT, grasp
        if grasp.extracts and not grasp.dragging and not grapple.empty:
            return Phase.CLOSE, replace(grasp, dragging=True)
        return Phase.ABOVE, self._restarted(grasp)

    def after_rising(self, grasp: Grasp, grapple: GrappleSequence) -> Grasp | None:
        """Return the grasp to restart where the rising jaws weigh nothing; None where they may hold something."""
        empty = is_camera_measured(grasp) and grapple.is_still and grapple.holds_nothing
        return self._restarted(grasp) if empty and self.restart_count < MAX_RESTARTS else None

    def after_overload(self, grasp: Grasp) -> Grasp | None:
        """Return the grasp to restart where the load is too heavy; None after too many times."""
        return self._restarted(grasp) if self.restart_count < MAX_RESTARTS else None

    def _restarted(self, grasp: Grasp) -> Grasp:
        self.excluded_logs += _inner_logs(grasp) if self.clasps else (grasp.log.id,) if grasp.extracts else ()
        self.restart_count, self.clasps = self.restart_count + 1, False
        return replace(grasp, dragging=False)


def _inner_logs(grasp: Grasp) -> tuple[int, ...]:
    """List the numbers of the logs of a grasp that have others of it on both sides."""
    ax, ay, _ = grasp.log.axis
    across = sorted(grasp.logs, key=lambda log: log.center_m[1] * ax - log.center_m[0] * ay)
    return tuple(log.id for log in across[1:-1])


def is_camera_measured(grasp: Grasp) -> bool:
    """Tell whether a camera measured one of its logs."""
    return any(log.covariance is not None for log in grasp.logs)


def end_sigma_m(log: LogObservation) -> float:
    """Return the standard deviation of the less certain end of a log that a camera measured, m; 0 of a given log."""
    if log.covariance is None:
        return 0.0
    variances = unpack_covariance(log.covariance).diagonal()
    return math.sqrt(max(variances[START], variances[END]))
