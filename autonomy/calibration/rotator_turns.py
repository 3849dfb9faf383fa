"""The turns of a rotator without an encoder during the procedure: its angle by the surveyor's readings, and the next
pulse.

Directions are those of the grapple in the crane's base frame [rad], modulo pi, without the slew.  Nothing here sends;
the procedure runs the programs.
"""

from __future__ import annotations

from math import pi, remainder
from typing import Final

import numpy as np

from autonomy.calibration.spool_program import (
    TURN_TOPS_PCT,
    SpoolProgram,
    allowed_by,
    predicted_travel,
    turn_search,
)
from autonomy.calibration.tasks import PulseTask, TurnSearchTask
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn, fit_turns, pulse_to
from machine.profile import JointSpec
from runtime.errors import Problem

MIN_FIRST_TURN_RAD: Final = 0.1
"""A shorter turn counts as no motion: four times the noise of two single readings."""
COUNTED_SHARE: Final = 0.9
"""Share of the joint's range within which the controller's count of the turns stays: it knows only the profile."""
SHORTER, LEAST_SHARE = 0.8, 0.4


class RotatorTurns:
    """``turns`` holds the completed turns, ``searched`` those of the search before them."""

    def __init__(self, spec: JointSpec, turns: list[Turn], searched: list[Turn]) -> None:
        self.turns, self.searched = turns, searched
        self._spec, self._allowed = spec, allowed_by(spec)
        self._counted_rad = 0.0
        self._found: set[int] = set()
        self._seen: list[float] = []
        self._record: SpoolTestRecord | None = None
        self._before_rad: float | None = None

    def program(self, task: PulseTask) -> SpoolProgram | None:
        """The pulse of a task by all turns so far; None where the controller's count leaves too little of it."""
        fit = fit_turns([*self.searched, *self.turns], self._spec)
        most = COUNTED_SHARE * min(self._spec.upper, -self._spec.lower)
        share = 1.0
        while share > LEAST_SHARE:
            to_rad = fit.angle_rad + share * (task.to_rad - fit.angle_rad)
            program = pulse_to(self._spec, fit, task.side, task.share, to_rad, self._allowed)
            counted_rad = self._counted_rad + predicted_travel(program, self._spec, task.side)
            if abs(counted_rad) <= most:
                self._counted_rad = counted_rad
                return program
            share *= SHORTER
        return None

    def search(self, task: TurnSearchTask) -> SpoolProgram:
        """The next ramp of the search."""
        program = turn_search(self._spec, task.side, task.top_pct, self._allowed)
        self._counted_rad += predicted_travel(program, self._spec, task.side)
        return program

    def is_found(self, side: int) -> bool:
        """Whether the search to a side has turned the joint."""
        return side in self._found

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
        turn = Turn(record, before, direction, readings)
        if record.kind != "search":
            self.turns.append(turn)
            return None
        self.searched.append(turn)
        name, turned = record.joint.name.lower(), record.side * remainder(direction - before, pi)
        if turned < -MIN_FIRST_TURN_RAD:
            why = "swap its solenoids, or change sign of its valve in the profile; nothing was corrected"
            return Problem("calibration.wrong-direction", f"the {name} moves the wrong way: {why}")
        if turned >= MIN_FIRST_TURN_RAD:
            self._found.add(record.side)
        elif (
            100.0 * float(np.max(np.abs(record.command))) > self._allowed.top_pct(record.side, TURN_TOPS_PCT[-1]) - 1.0
        ):
            why = f"its valve was opened up to {TURN_TOPS_PCT[-1]:.0f} %; check spool, solenoid and plug of its valve"
            return Problem("calibration.no-motion", f"the {name} does not move: {why}")
        return None
