"""The phases of the first mission as a table: what the grapple does, how long each may take, what is wrong then."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from can_dbc.messages.crane import GrappleCommand


class Phase(IntEnum):
    """Where the activity is; the order is the order of a cycle without trouble.  STOW is a job of its own."""

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
    """A phase: what the grapple does, rest after the motion [s], time beyond it [s], what is wrong after
    that.
    """

    grapple: GrappleCommand
    settle_s: float
    slack_s: float
    timeout_message: str


_OPEN, _CLOSE, _HOLD = GrappleCommand.OPEN, GrappleCommand.CLOSE, GrappleCommand.HOLD
PHASE_RULES: Final = {
    Phase.LOOK: PhaseRule(_OPEN, 0.0, 5.0, "the detector sent no log list"),
    Phase.ABOVE: PhaseRule(_OPEN, 0.0, 6.0, "the crane did not get above the log with an open grapple"),
    Phase.DESCEND: PhaseRule(_OPEN, 0.1, 5.0, "the crane did not get down to the log"),
    Phase.CLOSE: PhaseRule(_CLOSE, 0.0, 6.0, "the grapple did not close"),
    Phase.LIFT: PhaseRule(_HOLD, 0.0, 5.0, "the crane did not lift the log, or no log list came"),
    Phase.CARRY: PhaseRule(_HOLD, 0.0, 6.0, "the crane did not get over the bunk, or no log list came"),
    Phase.LOWER: PhaseRule(_HOLD, 0.1, 5.0, "the crane did not get down into the bunk"),
    Phase.OPEN: PhaseRule(_OPEN, 0.0, 5.0, "the grapple did not open"),
    Phase.RETREAT: PhaseRule(_OPEN, 0.1, 6.0, "the crane did not leave the bunk, or no log list came"),
    Phase.STOW: PhaseRule(_HOLD, 0.1, 6.0, "the crane did not get over the bunk"),
}
RESUME_PHASE: Final = {
    Phase.DESCEND: Phase.ABOVE,
    Phase.CLOSE: Phase.ABOVE,
    Phase.LOWER: Phase.CARRY,
    Phase.OPEN: Phase.CARRY,
}
"""Where an interrupted vertical phase begins again when the crane stands aside of its column."""


def grapple_command(phase: Phase, gathered: bool, stow_only: bool) -> GrappleCommand:
    """What the grapple does in a phase: with a bundle (``gathered``) it closes on, for the logs settle and the tongs
    follow; at the end of a job that only ``stow_only`` the crane it does not open.
    """
    if gathered and Phase.LIFT <= phase <= Phase.LOWER:
        return _CLOSE
    if phase in PHASE_RULES:
        return PHASE_RULES[phase].grapple
    return _OPEN if phase is Phase.DONE and not stow_only else _HOLD
