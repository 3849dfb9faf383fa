"""The turns of a joint without an encoder while they run: where it stands by what a surveyor saw, and what comes next.

Directions are of the grapple in the crane's base frame [rad], modulo pi; the slew's part is taken off.  Nothing here
sends; the procedure runs the programs.
"""

from __future__ import annotations

from math import pi, remainder
from typing import Final

from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.tasks import PulseTask
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn, fit_turns, pulse_to
from machine.profile import JointSpec

MIN_FIRST_TURN_RAD: Final = 0.1
"""A first turn that is shorter was none: four times the noise of two single readings."""


class RotatorTurns:
    """``turns`` are those that are complete."""

    def __init__(self, spec: JointSpec, turns: list[Turn]) -> None:
        self.turns = turns
        self._spec = spec
        self._seen: list[float] = []
        self._record: SpoolTestRecord | None = None
        self._before_rad: float | None = None

    def program(self, task: PulseTask) -> SpoolProgram:
        """The pulse of a task by all that is known so far."""
        return pulse_to(self._spec, fit_turns(self.turns, self._spec), task.side, task.share, task.to_rad)

    def pulse_finished(self, record: SpoolTestRecord) -> None:
        """A pulse is over."""
        self._record = record

    def add_reading(self, yaw_rad: float, slew_rad: float) -> int:
        """One reading of the direction at rest; returns how many there are here."""
        direction = yaw_rad - slew_rad
        first = self._seen[0] if self._seen else direction
        self._seen.append(first + remainder(direction - first, pi))
        return len(self._seen)

    def finish_rest(self) -> str | None:
        """Enough was read here: completes the turn before; a sentence when it was none."""
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
            return f"the {name} moves the wrong way: check the sign of its valve in the profile"
        if turned < MIN_FIRST_TURN_RAD:
            return f"the {name} does not move: check its valve and pump, or correct deadband in the profile"
        return None
