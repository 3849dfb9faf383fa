"""Modes and transitions of the supervisor, as data: which event leads from which mode to which."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from machine.status.modes import Mode


class Event(IntEnum):
    """Events that may change the mode."""

    BOOTED = 0
    """All encoders are set up."""
    ARM = 1
    """The operator armed, and nothing prevents it."""
    DISARM = 2
    RESET = 3
    SETPOINT = 4
    """A setpoint was accepted."""
    DONE = 5
    """A final setpoint was reached, and its lease is over."""
    HOLD = 6
    """Reaction H, or the operator's stop."""
    RAMP = 7
    """Reaction R1."""
    CUT = 8
    """Reaction R0."""
    LATCHED = 9
    """The ramp of an R1 is over."""


TRANSITIONS: Final[dict[tuple[Mode, Event], Mode]] = {
    (Mode.BOOT, Event.BOOTED): Mode.STANDBY,
    (Mode.BOOT, Event.CUT): Mode.FAULT,
    (Mode.STANDBY, Event.ARM): Mode.ARMED,
    (Mode.STANDBY, Event.HOLD): Mode.STOP,
    (Mode.STANDBY, Event.CUT): Mode.FAULT,
    (Mode.ARMED, Event.DISARM): Mode.STANDBY,
    (Mode.ARMED, Event.SETPOINT): Mode.ACTIVE,
    (Mode.ARMED, Event.HOLD): Mode.STOP,
    (Mode.ARMED, Event.RAMP): Mode.FAULT,
    (Mode.ARMED, Event.CUT): Mode.FAULT,
    (Mode.ACTIVE, Event.DISARM): Mode.STOP,
    (Mode.ACTIVE, Event.DONE): Mode.ARMED,
    (Mode.ACTIVE, Event.HOLD): Mode.STOP,
    (Mode.ACTIVE, Event.RAMP): Mode.STOP,
    (Mode.ACTIVE, Event.CUT): Mode.FAULT,
    (Mode.STOP, Event.ARM): Mode.ARMED,
    (Mode.STOP, Event.DISARM): Mode.STANDBY,
    (Mode.STOP, Event.RESET): Mode.STANDBY,
    (Mode.STOP, Event.RAMP): Mode.FAULT,  # a second fault while stopping: neutral at once
    (Mode.STOP, Event.CUT): Mode.FAULT,
    (Mode.STOP, Event.LATCHED): Mode.FAULT,
    (Mode.FAULT, Event.RESET): Mode.BOOT,
}
"""Mode after an event; a pair that is not listed changes nothing."""

OPERATING: Final = (Mode.ARMED, Mode.ACTIVE)
"""Modes in which setpoints are accepted."""
