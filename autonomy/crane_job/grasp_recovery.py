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
    """How often one grasp was taken higher up since its logs were last looked at, and begun anew; ``stubborn`` are the
    numbers of logs that it is better chosen without: drawn in vain, or inside of a row that was closed round in vain.
    """

    climbs: int = 0
    begun: int = 0
    stubborn: tuple[int, ...] = ()

    def after_closing(self, grasp: Grasp, tongs: GrappleSequence) -> tuple[Phase | None, Grasp]:
        """The phase that follows, None while the tongs still move, and the grasp as it is then tried."""
        if not is_camera_measured(grasp):
            return Phase.LIFT, grasp
        wide = self.climbs < MAX_REGRIPS_HIGHER and tongs.are_wide(grasp, self.climbs)
        # Higher up there may be a thin log that nobody saw, which shut tongs hold: its weight tells.
        vain = tongs.hold_nothing if self.climbs else tongs.have_missed(grasp)
        if self.climbs and tongs.empty and not tongs.still:
            return None, grasp  # the crane still swings, and its load with it
        missed = vain and self.begun < MAX_RESTARTS
        if not wide and not missed:
            return Phase.LIFT, grasp
        if not tongs.still:
            return None, grasp
        if wide:
            self.climbs += 1
            pose = grasp.pose.at_height(grasp.pose.z_m + REGRIP_STEP_M)
            return Phase.DESCEND, replace(grasp, pose=pose, support_z_m=grasp.support_z_m + REGRIP_STEP_M)
        if grasp.drawn and not grasp.drags and not tongs.empty:
            return Phase.CLOSE, replace(grasp, drags=True)
        return Phase.ABOVE, self._anew(grasp)

    def after_rising(self, grasp: Grasp, tongs: GrappleSequence) -> Grasp | None:
        """The grasp, to be begun anew, where the tongs hold nothing that would weigh by now; None where they may."""
        empty = is_camera_measured(grasp) and tongs.still and tongs.hold_nothing
        return self._anew(grasp) if empty and self.begun < MAX_RESTARTS else None

    def _anew(self, grasp: Grasp) -> Grasp:
        self.stubborn += _inner_logs(grasp) if self.climbs else (grasp.log.id,) if grasp.drawn else ()
        self.begun, self.climbs = self.begun + 1, 0
        return replace(grasp, drags=False)


def _inner_logs(grasp: Grasp) -> tuple[int, ...]:
    """The logs of a grasp with others of it on both sides."""
    ax, ay, _ = grasp.log.axis
    across = sorted(grasp.logs, key=lambda log: log.center_m[1] * ax - log.center_m[0] * ay)
    return tuple(log.id for log in across[1:-1])


def is_camera_measured(grasp: Grasp) -> bool:
    """Whether it is of logs that a camera has measured."""
    return any(log.covariance is not None for log in grasp.logs)
