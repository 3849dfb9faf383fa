"""One running spool program: monitored, and ended or reversed as soon as the joint has shown enough.

The program of a joint without an encoder runs from beginning to end.  Times are of the program, in s: it begins at 0,
and its record ``LEAD_S`` before.
"""

from __future__ import annotations

from typing import Final

from autonomy.calibration import spool_program
from autonomy.calibration.plan import SpoolTask
from autonomy.calibration.spool_program import Allowed, SpoolProgram
from can_dbc.messages.crane import SpoolKnot
from machine.profile import JointSpec
from runtime.errors import Problem

LEAD_S: Final = 0.15
"""A spool test's record begins this long before its program, with the joint at rest, ..."""
TAIL_S: Final = 0.2
"""... and ends this long after it: the oil's ringing.  Dead time and spool are over: every program ends at rest."""
HORIZON_S: Final = 0.5
MIN_MOVED, MIN_MOVED_S = 0.008, 0.02
"""A joint has moved after this travel [rad, m], or this time at its speed limit: more than noise and ringing oil."""
REBOUND_FACTOR: Final = 3.0
"""A joint whose direction is proven may swing back this many times farther: oil rings after a staircase."""
REVERSAL_SPEED_SHARE: Final = 0.16
"""A sweep reverses when the joint has this share of its speed limit: the foot of the metering curve is visible, ..."""
SHOWN: Final = 1.2
"""... and when it has gone this many times as far as a joint that certainly moves."""
ENOUGH_SPEED_SHARE: Final = 1.1
"""A staircase is planned up to 0.8 of the speed limit, by a full speed that the search knows within a third, and
sometimes worse: at this share of the limit it has shown enough.  The controller stops a test at 1.25."""
CLOSE_S: Final = 0.06
TRAVEL_UNCERTAINTY: Final = 1.3
"""A joint may travel this many times as far as the profile's valve map says."""


def program_for(spec: JointSpec, task: SpoolTask, allowed: Allowed) -> SpoolProgram:
    """Build the program of a task before anything has moved."""
    build = {"wiggle": spool_program.wiggle, "sweep": spool_program.sweep, "staircase": spool_program.staircase}[
        task.kind
    ]
    return build(spec, task.side, allowed)


class SpoolRun:
    """``program`` is the program from now on; ``begun``: it has started."""

    def __init__(self, first: SpoolProgram) -> None:
        self.program = first
        self.begun = self._sent_end = False
        self._sent: SpoolProgram | None = None

    def follow(self, run_s: float, position: float, velocity: float) -> Problem | None:
        """Monitor the joint; return the problem that ends the run.  Without an encoder, none."""
        return None

    def final_check(self, position: float) -> Problem | None:
        """Check the joint at the end of the program; without an encoder, nothing."""
        return None

    def close(self, run_s: float) -> None:
        """Close the valve from now on, and be neutral at once: the run is over."""
        self.program = self.program.closing(run_s, CLOSE_S)

    def finish(self, run_s: float, close_s: float = CLOSE_S, edge_pct: float = 0.0) -> None:
        """Close the valve from now on, slowly to the edge of its dead-band; the program ends as planned ones do."""
        self.program = self.program.ending(run_s, close_s, edge_pct)

    def is_silent(self, run_s: float) -> bool:
        """Tell whether there is nothing to send: before the start, and once the end has been sent."""
        return run_s < 0.0 or (run_s > self.program.duration_s and self._sent_end)

    @property
    def changed(self) -> bool:
        """Whether the program differs from the one that was sent last."""
        return self._sent is not self.program

    def window(self, run_s: float) -> tuple[SpoolKnot, ...]:
        """Return the knots to send now."""
        self._sent = self.program
        self._sent_end = run_s + HORIZON_S >= self.program.duration_s
        return self.program.window(run_s, HORIZON_S)


class MonitoredSpoolRun(SpoolRun):
    """The program of a joint with an encoder; ``closed``: it is ending."""

    def __init__(self, spec: JointSpec, task: SpoolTask, position: float, allowed: Allowed) -> None:
        super().__init__(program_for(spec, task, allowed))
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
        """Adapt the program to the joint's motion; return a problem when the joint moves the wrong way."""
        moved, enough = self._moved(position), _min_travel(self._spec)
        if moved < -enough * (1.0 if self._task.kind == "wiggle" else REBOUND_FACTOR):
            asked, seen = ("plus", "minus") if self._task.side > 0 else ("minus", "plus")
            return Problem(
                "calibration.wrong-direction",
                f"the {self._name} moves the wrong way: its valve was opened to {asked}, its encoder went to {seen}; "
                "look which way it moved: if that was wrong, swap its solenoids (or sign of its valve in the profile), "
                "else direction of its encoder; nothing was corrected",
            )
        if self.closed:
            return None
        if self._task.kind == "wiggle" and moved > enough:
            self.finish(run_s)
            self.closed = True
        elif self._task.kind == "sweep" and moved > SHOWN * enough and self._turns(run_s, velocity):
            self.program = spool_program.reversed_sweep(self.program, run_s)
            self.closed = True
        elif (
            self._task.kind == "staircase" and self._task.side * velocity > ENOUGH_SPEED_SHARE * self._spec.speed_limit
        ):
            self.finish(run_s)
            self.closed = True
        elif run_s >= self.program.duration_s:
            self.closed = True
        return None

    def final_check(self, position: float) -> Problem | None:
        """Check at the end of the program that the joint has moved; return a problem when it has not."""
        if self._moved(position) >= _min_travel(self._spec):
            return None
        top = max(abs(percent) for _, percent in self.program.points)
        why = f"its valve was opened up to {top:.0f} %; check spool, solenoid and plug of its valve, pump and encoder"
        return Problem("calibration.no-motion", f"the {self._name} does not move: {why}")

    def _moved(self, position: float) -> float:
        return self._task.side * (position - self._from)

    def _turns(self, run_s: float, velocity: float) -> bool:
        rising = spool_program.rises(self.program, run_s)
        side = self._task.side
        return rising and side * velocity > REVERSAL_SPEED_SHARE * spool_program.side_limit(self._spec, side)


def _min_travel(spec: JointSpec) -> float:
    """Compute the travel of a joint that certainly moves [rad, m]."""
    return max(MIN_MOVED, MIN_MOVED_S * spec.speed_limit)
