"""One running spool program: monitored, and ended or reversed as soon as the joint has shown enough.

The program of a joint without an encoder runs from beginning to end.  Times are of the program, in s: it begins at 0,
and its record ``LEAD_S`` before.
"""

from __future__ import annotations

from typing import Final

from autonomy.calibration import spool_program
from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.tasks import SpoolTask
from can_dbc.messages.crane import SpoolKnot
from machine.profile import JointSpec
from runtime.errors import Problem

LEAD_S: Final = 0.15
"""A spool test's record begins this long before its program, with the joint at rest, ..."""
TAIL_S: Final = 0.55
"""... and ends this long after it: dead time, and the oil's ringing."""
HORIZON_S: Final = 0.4
MIN_MOVED, MIN_MOVED_S = 0.008, 0.02
"""A joint has moved after this travel [rad, m], or this time at its speed limit: more than noise and ringing oil."""
REBOUND_FACTOR: Final = 3.0
"""A joint whose direction is proven may swing back this many times farther: oil rings after a staircase."""
REVERSAL_SPEED_SHARE: Final = 0.16
"""A sweep reverses when the joint has this share of its speed limit: the foot of the metering curve is visible then."""
CLOSE_S: Final = 0.06
TRAVEL_UNCERTAINTY: Final = 1.3
"""A joint may travel this many times as far as the profile's valve map says."""


def program_for(spec: JointSpec, task: SpoolTask) -> SpoolProgram:
    """The program of a task before anything has moved."""
    build = {"wiggle": spool_program.wiggle, "sweep": spool_program.sweep, "staircase": spool_program.staircase}[
        task.kind
    ]
    return build(spec, task.side)


class SpoolRun:
    """``program`` is the program from now on; ``begun``: it has started."""

    def __init__(self, first: SpoolProgram) -> None:
        self.program = first
        self.begun = self._sent_end = False
        self._sent: SpoolProgram | None = None

    def follow(self, run_s: float, position: float, velocity: float) -> Problem | None:
        """Monitor the joint; returns the problem that ends the run.  Without an encoder, none."""
        return None

    def final_check(self, position: float) -> Problem | None:
        """Check the joint at the end of the program; without an encoder, nothing."""
        return None

    def close(self, run_s: float) -> None:
        """Close the valve from now on."""
        self.program = self.program.closing(run_s, CLOSE_S)

    def is_silent(self, run_s: float) -> bool:
        """Whether there is nothing to send: before the start, and once the end has been sent."""
        return run_s < 0.0 or (run_s > self.program.duration_s and self._sent_end)

    @property
    def changed(self) -> bool:
        """Whether the program differs from the one that was sent last."""
        return self._sent is not self.program

    def window(self, run_s: float) -> tuple[SpoolKnot, ...]:
        """The knots to send now."""
        self._sent = self.program
        self._sent_end = run_s + HORIZON_S >= self.program.duration_s
        return self.program.window(run_s, HORIZON_S)


class MonitoredSpoolRun(SpoolRun):
    """The program of a joint with an encoder; ``closed``: it is ending."""

    def __init__(self, spec: JointSpec, task: SpoolTask, position: float) -> None:
        super().__init__(program_for(spec, task))
        self._spec, self._task, self._from = spec, task, position
        self._name = task.joint.name.lower()
        self.closed = False

    @property
    def end(self) -> float:
        """The farthest position that the joint may reach [rad, m]."""
        return self._from + TRAVEL_UNCERTAINTY * spool_program.predicted_travel(
            self.program, self._spec, self._task.side
        )

    def follow(self, run_s: float, position: float, velocity: float) -> Problem | None:
        """Adapt the program to the joint's motion; returns a problem when the joint moves the wrong way."""
        moved, enough = self._moved(position), _min_travel(self._spec)
        if moved < -enough * (1.0 if self._task.kind == "wiggle" else REBOUND_FACTOR):
            why = "check sign and direction of its valve and encoder in the profile"
            return Problem("calibration.wrong-direction", f"the {self._name} moves the wrong way: {why}")
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

    def final_check(self, position: float) -> Problem | None:
        """At the end of the program: a problem when the joint has not moved."""
        if self._moved(position) >= _min_travel(self._spec):
            return None
        why = "check its valve, pump and encoder, or correct deadband in the profile"
        return Problem("calibration.no-motion", f"the {self._name} does not move: {why}")

    def _moved(self, position: float) -> float:
        return self._task.side * (position - self._from)

    def _turns(self, run_s: float, velocity: float) -> bool:
        rising = self.program.points[1][0] < run_s < self.program.points[2][0]
        return rising and self._task.side * velocity > REVERSAL_SPEED_SHARE * self._spec.speed_limit


def _min_travel(spec: JointSpec) -> float:
    """Travel of a joint that certainly moves [rad, m]."""
    return max(MIN_MOVED, MIN_MOVED_S * spec.speed_limit)
