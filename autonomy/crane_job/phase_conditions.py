"""A phase under way: how fast its motion is to go on, for it may have to wait for the tongs, and when it is done.

Pure functions of the phase, the time that it has taken, the motion on its way and the tongs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.phases import PHASE_RULES, Phase
from autonomy.crane_job.trajectory_tracker import TrajectoryTracker
from autonomy.grasp.grasp import Grasp

OPENING_GATE_S: Final = 3.0
"""With so much of its way left an arm waits until the tongs are open: they are still high."""
_LAYING_TOLERANCE_FACTOR: Final = 2.0
"""So much less near to its goal than elsewhere a log over the bunk need come: it need not lie so exactly."""
_SINKING_S: Final = 0.6
"""So long what is pressed onto a heap may still sink."""


def motion_rate(phase: Phase, elapsed_s: float, way: TrajectoryTracker, tongs: GrappleSequence, grasp: Grasp | None) -> float:
    """Seconds of the motion in a second that are wanted; 0 where it is to come to a stop and wait."""
    match phase:
        case Phase.CLOSE if grasp is None or not grasp.dragging:
            return 0.0 if tongs.has_closed(elapsed_s) else tongs.pace(way.clock_s)
        case Phase.ABOVE if way.left_s < OPENING_GATE_S and not tongs.open:
            return 0.0
        case Phase.LIFT if grasp is not None and grasp.is_bundle and not tongs.has_closed(elapsed_s):
            return 0.0  # the logs have settled: up again when the tongs have followed
    return 1.0


def is_motion_done(
    phase: Phase, elapsed_s: float, way: TrajectoryTracker, tongs: GrappleSequence, grasp: Grasp | None, position: Sequence[float]
) -> bool:
    """Whether the motion is done and at rest with the joints measured at ``position``, rad (EXT m)."""
    if phase is Phase.CLOSE:
        held = way.is_stopped and not (grasp is not None and grasp.dragging)
        return tongs.has_closed(elapsed_s) and (held or way.left_s <= 0.0)
    if phase is Phase.DESCEND and grasp is not None and grasp.penetrates and _stopped_by_wood(elapsed_s, way):
        return True
    share = _LAYING_TOLERANCE_FACTOR if phase in (Phase.CARRY, Phase.LOWER) else 1.0
    return way.clock_s >= way.motion.duration_s + PHASE_RULES[phase].settle_s and way.arrived(position, share)


def _stopped_by_wood(elapsed_s: float, way: TrajectoryTracker) -> bool:
    """Whether open tongs that are pressed into a heap get no deeper; they sink as they close."""
    late = elapsed_s > way.motion.duration_s + _SINKING_S
    return late or (way.is_stopped and elapsed_s > _SINKING_S)
