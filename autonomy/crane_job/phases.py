"""The phases of a crane job as a table: the grapple's command, the time limit, and the failure when it passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.trajectory_tracker import TrajectoryTracker
from autonomy.grasp.planner import Grasp
from can_dbc.messages.crane import GrappleCommand
from runtime.errors import Problem


class Phase(IntEnum):
    """Where the activity is, in the order of a cycle without trouble.  STOW is a job of its own."""

    WAIT = 0
    LOOK = 1
    ABOVE = 2
    DESCEND = 3
    CLOSE = 4
    LIFT = 5
    CARRY = 6
    LOWER = 7
    OPEN = 8
    RETREAT = 9
    STOW = 10
    DONE = 11
    FAILED = 12


@dataclass(frozen=True, slots=True)
class PhaseRule:
    """One phase: the grapple's command, the rest after the motion [s], the time beyond it [s], and the failure when
    that time passes; the elapsed time completes its sentence.
    """

    grapple: GrappleCommand
    settle_s: float
    slack_s: float
    timeout: Problem


_OPEN, _CLOSE, _HOLD = GrappleCommand.OPEN, GrappleCommand.CLOSE, GrappleCommand.HOLD
PHASE_RULES: Final = {
    Phase.LOOK: PhaseRule(_OPEN, 0.0, 5.0, Problem("activity.look-timeout", "the detector sent no log list")),
    Phase.ABOVE: PhaseRule(
        _OPEN,
        0.0,
        6.0,
        Problem("activity.above-timeout", "the crane did not get above the log with an open grapple"),
    ),
    Phase.DESCEND: PhaseRule(
        _OPEN, 0.1, 5.0, Problem("activity.descend-timeout", "the crane did not get down to the log")
    ),
    Phase.CLOSE: PhaseRule(_CLOSE, 0.0, 6.0, Problem("activity.close-timeout", "the grapple did not close")),
    Phase.LIFT: PhaseRule(
        _HOLD, 0.0, 5.0, Problem("activity.lift-timeout", "the crane did not lift the log, or no log list came")
    ),
    Phase.CARRY: PhaseRule(
        _HOLD,
        0.0,
        6.0,
        Problem("activity.carry-timeout", "the crane did not get over the bunk, or no log list came"),
    ),
    Phase.LOWER: PhaseRule(
        _HOLD, 0.1, 5.0, Problem("activity.lower-timeout", "the crane did not get down into the bunk")
    ),
    Phase.OPEN: PhaseRule(_OPEN, 0.0, 5.0, Problem("activity.open-timeout", "the grapple did not open")),
    Phase.RETREAT: PhaseRule(
        _OPEN, 0.1, 6.0, Problem("activity.retreat-timeout", "the crane did not leave the bunk, or no log list came")
    ),
    Phase.STOW: PhaseRule(_HOLD, 0.1, 6.0, Problem("activity.stow-timeout", "the crane did not get over the bunk")),
}
RESUME_PHASE: Final = {
    Phase.DESCEND: Phase.ABOVE,
    Phase.CLOSE: Phase.ABOVE,
    Phase.LOWER: Phase.CARRY,
    Phase.OPEN: Phase.CARRY,
}
"""Where an interrupted vertical phase resumes when the crane is no longer in its column."""


def grapple_command(phase: Phase, is_bundle: bool, stow_only: bool) -> GrappleCommand:
    """The grapple's command in a phase.

    With a bundle the grapple keeps closing, for the logs settle and the jaws follow; at the end of a job that only
    stows the crane it does not open.
    """
    if is_bundle and Phase.LIFT <= phase <= Phase.LOWER:
        return _CLOSE
    if phase in PHASE_RULES:
        return PHASE_RULES[phase].grapple
    return _OPEN if phase is Phase.DONE and not stow_only else _HOLD


# -- Conditions of a running phase: the rate at which its motion goes on, and whether it is done.
#
# Pure functions of the phase, its elapsed time, the tracked motion and the grapple.

OPENING_GATE_S: Final = 3.0
"""The crane waits for open jaws when this much of its motion is left: they are still high then."""
_LAYING_TOLERANCE_FACTOR: Final = 2.0
"""Goal tolerance is this many times wider over the bunk: a log need not lie exactly there."""
_SINKING_S: Final = 0.6
"""Open jaws on a pile may still sink for this long."""


def motion_rate(
    phase: Phase, elapsed_s: float, tracker: TrajectoryTracker, grapple: GrappleSequence, grasp: Grasp | None
) -> float:
    """The wanted rate of the motion, seconds per second; 0 where it should stop and wait."""
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
    """Whether the motion is done and at rest, with the joints measured at ``position``, rad (EXT m)."""
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
    """Whether open jaws that penetrate a pile get no deeper; they sink further as they close."""
    late = elapsed_s > tracker.motion.duration_s + _SINKING_S
    return late or (tracker.is_stopped and elapsed_s > _SINKING_S)
