"""The step of one joint, as a pure state machine: out by an amount, rest, back, rest, and what came of it.

It is a planner like any other: its setpoints go to the controller, which checks and refuses them, and it needs the
controller's ARMED.  All other joints keep their places.  Everything that is shown comes from the state reports
(reference, response) and from the bus (valve commands, spools, pressures).

Failure: a stop, a refusal or a silent controller ends the test with a sentence in ``failure``; ``abort`` brakes the
joint on its path and ends it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np

from autonomy.calibration.loop_gain import margins
from autonomy.calibration.plan import free_range
from autonomy.calibration.trace import BusTrace, SignalColumn
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.setpoint_stream import Axes, SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, joint_motion
from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused, Problem

REST_S: Final = 1.5
"""At either end, so that the joint comes to rest and its error is seen."""
MEAN_S: Final = 0.5
"""The error at rest is the mean of the last part of the rest."""
LARGEST_SHARE: Final = 0.15
"""Of the joint's range: a larger step says no more."""
BRAKE_S: Final = 0.8
REPORT_TIMEOUT_NS: Final = 300_000_000
BEGUN_SHARE: Final = 0.1
"""A motion is seen to have begun at this share of its way."""
_PRESSURES: Final = ("PressA", "PressB")
_MAX_TICK_S: Final = 0.1
_NS: Final = 1e-9


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step showed.

    ``series`` by name: reference, position [rad or m], command, spool [%], pressure_a, pressure_b [bar]; each on
    ``time_s``, NaN where nothing was measured.
    """

    joint: Joint
    amount: float
    time_s: np.ndarray
    series: dict[str, np.ndarray]
    largest_error: float
    """Between reference and position, [rad, m]."""
    rest_error: float
    """Mean distance at the rests, [rad, m]."""
    overshoot: float
    """Beyond the goal and back beyond the start, [rad, m]."""
    delay_s: float
    """From the reference's to the joint's first tenth of the way out."""
    largest_command_pct: float


class PressureTrace:
    """The pressures of one joint's cylinder as its bus tells them.

    ``sides``: the columns of the sides A and B of a joint, bar; empty where nothing measures them.
    """

    def __init__(self, database: Database, joint_name: str) -> None:
        self.sides = (SignalColumn(), SignalColumn())
        names = [f"{joint_name.capitalize()}{side}" for side in "AB"]
        codecs = [database.message(name) for name in _PRESSURES]
        self._codecs = [c for c in codecs if names[0] in c.index]
        self._at = [[c.index[name] for name in names] for c in self._codecs]

    @property
    def keys(self) -> tuple[int, ...]:
        """The keys of the frames that it uses."""
        return tuple(c.key for c in self._codecs)

    def accept(self, frames: Iterable[Frame]) -> None:
        """Store frames as they arrive; others are ignored."""
        for stamp_ns, key, data in frames:
            for codec, at in zip(self._codecs, self._at, strict=True):
                if key != codec.key or len(data) != codec.length:
                    continue
                values = codec.decode(data)
                for index, column in zip(at, self.sides, strict=True):
                    if values[index] is not None:
                        column.add(stamp_ns, float(values[index]))


class _ThereAndBack:
    """Out, rest, back, rest."""

    def __init__(self, out: Trajectory, back: Trajectory) -> None:
        self._out, self._back = out, back
        self._turn_s = out.duration_s + REST_S
        self.duration_s = self._turn_s + back.duration_s + REST_S

    def at(self, time_s: float) -> tuple[Axes, Axes]:
        """Return positions and velocities."""
        return self._out.at(time_s) if time_s < self._turn_s else self._back.at(time_s - self._turn_s)


class StepTest:
    """One test.  ``idle``: nothing more will be sent; ``done``: it was made as a whole."""

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        which: Joint,
        amount: float,
        database: Database,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
    ) -> None:
        """Step ``which`` by ``amount`` [rad, m].

        Raises:
            InputRefused: the joint cannot be seen to step, or the amount is too large.
        """
        spec, name = joint(profile, which), which.name.lower()
        if spec.encoder is None:
            raise InputRefused("step.no-encoder", f"the {name} has no encoder, so its step could not be seen")
        self.largest = largest_step(profile, which)
        if not 0.0 < abs(amount) <= self.largest:
            raise InputRefused("step.amount", f"a step of the {name} is at most {self.largest:.3f}, not {amount:+.3f}")
        self.joint, self.amount = which, amount
        self.done = self.idle = False
        self.begun_ns: int | None = None
        self._profile, self._spec = profile, spec
        self._arm, self._stream = Arm(profile), SetpointStream(profile_hash, lease_ns, key)
        self._trace, self._pressures = BusTrace(profile, database), PressureTrace(database, name)
        self._motion: _ThereAndBack | Trajectory = hold((0.0,) * len(JOINTS))
        self._clock_s, self._rate, self._last_ns, self._report_ns = 0.0, 1.0, 0, 0
        self._report: StateReport | None = None
        self._refused = 0
        self._failure: Problem | None = None
        self._waiting = "the controller has not reported"
        self._seen: list[tuple[int, float, float]] = []
        self._start = 0.0

    @property
    def failure(self) -> str | None:
        """Why the test ended early."""
        return None if self._failure is None else self._failure.sentence

    @property
    def waiting(self) -> str | None:
        """Why it has not begun."""
        return self._waiting if self.begun_ns is None and not self.idle else None

    @property
    def progress(self) -> float:
        """Share that is done."""
        return 0.0 if self.begun_ns is None else min(1.0, self._clock_s / self._motion.duration_s)

    @property
    def keys(self) -> tuple[int, ...]:
        """The keys of the frames that it uses."""
        return (*self._trace.keys, *self._pressures.keys)

    def abort(self, reason: str) -> None:
        """Brake the joint on its path, and end."""
        if self._failure is None and not self.done:
            self._failure = Problem("step.aborted", reason)
            self.idle = self.idle or self.begun_ns is None

    def step(self, now_ns: int, report: StateReport | None, frames: Sequence[Frame] = ()) -> bytes | None:
        """Take one step, 20 Hz or faster; return the datagram to send now, or None."""
        self._trace.accept(frames)
        self._pressures.accept(frames)
        dt_s = min((now_ns - (self._last_ns or now_ns)) * _NS, _MAX_TICK_S)
        self._last_ns = now_ns
        if report is not None:
            self._report, self._report_ns = report, now_ns
            if self.begun_ns is not None:
                self._seen.append((report.stamp_ns, report.reference[self.joint], report.position[self.joint]))
        if self.idle:
            return None
        if blocked := self._blocked(now_ns):
            self._interrupt(blocked)
            return None
        if self.begun_ns is None and not self._begin(now_ns):
            return None
        return self._drive(now_ns, dt_s)

    def result(self) -> StepResult:
        """Evaluate what a done test showed."""
        assert self.begun_ns is not None and self.done
        times = np.array([stamp_ns - self.begun_ns for stamp_ns, _, _ in self._seen]) * _NS
        reference, position = (np.array([s[i] for s in self._seen]) for i in (1, 2))
        series = {"reference": reference, "position": position}
        columns = {
            "command": (self._trace.commands[self.joint], 100.0),
            "spool": (self._trace.spools[self.joint], 100.0),
            "pressure_a": (self._pressures.sides[0], 1.0),
            "pressure_b": (self._pressures.sides[1], 1.0),
        }
        for name, (column, scale) in columns.items():
            at, values = column.between(self.begun_ns, self._last_ns + 1)
            series[name] = np.interp(times, at, scale * values) if len(at) else np.full_like(times, np.nan)
        error = reference - position
        turn_s, end_s = self._motion.duration_s / 2, self._motion.duration_s
        rests = [(times > t - MEAN_S) & (times <= t) for t in (turn_s, end_s)]
        travel = (position - self._start) * np.sign(self.amount)
        out = times <= turn_s
        return StepResult(
            self.joint,
            self.amount,
            times,
            series,
            largest_error=float(np.nanmax(np.abs(error))),
            rest_error=float(max(np.nanmean(np.abs(error[r])) for r in rests)),
            overshoot=float(max(0.0, np.nanmax(travel[out]) - abs(self.amount), -np.nanmin(travel))),
            delay_s=_first(times, travel, abs(self.amount))
            - _first(times, (reference - self._start) * np.sign(self.amount), abs(self.amount)),
            largest_command_pct=float(np.nanmax(np.abs(series["command"]))),
        )

    def _blocked(self, now_ns: int) -> Problem | None:
        report = self._report
        if report is None:
            return Problem("step.no-report", "the controller has not reported")
        if now_ns - self._report_ns > REPORT_TIMEOUT_NS:
            return Problem("step.controller-silent", "the controller is silent")
        ready = (Mode.ARMED,) if self.begun_ns is None else (Mode.ARMED, Mode.ACTIVE)
        if report.mode not in ready:
            name = Mode(report.mode).name if report.mode in set(Mode) else str(report.mode)
            why = f": {describe(report.reason)}" if report.mode in (Mode.STOP, Mode.FAULT) else ""
            return Problem("step.controller-mode", f"the controller is in {name}{why}")
        sensed = (p for j, p in zip(JOINTS, report.position, strict=True) if joint(self._profile, j).encoder)
        if not all(map(isfinite, sensed)):
            return Problem("step.position-unknown", "a joint position is unknown")
        strangers = report.refusal == Reason.DATAGRAM_AUTHENTICATION  # whom every process can be
        if self.begun_ns is not None and report.refused != self._refused and not strangers:
            return Problem("step.refused", describe(report.refusal))
        return None

    def _interrupt(self, blocked: Problem) -> None:
        """Wait before the start; end a test that was interrupted."""
        self._waiting = blocked.sentence
        if self.begun_ns is not None:
            self._failure, self.idle = self._failure or blocked, True

    def _begin(self, now_ns: int) -> bool:
        assert self._report is not None
        start = [
            p if isfinite(p) else r if isfinite(r) else 0.0
            for p, r in zip(self._report.position, self._report.reference, strict=True)
        ]
        goal = list(start)
        goal[self.joint] += self.amount
        low, high = free_range(self._spec)
        if not low <= goal[self.joint] <= high:
            sentence = f"the step would end at {goal[self.joint]:+.2f}, near the stop; step the other way"
            self._failure, self.idle = Problem("step.range", sentence), True
            return False
        self._motion = _ThereAndBack(joint_motion(self._arm, start, goal), joint_motion(self._arm, goal, start))
        self.begun_ns, self._refused, self._start = now_ns, self._report.refused, start[self.joint]
        return True

    def _drive(self, now_ns: int, dt_s: float) -> bytes | None:
        self._clock_s += self._rate * dt_s
        if self._failure is not None:
            self._rate = max(0.0, self._rate - dt_s / BRAKE_S)
            if self._rate == 0.0:
                self.idle = True
                return self._stream.datagram(
                    now_ns, hold(self._motion.at(self._clock_s)[0]), 0.0, GrappleCommand.NEUTRAL, 0.0
                )
        elif self._clock_s >= self._motion.duration_s:
            self.done = self.idle = True
            return None
        if not self._stream.due(now_ns):
            return None
        return self._stream.datagram(now_ns, self._motion, self._clock_s, GrappleCommand.NEUTRAL, self._rate)


def largest_step(profile: Profile, which: Joint) -> float:
    """Return the largest step of a joint [rad, m]."""
    spec = joint(profile, which)
    return LARGEST_SHARE * (spec.upper - spec.lower)


def profile_margins(profile: Profile, which: Joint) -> tuple[float, float]:
    """Compute phase [deg] and gain margin [dB] of a joint's loop with the valve that the profile describes."""
    spec = joint(profile, which)
    return margins(spec.law.kp_1_s, spec.valve.delay_s, spec.valve.lag_s, spec.valve.oil_s)


def _first(times: np.ndarray, way: np.ndarray, whole: float) -> float:
    """Find when a way has passed `BEGUN_SHARE` of the whole; NaN when it never has."""
    passed = np.flatnonzero(way >= BEGUN_SHARE * whole)
    return float(times[passed[0]]) if len(passed) else float("nan")
