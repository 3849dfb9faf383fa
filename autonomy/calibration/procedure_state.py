"""State of a calibration run: its parts, and what a person reads of it."""

from __future__ import annotations

from typing import Final

from autonomy.calibration.plan import CalibrationPlan
from autonomy.calibration.rotator_turns import RotatorTurns
from autonomy.calibration.spool_program import allowed_by
from autonomy.calibration.spool_run import SpoolRun
from autonomy.calibration.spool_travel import SpoolTravel
from autonomy.calibration.tasks import (
    Findings,
    Task,
    build_tasks,
)
from autonomy.calibration.trace import BusTrace
from autonomy.motion.arm import Arm
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold
from can_dbc.dbc.codec import Database
from can_dbc.messages.crane import StateReport
from machine.geometry.kinematics import Point
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint
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
