"""The turns of a rotator without an encoder during the procedure: its angle by the surveyor's readings, and the next
pulse.

Directions are those of the grapple in the crane's base frame [rad], modulo pi, without the slew.  Nothing here sends;
the procedure runs the programs.
"""

from __future__ import annotations

from math import pi, remainder
from typing import Final

from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.tasks import PulseTask
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn, fit_turns, pulse_to
from machine.profile import JointSpec
from runtime.errors import Problem

MIN_FIRST_TURN_RAD: Final = 0.1
"""A shorter first turn counts as no motion: four times the noise of two single readings."""


class RotatorTurns:
    """``turns`` holds the completed turns."""

    def __init__(self, spec: JointSpec, turns: list[Turn]) -> None:
        self.turns = turns
        self._spec = spec
        self._seen: list[float] = []
        self._record: SpoolTestRecord | None = None
        self._before_rad: float | None = None

    def program(self, task: PulseTask) -> SpoolProgram:
        """The pulse of a task by all turns so far."""
        return pulse_to(self._spec, fit_turns(self.turns, self._spec), task.side, task.share, task.to_rad)

    def pulse_finished(self, record: SpoolTestRecord) -> None:
        """Record a pulse that has ended."""
        self._record = record

    def add_reading(self, yaw_rad: float, slew_rad: float) -> int:
        """Add one reading of the direction at rest; returns how many there are at this rest."""
        direction = yaw_rad - slew_rad
        first = self._seen[0] if self._seen else direction
        self._seen.append(first + remainder(direction - first, pi))
        return len(self._seen)

    def finish_rest(self) -> Problem | None:
        """Complete the turn before this rest; returns the problem when it was no proper turn."""
        readings, direction = len(self._seen), sum(self._seen) / len(self._seen)
        record, before, self._before_rad = self._record, self._before_rad, direction
        self._seen = []
        if record is None or before is None:
            return None
        self.turns.append(Turn(record, before, direction, readings))
        if sum(t.record.side == record.side for t in self.turns) > 1:
            return None
        name, turned = record.joint.name.lower(), record.side * remainder(direction - before, pi)
        if turned < -MIN_FIRST_TURN_RAD:
            why = "check the sign of its valve in the profile"
            return Problem("calibration.wrong-direction", f"the {name} moves the wrong way: {why}")
        if turned < MIN_FIRST_TURN_RAD:
            why = "check its valve and pump, or correct deadband in the profile"
            return Problem("calibration.no-motion", f"the {name} does not move: {why}")
        return None
