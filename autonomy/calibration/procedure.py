"""The calibration as a pure state machine: reports and bus frames in, setpoints out, a list of test records at the end.

``Calibration.step`` returns the datagram to send now, or None.  The procedure waits until a person has armed.  Then it
wiggles every joint: it opens the valve slowly from neutral until the joint moves, knowing nothing of the valve, sees
that it moves the right way and learns roughly what valve it is.  It takes joint after joint to its pose, by an ordinary
trajectory where the controller's profile suits the valves, else by the spools, and runs its slow sweep and its
staircase on either side as spool tests.  It closes and opens the grapple, and stands at the survey poses.  A rotator
without an encoder turns there and back at the last of them, while the surveyor reads the grapple's direction at every
rest.  One function moves at a time.

Failure: a stop, a refusal, a joint that moves the wrong way or not at all, or too little room ends the run with a
sentence in ``failure``; ``abort`` closes the valve and ends it.  A run that has ended does not continue.  A stop whose
cause lies outside of the machine's motion (`INTERRUPTIONS`: a lost message, a person in the zone) only interrupts a run
with ``patience_s``: once a person has reset and armed in that time, it repeats the interrupted test.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, isnan
from typing import Final

from autonomy.calibration.plan import (
    BEGIN_SHARE,
    GrappleTask,
    MoveTask,
    PinReadingTask,
    PulseTask,
    SpoolTask,
    Task,
    TurnSearchTask,
    YawReadingTask,
)
from autonomy.calibration.procedure_spools import SpoolTasks
from autonomy.calibration.procedure_state import INTERRUPTIONS
from autonomy.calibration.spool_run import LEAD_S, TAIL_S, MonitoredSpoolRun, SpoolRun
from autonomy.calibration.survey import SurveyReading
from autonomy.motion.trajectory import hold, joint_motion
from can_dbc.frame import Frame
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.kinematics import Point
from machine.joints import JOINTS, Joint
from machine.profile import joint
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import Problem

SETTLE_S: Final = 0.4
SURVEY_SETTLE_S: Final = 1.5
YAW_SETTLE_S: Final = 0.4
"""The grapple settles soon after a turn: nothing but its rotator has moved."""
READING_PERIOD_NS: Final = 100_000_000
SURVEY_TIMEOUT_NS: Final = 60_000_000_000
"""An instrument that gives no reading for this time ends the run; a person who types one reading a pose does not."""
REPORT_TIMEOUT_NS: Final = 300_000_000
GRAPPLE_TIMEOUT_S: Final = 12.0
MIN_GRAPPLE_S, UNSENSED_EXTRA_S = 0.5, 1.0
ARRIVAL_TOLERANCE: Final = (0.02, 0.02, 0.03, 0.03, 0.08)
EXPECTED_PULSE_S: Final = 2.0
"""Approximate duration of a pulse."""
_TIMEOUT_FACTOR: Final = 2.0
_TIMEOUT_EXTRA_S: Final = 20.0
"""Extra time, as a joint whose dead-band is unknown may have to inch to its goal."""
_BRAKE_S: Final = 0.8
_UNREPEATABLE: Final = (PulseTask, TurnSearchTask, YawReadingTask)
"""Tasks that count a joint without an encoder from where it was: after a stop nobody knows where it is."""
_STATE_OPEN, _STATE_CLOSED_EMPTY, _STATE_HOLDING = 1, 4, 5  # GrappleStat.State
_MAX_TICK_S: Final = 0.1


class Calibration(SpoolTasks):
    """One run.

    ``task`` is the present task (None before and after), ``failure`` why the run ended early and ``failure_code`` its
    code, ``done`` whether it is complete.  ``wants_reading`` requests the pin's position from the surveyor now,
    ``wants_yaw`` the direction along which the grapple opens.
    """

    def remaining_s(self) -> float:
        """Estimate the duration of the rest, s."""
        return sum(self._expected_s(task) for task in self._tasks[self._at :])

    def step(
        self,
        now_ns: int,
        report: StateReport | None,
        frames: Sequence[Frame] = (),
        survey: Point | None = None,
        yaw_rad: float | None = None,
    ) -> bytes | None:
        """Execute one tick (20 Hz or faster) and return the datagram to send now, or None.

        ``survey`` and ``yaw_rad`` are the surveyor's answers, base frame, m and rad modulo pi; NaN: the direction
        cannot be read, and the rotator is not tested.
        """
        self.trace.accept(frames)
        dt_s = min((now_ns - (self._last_ns or now_ns)) * 1e-9, _MAX_TICK_S)
        self._last_ns = now_ns
        if report is not None:
            self._report, self._report_ns = report, now_ns
        if self.idle:
            return None
        blocked = self._blocked_reason(now_ns)
        if blocked is not None:
            self._interrupt(blocked, now_ns)
            return None
        if self._interrupted_ns is not None:
            self._repeat_task()
        self._waiting = None
        if self.begun_ns is None:
            self.begun_ns = now_ns
        self.elapsed_s = (now_ns - self.begun_ns) * 1e-9
        self._check_refusals()
        if self._failure is not None:
            return self._brake(now_ns, dt_s)
        if self.done:
            self.idle = True
            return None
        while not self._entered and not self.done:
            self._enter(now_ns)
        if self.done:
            return None
        return self._run_task(now_ns, dt_s, survey, yaw_rad)

    def _blocked_reason(self, now_ns: int) -> Problem | None:
        report = self._report
        if report is None:
            return Problem("calibration.no-report", "the controller has not reported")
        if now_ns - self._report_ns > REPORT_TIMEOUT_NS:
            return Problem("calibration.controller-silent", "the controller is silent")
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            name = next((mode.name for mode in Mode if mode == report.mode), str(report.mode))
            stopped = report.mode in (Mode.STOP, Mode.FAULT)
            why = f": {describe(report.reason)}" if stopped else ""
            return Problem("calibration.controller-mode", f"the controller is in {name}{why}")
        sensed = (p for j, p in zip(JOINTS, report.position, strict=True) if joint(self._profile, j).encoder)
        if all(map(isfinite, sensed)):
            return None
        return Problem("calibration.position-unknown", "a joint position is unknown")

    def _interrupt(self, blocked: Problem, now_ns: int) -> None:
        """Wait before the start; end a run that was interrupted, unless it may go on."""
        self._waiting = blocked
        self.wants_reading = self.wants_yaw = False
        if self.begun_ns is None:
            return
        since_ns = now_ns if self._interrupted_ns is None else self._interrupted_ns
        if self._may_go_on() and now_ns - since_ns < self._patience_ns:
            again = f"reset and arm within {self._patience_ns * 1e-9:.0f} s of the stop, and it repeats this test"
            self._interrupted_ns = since_ns
            self._waiting = Problem(blocked.code, f"{blocked.sentence}; {again}")
        else:
            self._failure = self._failure or blocked
            self.idle = True

    def _may_go_on(self) -> bool:
        """Tell whether the present stop, or the pause after one, leaves what was measured valid."""
        if self._failure is not None or self._report is None or isinstance(self.task, _UNREPEATABLE):
            return False
        paused = self._report.mode == Mode.STANDBY and self._interrupted_ns is not None
        return paused or self._report.reason & 0xFF in INTERRUPTIONS

    def _repeat_task(self) -> None:
        """Do the interrupted task once more, from where it began: the crane may have moved since."""
        self.resumptions += 1
        self._interrupted_ns = self._refused = None
        self._spool = self._driven = None
        self._entered = self._at_end = False
        task = self.task
        wiggles = isinstance(task, SpoolTask) and task.kind == "wiggle"  # goes a hand's breadth, from anywhere
        if self._began_at is not None and not wiggles and not isinstance(task, MoveTask | None):
            self._tasks.insert(self._at, MoveTask(self._began_at, "back to the interrupted test"))

    def _check_refusals(self) -> None:
        assert self._report is not None
        before, self._refused = self._refused, self._report.refused
        strangers = self._report.refusal == Reason.DATAGRAM_AUTHENTICATION  # whom every process can be
        if before is not None and self._report.refused != before and not strangers:
            self.abort(describe(self._report.refusal), "calibration.setpoint-refused")

    def _expected_s(self, task: Task) -> float:
        match task:
            case SpoolTask():
                whole = LEAD_S + self._program(task).duration_s + TAIL_S
                return 0.75 * whole if task.kind != "staircase" else whole
            case MoveTask():
                return 4.0
            case GrappleTask():
                return 1.2 * self._profile.grapple.close_time_s
            case PulseTask():
                return LEAD_S + EXPECTED_PULSE_S + TAIL_S
            case TurnSearchTask():
                return 0.0  # most are left out
            case YawReadingTask():
                return YAW_SETTLE_S + self._readings * READING_PERIOD_NS * 1e-9
        return SURVEY_SETTLE_S + self._readings * READING_PERIOD_NS * 1e-9

    def _enter(self, now_ns: int) -> None:
        """Begin the task."""
        self._driven = None
        self._entered, self._task_ns = True, now_ns
        self._clock_s, self._rate = 0.0, 1.0
        task = self._tasks[self._at]
        assert self._report is not None
        self._began_at = None if isinstance(task, MoveTask) else self._position()
        follows = self._report.mode == Mode.ACTIVE and all(map(isfinite, self._report.reference[:4]))
        start = tuple(r if isfinite(r) else 0.0 for r in self._report.reference) if follows else self._position()
        match task:
            case MoveTask():
                if self.found.travelled_by_spool:
                    self._travel = self._travel_to(task.pose)
                    self._spool = None
                else:
                    self._motion = joint_motion(self._arm, start, task.pose)
            case SpoolTask():
                spec, allowed = self._spec(task.joint), self._allowed[task.joint]
                self._spool = MonitoredSpoolRun(spec, task, self._position()[task.joint], allowed)
                self._driven = task.joint
                self._check_room(task, self._spool.end)
            case PulseTask():
                if (program := self._turning.program(task)) is None:
                    del self._tasks[self._at : self._at + 2]  # the pulse, and the reading after it
                    self._entered = False
                    return
                self._spool, self._driven = SpoolRun(program), task.joint
            case TurnSearchTask():
                self._spool, self._driven = SpoolRun(self._turning.search(task)), task.joint
            case _:
                self._motion = hold(start)
                self._points, self._poses, self._point_ns = [], [], 0

    def _check_room(self, task: SpoolTask, end: float) -> None:
        """Move a test that might reach the end of the joint's range farther away, or end the run."""
        spec, plan = self._spec(task.joint), self._plans[task.joint]
        if task.kind == "wiggle" or spec.lower < end < spec.upper:
            return
        aside = BEGIN_SHARE * (plan.high - plan.low)
        start = list(self._position())
        stands = start[task.joint]
        start[task.joint] = plan.low + aside if task.side > 0 else plan.high - aside
        name = task.joint.name.lower()
        if abs(start[task.joint] - stands) < 3.0 * ARRIVAL_TOLERANCE[task.joint]:
            why = f"it would end at {end:.2f}, beyond its stop"
            self.abort(f"the {name} has no room for its {task.kind}: {why}", "calibration.no-room")
            return
        self._tasks.insert(self._at, MoveTask(tuple(start), f"back for more room of the {name}"))
        self._enter(self._task_ns)

    def _run_task(self, now_ns: int, dt_s: float, survey: Point | None, yaw_rad: float | None) -> bytes | None:
        task = self._tasks[self._at]
        time_s = (now_ns - self._task_ns) * 1e-9
        match task:
            case SpoolTask() | PulseTask() | TurnSearchTask():
                return self._run_spool(task, now_ns)
            case MoveTask() if self.found.travelled_by_spool:
                return self._run_travel(task, now_ns)
            case MoveTask():
                self._clock_s += dt_s
                if self._clock_s >= self._motion.duration_s + SETTLE_S and self._arrived():
                    self._next_task()
                elif self._clock_s > _TIMEOUT_FACTOR * self._motion.duration_s + _TIMEOUT_EXTRA_S:
                    self.abort(f"the crane did not move {task.why}", "calibration.move-timeout")
                return self._motion_datagram(now_ns, GrappleCommand.NEUTRAL)
            case GrappleTask():
                self._run_grapple(task, time_s)
                return self._motion_datagram(now_ns, task.command)
            case PinReadingTask():
                self._run_pin_reading(task, time_s, now_ns, survey)
                return self._motion_datagram(now_ns, GrappleCommand.NEUTRAL)
            case YawReadingTask():
                self._run_yaw_reading(time_s, now_ns, yaw_rad)
                return self._motion_datagram(now_ns, GrappleCommand.NEUTRAL)
        return None

    def _arrived(self) -> bool:
        return all(
            abs(p - g) <= near
            for j, p, g, near in zip(JOINTS, self._position(), self._motion.goal, ARRIVAL_TOLERANCE, strict=True)
            if self._spec(j).encoder is not None
        )

    def _motion_datagram(self, now_ns: int, grapple: GrappleCommand) -> bytes | None:
        if not self._stream.due(now_ns):
            return None
        return self._stream.datagram(now_ns, self._motion, self._clock_s, grapple, self._rate)

    def _run_spool(self, task: SpoolTask | PulseTask | TurnSearchTask, now_ns: int) -> bytes | None:
        assert self._spool is not None and self._report is not None
        run, position = self._spool, self._position()[task.joint]
        run_s = self._run_s(now_ns)
        if wrong := run.follow(run_s, position, self._report.velocity[task.joint]):
            self.abort(wrong.sentence, wrong.code)
            return None
        if run_s >= run.program.duration_s + TAIL_S:
            self._finish_spool(task, run.final_check(position), now_ns)
            return None
        return self._spool_datagram(run, task.joint, run_s, now_ns)

    def _finish_spool(self, task: SpoolTask | PulseTask | TurnSearchTask, wrong: Problem | None, now_ns: int) -> None:
        if wrong:
            self.abort(wrong.sentence, wrong.code)
            return
        if isinstance(task, PulseTask | TurnSearchTask):
            kind = "pulse" if isinstance(task, PulseTask) else "search"
            self._turning.pulse_finished(self.trace.test(task.joint, task.side, kind, self._task_ns, now_ns))
            self._next_task()
            return
        test = self.trace.test(task.joint, task.side, task.kind, self._task_ns, now_ns)
        (self.found.wiggles if task.kind == "wiggle" else self.found.tests).append(test)
        if task.kind == "wiggle" and task.side < 0:
            self._learn(task.joint)
        self._next_task()

    def _run_grapple(self, task: GrappleTask, time_s: float) -> None:
        """Wait until the valve node reports the end position; only a time from end to end counts.

        A grapple without an opening sensor opens for the profile's time and may stop short of its end: then its opening
        time stays unknown, and so does the next closing time.
        """
        state = self.trace.grapple_state.values[-1] if self.trace.grapple_state.values else 0.0
        opens, grapple = task.command is GrappleCommand.OPEN, self._profile.grapple
        if time_s > MIN_GRAPPLE_S and state in ((_STATE_OPEN,) if opens else (_STATE_CLOSED_EMPTY, _STATE_HOLDING)):
            if self._at_end:
                self.found.grapple_s[task.command] = time_s
            self._at_end = True
            self._next_task()
        elif opens and not grapple.opening_sensor and time_s > grapple.open_time_s + UNSENSED_EXTRA_S:
            self._at_end = False
            self._next_task()
        elif time_s > GRAPPLE_TIMEOUT_S:
            verb = task.command.name.lower()
            self.abort(f"the grapple did not {verb} within {GRAPPLE_TIMEOUT_S:.0f} s", "calibration.grapple-timeout")

    def _run_pin_reading(self, task: PinReadingTask, time_s: float, now_ns: int, survey: Point | None) -> None:
        self.wants_reading = time_s >= SURVEY_SETTLE_S and now_ns >= self._point_ns
        if survey is None or time_s < SURVEY_SETTLE_S:
            self._check_instrument(now_ns)
            return
        self._points.append(survey)
        self._poses.append(self._position())
        self._point_ns = now_ns + READING_PERIOD_NS
        if len(self._points) >= self._readings:
            count = len(self._points)
            x, y, z = (sum(p[i] for p in self._points) / count for i in range(3))
            position = tuple(sum(q[j] for q in self._poses) / count for j in JOINTS)
            since_ns = self._task_ns + round(SURVEY_SETTLE_S * 1e9)
            moment_nm = self.trace.lift_moment_nm(position[Joint.LIFT], since_ns, now_ns)
            self.found.readings.append(SurveyReading(position, (x, y, z), moment_nm))
            self._next_task()

    def _run_yaw_reading(self, time_s: float, now_ns: int, yaw_rad: float | None) -> None:
        self.wants_yaw = time_s >= YAW_SETTLE_S and now_ns >= self._point_ns
        if yaw_rad is None or time_s < YAW_SETTLE_S:
            self._check_instrument(now_ns)
            return
        if isnan(yaw_rad):
            del self._tasks[self._at :]  # only the rotator's turns are left
            self.wants_yaw = False
            return
        self._point_ns = now_ns + READING_PERIOD_NS
        if self._turning.add_reading(yaw_rad, self._position()[Joint.SLEW]) >= self._readings:
            if wrong := self._turning.finish_rest():
                self.abort(wrong.sentence, wrong.code)
                return
            self._next_task()
            self._skip_found_sides()

    def _check_instrument(self, now_ns: int) -> None:
        if self._readings > 1 and now_ns - max(self._task_ns, self._point_ns) > SURVEY_TIMEOUT_NS:
            why = "check that it listens at the address of --survey and sees its target"
            limit_s = SURVEY_TIMEOUT_NS * 1e-9
            self.abort(f"no instrument gave a reading within {limit_s:.0f} s; {why}", "calibration.survey-timeout")

    def _skip_found_sides(self) -> None:
        """Leave out the rest of a search that has turned the joint."""
        while isinstance(task := self._tasks[self._at] if self._at < len(self._tasks) else None, TurnSearchTask):
            if not self._turning.is_found(task.side):
                return
            del self._tasks[self._at : self._at + 2]  # the ramp, and the reading after it

    def _brake(self, now_ns: int, dt_s: float) -> bytes | None:
        """End a failed run: close the valve, or brake the motion on its path."""
        task = self._tasks[self._at] if self._at < len(self._tasks) else None
        if self._driven is not None and self._entered:
            run_s = (now_ns - self._task_ns) * 1e-9 - LEAD_S
            assert self._spool is not None
            if self._rate != 0.0:
                self._rate = 0.0
                self._spool.close(run_s)
            if run_s > self._spool.program.duration_s:
                self.idle = True
                return None
            return self._stream.spool(now_ns, self._driven, self._spool.window(run_s))
        if isinstance(task, MoveTask) and self.found.travelled_by_spool:
            self.idle = True  # between two legs: every valve is shut
            return None
        if task is None or not self._entered or self._rate == 0.0:
            self.idle = True
            return None
        self._clock_s += self._rate * dt_s
        self._rate = max(0.0, self._rate - dt_s / _BRAKE_S)
        if self._rate == 0.0:
            self._motion = hold(self._motion.at(self._clock_s)[0])
        return self._motion_datagram(now_ns, GrappleCommand.NEUTRAL)
