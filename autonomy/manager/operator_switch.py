"""The operator's mode switch as a planner obeys it: Idle and Faulty hold, the turn from Idle to Auto starts or resumes.

Auto by itself changes nothing: a planner that finds the switch there does what one of a machine without a switch does.
Paper B (3.2.6) has this switch.
"""

from __future__ import annotations

from typing import Final

from can_dbc.messages.crane import ModeSwitch, StateReport
from runtime.errors import Problem

_HOLDS: Final = {
    ModeSwitch.IDLE: Problem("switch.idle", "the operator's mode switch is at Idle; turn it to Auto"),
    ModeSwitch.FAULTY: Problem(
        "switch.faulty", "the operator's mode switch was faulty or silent; turn it to Idle, then to Auto"
    ),
}


class OperatorSwitch:
    """Where the switch is, by the newest report that was taken."""

    def __init__(self) -> None:
        self._position = ModeSwitch.NOT_FITTED
        self.started = False
        """Whether that report was the first after the turn from Idle to Auto."""

    @property
    def hold(self) -> Problem | None:
        """Why nothing may work, whatever is commanded; None while the switch does not hold."""
        return _HOLDS.get(self._position)

    def take(self, report: StateReport | None) -> None:
        """Take the newest report; None: there is no new one."""
        self.started = False
        if report is None:
            return
        before, self._position = self._position, ModeSwitch(report.mode_switch)
        self.started = (before, self._position) == (ModeSwitch.IDLE, ModeSwitch.AUTO)
        if self._position is ModeSwitch.NOT_FITTED and before in _HOLDS:
            self._position = ModeSwitch.FAULTY  # it is not known any more
