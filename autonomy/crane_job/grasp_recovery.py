"""What closed tongs tell of a grasp before anything is lifted, and what is tried then.

Tongs that stall too wide open clasp the sides of a heap: they close again higher up, round what lies on top.  Those
that pinch the upper half of a log in a row drag it out, and close on it there.  Those that shut on nothing open, and
the logs are looked at from above once more; where they slid over a row that was too wide for them, a log at its end is
taken then.  The same where they turn out to be shut and to weigh nothing as soon as they rise: they slid off, or a thin
log that might have been in them is not.  Only of what a camera measured: what is told exactly lies where it is said to,
and without a sensor of their opening nobody knows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.phases import Phase
from autonomy.grasp.grasp import Grasp

MAX_REGRIPS_HIGHER, REGRIP_STEP_M = 3, 0.1
"""A heap too wide for the tongs is gripped so much higher, so often."""
MAX_RESTARTS: Final = 2
"""So often are missed logs gripped again before the crane goes up empty."""


@dataclass(slots=True)
class GraspRecovery:
    """How often one grasp was taken higher up since its logs were last looked at, and begun anew; ``excluded_logs`` are the
    numbers of logs that it is better chosen without: drawn in vain, or inside of a row that was closed round in vain.
    """

    raised_count: int = 0
    restart_count: int = 0
    excluded_logs: tuple[int, ...] = ()

    def after_closing(self, grasp: Grasp, tongs: GrappleSequence) -> tuple[Phase | None, Grasp]:
        """The phase that follows, None while the tongs still move, and the grasp as it is then tried."""
        if not is_camera_measured(grasp):
            return Phase.LIFT, grasp
        wide = self.raised_count < MAX_REGRIPS_HIGHER and tongs.is_stalled_wide(grasp, self.raised_count)
        # Higher up there may be a thin log that nobody saw, which shut tongs hold: its weight tells.
        vain = tongs.holds_nothing if self.raised_count else tongs.has_missed(grasp)
        if self.raised_count and tongs.empty and not tongs.is_still:
            return None, grasp  # the crane still swings, and its load with it
        missed = vain and self.restart_count < MAX_RESTARTS
        if not wide and not missed:
            return Phase.LIFT, grasp
        if not tongs.is_still:
            return None, grasp
        if wide:
            self.raised_count += 1
            pose = grasp.pose.at_height(grasp.pose.z_m + REGRIP_STEP_M)
            return Phase.DESCEND, replace(grasp, pose=pose, support_z_m=grasp.support_z_m + REGRIP_STEP_M)
        if grasp.extracts and not grasp.dragging and not tongs.empty:
            return Phase.CLOSE, replace(grasp, dragging=True)
        return Phase.ABOVE, self._restarted(grasp)

    def after_rising(self, grasp: Grasp, tongs: GrappleSequence) -> Grasp | None:
        """The grasp, to be begun anew, where the tongs hold nothing that would weigh by now; None where they may."""
        empty = is_camera_measured(grasp) and tongs.is_still and tongs.holds_nothing
        return self._restarted(grasp) if empty and self.restart_count < MAX_RESTARTS else None

    def _restarted(self, grasp: Grasp) -> Grasp:
        self.excluded_logs += _inner_logs(grasp) if self.raised_count else (grasp.log.id,) if grasp.extracts else ()
        self.restart_count, self.raised_count = self.restart_count + 1, 0
        return replace(grasp, dragging=False)


def _inner_logs(grasp: Grasp) -> tuple[int, ...]:
    """The logs of a grasp with others of it on both sides."""
    ax, ay, _ = grasp.log.axis
    across = sorted(grasp.logs, key=lambda log: log.center_m[1] * ax - log.center_m[0] * ay)
    return tuple(log.id for log in across[1:-1])


def is_camera_measured(grasp: Grasp) -> bool:
    """Whether it is of logs that a camera has measured."""
    return any(log.covariance is not None for log in grasp.logs)
