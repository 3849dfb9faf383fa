"""The controller's modes, shared by supervisor, planner, console and recorder."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class Mode(IntEnum):
    """The supervisor's mode, as in ``StateReport.mode`` and ``CtrlStatus.Mode``.

    Setpoints are executed in ARMED (the first one changes it to ACTIVE) and ACTIVE, and refused in every other mode.
    """

    BOOT = 0
    STANDBY = 1
    ARMED = 2
    ACTIVE = 3
    STOP = 4
    FAULT = 5


STOPPED: Final = (Mode.STOP, Mode.FAULT)


def mode_name(mode: int) -> str:
    """Return the name of a mode, also of one of another release."""
    return Mode(mode).name if mode in set(Mode) else f"MODE {mode}"
