"""One spool program while it runs: broken off or turned as soon as the joint has shown enough, and watched; that of a
joint without an encoder is only told, from its beginning to its end.

Times are of the program, in s: it begins at 0, and its record ``LEAD_S`` before it.
"""

from __future__ import annotations

from typing import Final

from autonomy.calibration import spool_program
from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.tasks import SpoolTask
from can_dbc.messages.crane import SpoolKnot
from machine.profile import JointSpec

LEAD_S: Final = 0.15
"""A spool test's record begins this long before its program, with the joint at rest."""
TAIL_S: Final = 0.55
"""and ends this long after: dead time, and the oil's ringing."""
HORIZON_S: Final = 0.4
MIN_MOVED, MIN_MOVED_S = 0.008, 0.02
"""A joint that went this far [rad, m], and so long at its speed limit, has moved: beyond noise and ringing oil."""
REBOUND_FACTOR: Final = 3.0
"""A joint that has proved its direction may swing back so many times further: oil rings on after a staircase."""
REVERSAL_SPEED_SHARE: Final = 0.16
"""A sweep turns when the joint has this share of its speed limit: enough to see the foot of the metering curve."""
CLOSE_S: Final = 0.06
TRAVEL_UNCERTAINTY: Final = 1.3
"""A joint may go so many times as far as the profile's valve map says."""


def program_for(spec: JointSpec, task: SpoolTask) -> SpoolProgram:
    """The program of a task, before anything has moved."""
    build = {"wiggle": spool_program.wiggle, "sweep": spool_program.sweep, "staircase": spool_program.staircase}[task.kind]
    return build(spec, task.side)


class SpoolRun:
    """``program`` is what is told from now on; ``begun``: it is on its way."""

    def __init__(self, first: SpoolProgram) -> None:
        self.program = first
        self.begun = self._told_end = False
        self._told: SpoolProgram | None = None

    def follow(self, run_s: float, position: float, velocity: float) -> str | None:
        """Nobody sees what the joint does."""
        return None

    def final_check(self, position: float) -> str | None:
        """Nor what it has done."""
        return None

    def close(self, run_s: float) -> None:
        """The valve shuts from now on."""
        self.program = self.program.closing(run_s, CLOSE_S)

    def is_silent(self, run_s: float) -> bool:
        """Whether there is nothing to tell now: before its begin, and once its end is told."""
        return run_s < 0.0 or (run_s > self.program.duration_s and self._told_end)

    @property
    def changed(self) -> bool:
        """Whether the program is another than the one that was told last."""
        return self._told is not self.program

    def window(self, run_s: float) -> tuple[SpoolKnot, ...]:
        """What is told now."""
        self._told = self.program
        self._told_end = run_s + HORIZON_S >= self.program.duration_s
        return self.program.window(run_s, HORIZON_S)


class MonitoredSpoolRun(SpoolRun):
    """The program of a joint with an encoder; ``closed``: it is on its way out."""

    def __init__(self, spec: JointSpec, task: SpoolTask, position: float) -> None:
        super().__init__(program_for(spec, task))
        self._spec, self._task, self._from = spec, task, position
        self._name = task.joint.name.lower()
        self.closed = False

    @property
    def end(self) -> float:
        """Where the joint may come to at most [rad, m]."""
        return self._from + TRAVEL_UNCERTAINTY * spool_program.predicted_travel(self.program, self._spec, self._task.side)

    def follow(self, run_s: float, position: float, velocity: float) -> str | None:
        """Changes the program by what the joint does; a sentence when it moves the wrong way."""
        moved, enough = self._moved(position), _min_travel(self._spec)
        if moved < -enough * (1.0 if self._task.kind == "wiggle" else REBOUND_FACTOR):
            why = "check sign and direction of its valve and encoder in the profile"
            return f"the {self._name} moves the wrong way: {why}"
        if self.closed:
            return None
        if self._task.kind == "wiggle" and moved > enough:
            self.close(run_s)
            self.closed = True
        elif self._task.kind == "sweep" and self._turns(run_s, velocity):
            self.program = spool_program.reversed_sweep(self.program, run_s)
            self.closed = True
        elif run_s >= self.program.duration_s:
            self.closed = True
        return None

    def judged(self, position: float) -> str | None:
        """At its end: a sentence when the joint has not moved."""
        if self._moved(position) >= _min_travel(self._spec):
            return None
        return f"the {self._name} does not move: check its valve, pump and encoder, or correct deadband in the profile"

    def _moved(self, position: float) -> float:
        return self._task.side * (position - self._from)

    def _turns(self, run_s: float, velocity: float) -> bool:
        rising = self.program.points[1][0] < run_s < self.program.points[2][0]
        return rising and self._task.side * velocity > REVERSAL_SPEED_SHARE * self._spec.speed_limit


def _min_travel(spec: JointSpec) -> float:
    """How far a joint goes that certainly moves [rad, m]."""
    return max(MIN_MOVED, MIN_MOVED_S * spec.speed_limit)
