"""State of a calibration run: its parts, and what a person reads of it."""

from __future__ import annotations

from math import pi, remainder
from typing import Final

import numpy as np

from autonomy.calibration.plan import (
    CalibrationPlan,
    Findings,
    PulseTask,
    Task,
    TurnSearchTask,
    build_tasks,
)
from autonomy.calibration.spool_program import (
    TURN_TOPS_PCT,
    SpoolProgram,
    allowed_by,
    predicted_travel,
    turn_search,
)
from autonomy.calibration.spool_run import SpoolRun
from autonomy.calibration.spool_travel import SpoolTravel
from autonomy.calibration.trace import BusTrace, SpoolTestRecord
from autonomy.calibration.turn_fit import Turn, fit_turns, pulse_to
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold
from can_dbc.dbc.codec import Database
from can_dbc.messages.crane import StateReport
from machine.geometry.kinematics import Point
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, Profile, joint
from machine.status.reasons import Reason
from runtime.errors import Problem

READING_COUNT: Final = 8
"""Surveyor's readings at each pose."""
PATIENCE_S: Final = 120.0
"""How long a live run waits, after an interruption, until a person has armed again."""

INTERRUPTIONS: Final = frozenset(
    {
        Reason.ESTOP_LOST,
        Reason.GUARD_LOST,
        Reason.GUARD_REFUSES,
        Reason.SAFETY_NODE_LOST,
        Reason.ENCODER_LOST,
        Reason.ENCODER_NODE_LOST,
        Reason.VALVE_FEEDBACK_LOST,
        Reason.PRESSURE_LOST,
        Reason.PRESSURE_NODE_LOST,
        Reason.GRAPPLE_STATUS_LOST,
        Reason.PERSON_IN_ZONE,
        Reason.BUS_PASSIVE,
        Reason.SEND_REFUSED,
        Reason.LOOP_LATE,
        Reason.LOOP_STALLED,
        Reason.COMPUTER_STALLED,
        Reason.INPUTS_LOST,
        Reason.LEASE_LOST,
    }
)
"""Reasons of a stop that say nothing about the tested joint."""


class CalibrationState:
    """The parts of one run and its readable state; see `autonomy.calibration.procedure.Calibration`."""

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        plan: CalibrationPlan,
        database: Database,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
        asked_readings: int = READING_COUNT,
        patience_s: float = 0.0,
    ) -> None:
        self.trace = BusTrace(profile, database)
        self.found = Findings()
        self._failure: Problem | None = None
        self._waiting: Problem | None = Problem("calibration.no-report", "the controller has not reported")
        self.idle = False
        self.wants_reading = self.wants_yaw = False
        self.begun_ns: int | None = None
        self.elapsed_s = 0.0
        self.resumptions = 0
        self._patience_ns = round(patience_s * 1e9)
        self._interrupted_ns: int | None = None
        self._began_at: tuple[float, ...] | None = None
        self._profile, self._plan = profile, plan
        self._plans = {p.joint: p for p in plan.joints}
        self._tasks = build_tasks(plan)
        self._at = 0
        self._arm = Arm(profile)
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._readings = asked_readings
        self._report: StateReport | None = None
        self._report_ns = 0
        self._refused: int | None = None
        self._task_ns = 0
        self._last_ns: int | None = None
        self._entered = False
        self._motion: Trajectory = hold((0.0,) * len(JOINTS))
        self._clock_s = 0.0
        self._rate = 1.0
        self._spool: SpoolRun | None = None
        self._driven: Joint | None = None
        self._travel: SpoolTravel | None = None
        self._allowed = [allowed_by(joint(profile, j)) for j in JOINTS]
        self._turning = RotatorTurns(joint(profile, Joint.ROT), self.found.turns, self.found.searched)
        self._points: list[Point] = []
        self._point_ns = 0
        self._poses: list[tuple[float, ...]] = []
        self._at_end = False

    @property
    def failure(self) -> str | None:
        """Why the run ended early, or None."""
        return self._failure.sentence if self._failure else None

    @property
    def failure_code(self) -> str | None:
        """The code of ``failure``."""
        return self._failure.code if self._failure else None

    @property
    def waiting(self) -> str | None:
        """Why it waits before the start or after an interruption, or None."""
        return self._waiting.sentence if self._waiting else None

    @property
    def waiting_code(self) -> str | None:
        """The code of ``waiting``."""
        return self._waiting.code if self._waiting else None

    @property
    def done(self) -> bool:
        """Whether every task is done."""
        return self._at >= len(self._tasks) and self._failure is None

    @property
    def task(self) -> Task | None:
        """The present task."""
        return self._tasks[self._at] if self.begun_ns is not None and self._at < len(self._tasks) else None

    @property
    def progress(self) -> tuple[int, int]:
        """Number of tasks done, and of all."""
        return self._at, len(self._tasks)

    def abort(self, reason: str, code: str = "calibration.aborted") -> None:
        """End the run: a spool test closes its valve, a motion brakes on its path."""
        if self._failure is None and not self.done:
            self._failure = Problem(code, reason)


# -- The turns of a rotator without an encoder during the procedure: its angle by the surveyor's readings, and the next
# pulse.
#
# Directions are those of the grapple in the crane's base frame [rad], modulo pi, without the slew.  Nothing here
# sends; the procedure runs the programs.

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
        """Plan the pulse of a task by all turns so far; None where the controller's count leaves too little of it."""
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
        """Plan the next ramp of the search."""
        program = turn_search(self._spec, task.side, task.top_pct, self._allowed)
        self._counted_rad += predicted_travel(program, self._spec, task.side)
        return program

    def is_found(self, side: int) -> bool:
        """Tell whether the search to a side has turned the joint."""
        return side in self._found

    def pulse_finished(self, record: SpoolTestRecord) -> None:
        """Record a pulse that has ended."""
        self._record = record

    def add_reading(self, yaw_rad: float, slew_rad: float) -> int:
        """Add one reading of the direction at rest; return how many there are at this rest."""
        direction = yaw_rad - slew_rad
        first = self._seen[0] if self._seen else direction
        self._seen.append(first + remainder(direction - first, pi))
        return len(self._seen)

    def finish_rest(self) -> Problem | None:
        """Complete the turn before this rest; return the problem when it was no proper turn."""
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
