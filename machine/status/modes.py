"""The controller's modes: the one enumeration that supervisor, planner, console and recorder share."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """The supervisor's mode, as it stands in ``StateReport.mode`` and ``CtrlStatus.Mode``.

    Setpoints are obeyed in ARMED (the first makes it ACTIVE) and ACTIVE, and refused in every other mode.
    """

    BOOT = 0
    STANDBY = 1
    ARMED = 2
    ACTIVE = 3
    STOP = 4
    FAULT = 5
