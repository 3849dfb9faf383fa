"""Recovery from a failed grasp: what closed jaws tell before anything is lifted, and what is tried then.

Jaws that stall too wide open clasp the sides of a pile: they close again higher up, around what lies on top.  Jaws
that pinch the upper half of a log in a row drag it out and close on it there.  Jaws that close on nothing open again,
and the logs are detected once more from above; where the jaws slid over a row that was too wide for them, the next
grasp extracts a log at its end.  The same happens where the jaws turn out to be closed and empty as soon as they
rise: they slipped off, or the thin log that they might have held is not there.  All this applies only to logs that a
camera measured: a log that is given exactly lies where it should.  Without an opening sensor nothing is known of the
jaws.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.phases import Phase
from autonomy.grasp.grasp import Grasp

MAX_REGRIPS_HIGHER, REGRIP_STEP_M = 3, 0.1
"""A pile too wide for the jaws is gripped this often and each time this much higher."""
MAX_RESTARTS: Final = 2
"""Missed logs are gripped again this often before the crane goes up empty."""


@dataclass(slots=True)
class GraspRecovery:
    """The attempts at one grasp.

    ``raised_count`` counts the repetitions higher up since the logs were last detected, ``restart_count`` the restarts
    from above.  ``excluded_logs`` are the numbers of logs that the next selection leaves out: an extraction of them
    failed, or they are inside of a row that the jaws failed to lift.
    """

    raised_count: int = 0
    restart_count: int = 0
    excluded_logs: tuple[int, ...] = ()

    def after_closing(self, grasp: Grasp, grapple: GrappleSequence) -> tuple[Phase | None, Grasp]:
        """The next phase, None while the jaws still move, and the grasp as it is tried next."""
        if not is_camera_measured(grasp):
            return Phase.LIFT, grasp
        wide = self.raised_count < MAX_REGRIPS_HIGHER and grapple.is_stalled_wide(grasp, self.raised_count)
        # Higher up, closed jaws may hold a thin log that was not detected: its weight tells.
        vain = grapple.holds_nothing if self.raised_count else grapple.has_missed(grasp)
        if self.raised_count and grapple.empty and not grapple.is_still:
            return None, grasp  # the crane still swings, which disturbs the load cell
        missed = vain and self.restart_count < MAX_RESTARTS
        if not wide and not missed:
            return Phase.LIFT, grasp
        if not grapple.is_still:
            return None, grasp
        if wide:
            self.raised_count += 1
            pose = grasp.pose.at_height(grasp.pose.z_m + REGRIP_STEP_M)
            return Phase.DESCEND, replace(grasp, pose=pose, support_z_m=grasp.support_z_m + REGRIP_STEP_M)
        if grasp.extracts and not grasp.dragging and not grapple.empty:
            return Phase.CLOSE, replace(grasp, dragging=True)
        return Phase.ABOVE, self._restarted(grasp)

    def after_rising(self, grasp: Grasp, grapple: GrappleSequence) -> Grasp | None:
        """The grasp to restart where the rising jaws weigh nothing; None where they may hold something."""
        empty = is_camera_measured(grasp) and grapple.is_still and grapple.holds_nothing
        return self._restarted(grasp) if empty and self.restart_count < MAX_RESTARTS else None

    def _restarted(self, grasp: Grasp) -> Grasp:
        self.excluded_logs += _inner_logs(grasp) if self.raised_count else (grasp.log.id,) if grasp.extracts else ()
        self.restart_count, self.raised_count = self.restart_count + 1, 0
        return replace(grasp, dragging=False)


def _inner_logs(grasp: Grasp) -> tuple[int, ...]:
    """The numbers of the logs of a grasp that have others of it on both sides."""
    ax, ay, _ = grasp.log.axis
    across = sorted(grasp.logs, key=lambda log: log.center_m[1] * ax - log.center_m[0] * ay)
    return tuple(log.id for log in across[1:-1])


def is_camera_measured(grasp: Grasp) -> bool:
    """Whether a camera measured one of its logs."""
    return any(log.covariance is not None for log in grasp.logs)
