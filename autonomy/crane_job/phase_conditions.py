"""Conditions of a running phase: the rate at which its motion goes on, and whether it is done.

Pure functions of the phase, its elapsed time, the tracked motion and the grapple.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.phases import PHASE_RULES, Phase
from autonomy.crane_job.trajectory_tracker import TrajectoryTracker
from autonomy.grasp.planner import Grasp

OPENING_GATE_S: Final = 3.0
"""The crane waits for open jaws when this much of its motion is left: they are still high then."""
_LAYING_TOLERANCE_FACTOR: Final = 2.0
"""Goal tolerance is this many times wider over the bunk: a log need not lie exactly there."""
_SINKING_S: Final = 0.6
"""Open jaws on a pile may still sink for this long."""


def motion_rate(
    phase: Phase, elapsed_s: float, tracker: TrajectoryTracker, grapple: GrappleSequence, grasp: Grasp | None
) -> float:
    """Compute the wanted rate of the motion, seconds per second; 0 where it should stop and wait."""
    match phase:
        case Phase.CLOSE if grasp is None or not grasp.dragging:
            return 0.0 if grapple.has_closed(elapsed_s) else grapple.following_rate(tracker.clock_s)
        case Phase.ABOVE if tracker.left_s < OPENING_GATE_S and not grapple.is_open:
            return 0.0
        case Phase.LIFT if grasp is not None and grasp.is_bundle and not grapple.has_closed(elapsed_s):
            return 0.0  # the logs have settled: lift on when the jaws have followed
    return 1.0


def is_motion_done(
    phase: Phase,
    elapsed_s: float,
    tracker: TrajectoryTracker,
    grapple: GrappleSequence,
    grasp: Grasp | None,
    position: Sequence[float],
) -> bool:
    """Tell whether the motion is done and at rest, with the joints measured at ``position``, rad (EXT m)."""
    if phase is Phase.CLOSE:
        held = tracker.is_stopped and not (grasp is not None and grasp.dragging)
        return grapple.has_closed(elapsed_s) and (held or tracker.left_s <= 0.0)
    if phase is Phase.DESCEND and grasp is not None and grasp.penetrates and _stopped_by_wood(elapsed_s, tracker):
        return True
    share = _LAYING_TOLERANCE_FACTOR if phase in (Phase.CARRY, Phase.LOWER) else 1.0
    return tracker.clock_s >= tracker.motion.duration_s + PHASE_RULES[phase].settle_s and tracker.arrived(
        position, share
    )


def _stopped_by_wood(elapsed_s: float, tracker: TrajectoryTracker) -> bool:
    """Tell whether open jaws that penetrate a pile get no deeper; they sink further as they close."""
    late = elapsed_s > tracker.motion.duration_s + _SINKING_S
    return late or (tracker.is_stopped and elapsed_s > _SINKING_S)
