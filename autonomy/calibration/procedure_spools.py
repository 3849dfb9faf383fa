"""The part of a calibration run that moves joints by their spools: programs, travels, and what a wiggle teaches.

See `autonomy.calibration.procedure.Calibration`, of which this is one half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

import msgspec
import numpy as np

from autonomy.calibration.plan import MIN_REACH_M, MoveTask, SpoolTask
from autonomy.calibration.procedure_state import CalibrationState
from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.spool_run import LEAD_S, TAIL_S, SpoolRun, program_for
from autonomy.calibration.spool_travel import Leg, SpoolTravel, best_order
from autonomy.calibration.trace import FINE_FACTOR, GRID_S, SpoolTestRecord
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, joint
from machine.sensing import lever_share

# -- What the first, gentle opening of a valve tells of it: dead-band, full speed and dead time, roughly.
#
# The search (`autonomy.calibration.spool_program.wiggle`) knows nothing: the spool opens slowly from neutral until
# the encoder has moved a little, to either side.  On such a ramp a valve moves its joint along a parabola, whose
# foot is the dead-band and whose curvature is the gain; so both come from one short motion, well enough to plan the
# tests that measure them (dead-band within 2 % of the stroke, full speed within a third).  The dead time is that of
# the spool where the valve node reports it, else it is fitted with the rest.
#
# The profile is not asked.  Whether it may stay in force for ordinary motions is judged by `suits`: a controller
# whose map is farther off would neither follow nor believe what it sees, and the crane travels by its spools
# instead (`autonomy.calibration.spool_travel`).


OIL_S: Final = 0.08
"""Delay of oil, pump and steel between a spool and its joint, roughly."""
SPOOL_LAG_S: Final = 0.04
"""What a spool stays behind its dead time, roughly."""
HALF_PLAY: Final = 0.01
"""Half of a spool's usual hysteresis, share of the stroke."""
DEADBANDS: Final = np.arange(0.005, 0.48, 0.0025)
DELAYS_S: Final = np.arange(0.0, 0.42, 0.01)
USED_S: Final = 1.2
"""The fit uses so much of the record before the joint has moved by `FOOT_SHARE` of its way, and all after it."""
FOOT_SHARE: Final = 0.1
MAX_GAIN_RATIO: Final = 5.0
"""A full speed is believed up to this many times the profile's, or this part of it."""
SUITED_DEADBAND: Final = 0.045
SUITED_GAIN: Final = 1.6
SUITED_DELAY_S: Final = 0.17
"""Differences from the profile, and the dead time, up to which a controller's laws and monitors take it for the same
valve: the spread of one machine's kind, and what the search itself may be wrong."""


@dataclass(frozen=True, slots=True)
class RoughSide:
    """One side of a valve: dead-band [share of the stroke], full speed [rad/s, m/s] and dead time [s]."""

    deadband: float
    full_speed: float
    delay_s: float


def rough_side(test: SpoolTestRecord) -> RoughSide:
    """Evaluate what the search to one side tells."""
    side = test.side
    travel = side * (test.position - float(np.mean(test.position[:10])))
    if test.spool is None:
        best = min((_fit(side * test.command, travel, delay_s) for delay_s in DELAYS_S), key=lambda found: found[0])
        return RoughSide(best[1], best[2], max(best[3] - OIL_S - SPOOL_LAG_S, 0.0))
    _, deadband, full_speed, _ = min(
        (_fit(side * test.spool, travel, s) for s in (0.0, OIL_S)), key=lambda found: found[0]
    )
    return RoughSide(deadband, full_speed, _spool_delay_s(test))


def _fit(spool: np.ndarray, way: np.ndarray, delay_s: float) -> tuple[float, float, float, float]:
    """Fit a parabola for a delay of ``way`` behind ``spool``; return misfit, dead-band, full speed and the delay."""
    shift = round(delay_s / GRID_S)
    delayed_spool = np.concatenate([np.zeros(shift), spool])[: len(way)]
    foot_index = int(np.argmax(way > FOOT_SHARE * float(np.max(way))))
    used = slice(max(0, foot_index - round(USED_S / GRID_S)), None)
    edges = HALF_PLAY + DEADBANDS[:, None]
    opening = np.clip(delayed_spool[None, :] - edges, 0.0, None) / (1.0 - edges)
    unit_travels = np.cumsum(opening, axis=1)[:, used] * GRID_S
    measured_travel = way[used]
    gains = np.maximum(unit_travels @ measured_travel, 0.0) / np.maximum(np.sum(unit_travels**2, axis=1), 1e-12)
    misfits = np.sum((gains[:, None] * unit_travels - measured_travel[None, :]) ** 2, axis=1)
    best = int(np.argmin(misfits))
    return float(misfits[best]), float(DEADBANDS[best]), float(gains[best]), delay_s


def _spool_delay_s(test: SpoolTestRecord) -> float:
    """Measure the dead time of a reported spool behind its command, s."""
    assert test.spool is not None
    step_s = GRID_S / FINE_FACTOR
    time_s = np.arange(len(test.fine_command)) * step_s
    at_s = time_s[FINE_FACTOR - 1 :: FINE_FACTOR]
    late_s = np.arange(0.0, 0.45, 0.005)
    misfits = [float(np.sum((np.interp(at_s - s, time_s, test.fine_command) - test.spool) ** 2)) for s in late_s]
    return max(float(late_s[int(np.argmin(misfits))]) - SPOOL_LAG_S, 0.0)


def rough_spec(which: Joint, spec: JointSpec, plus: SpoolTestRecord, minus: SpoolTestRecord) -> JointSpec:
    """Return the joint with the valve that searches to both sides show; speeds where a lever has its nominal arm."""
    sides = (rough_side(plus), rough_side(minus))
    arm = lever_share(spec.valve, float(np.mean(plus.position)))
    known = (spec.valve.full_speed_plus, spec.valve.full_speed_minus)
    fulls = [
        min(max(arm * s.full_speed, known[i] / MAX_GAIN_RATIO), known[i] * MAX_GAIN_RATIO) for i, s in enumerate(sides)
    ]
    valve = msgspec.structs.replace(
        spec.valve,
        deadband_plus_pct=100.0 * sides[0].deadband,
        deadband_minus_pct=100.0 * sides[1].deadband,
        full_speed_plus=fulls[0],
        full_speed_minus=fulls[1],
        delay_s=0.5 * (sides[0].delay_s + sides[1].delay_s),
    )
    return msgspec.structs.replace(spec, valve=valve)


def suits(profile: JointSpec, found: JointSpec) -> bool:
    """Tell whether the profile's valve is near enough to the one that was found to move the joint by its map."""
    a, b = profile.valve, found.valve
    deadbands = ((a.deadband_plus_pct, b.deadband_plus_pct), (a.deadband_minus_pct, b.deadband_minus_pct))
    fulls = ((a.full_speed_plus, b.full_speed_plus), (a.full_speed_minus, b.full_speed_minus))
    near = all(abs(x - y) <= 100.0 * SUITED_DEADBAND for x, y in deadbands)
    alike = all(1.0 / SUITED_GAIN <= x / y <= SUITED_GAIN for x, y in fulls)
    return near and alike and b.delay_s <= SUITED_DELAY_S


# -- The part of a calibration run that moves joints by their spools


SLOW_SHARE, NARROW_PCT = 0.6, 5.0
"""A side of a valve with less than this share of the profile's full speed is slow: on what a sweep lets through its
joint goes a shorter way, and the encoder's noise counts for more.  A dead-band narrower than the second is not much
wider than the spool's play.  Elsewhere one sweep is better: two drew a full speed down by 2.5 % (measured)."""


class SpoolTasks(CalibrationState):
    """Joints, their programs and their travels by spools."""

    def _position(self) -> tuple[float, ...]:
        """Return the measured joints; one without an encoder at 0."""
        assert self._report is not None
        return tuple(p if isfinite(p) else 0.0 for p in self._report.position)

    def _spec(self, which: Joint) -> JointSpec:
        """Return the joint as far as it is known: with the valve its wiggles have shown, else with the profile's."""
        return self.found.specs.get(which) or joint(self._profile, which)

    def _program(self, task: SpoolTask) -> SpoolProgram:
        return program_for(self._spec(task.joint), task, self._allowed[task.joint])

    def _travel_to(self, pose: Sequence[float]) -> SpoolTravel:
        """Plan the way to a pose by spools, in the order that keeps the pin clear."""
        sensed = [j for j in JOINTS if joint(self._profile, j).encoder is not None]
        kinematics, start = self._profile.kinematics, self._position()
        order = best_order(kinematics, start, pose, sensed, self._plan.clear_z_m, MIN_REACH_M)
        return SpoolTravel(pose, order)

    def _next_task(self) -> None:
        self._at += 1
        self._entered = False
        self.wants_reading = self.wants_yaw = False

    def _run_travel(self, task: MoveTask, now_ns: int) -> bytes | None:
        """Travel leg after leg to the pose."""
        assert self._travel is not None
        if not isinstance(self._spool, Leg):
            leg = self._travel.next_leg(self._position(), [self._spec(j) for j in JOINTS], self._allowed)
            if leg is None:
                if (stuck := self._travel.stuck) is None:
                    self._next_task()
                else:
                    why = f"the {stuck.name.lower()} did not reach its place {task.why}; look for an obstacle or play"
                    self.abort(why, "calibration.travel-stuck")
                return None
            self._spool, self._driven, self._task_ns = leg, leg.joint, now_ns
        leg, run_s = self._spool, self._run_s(now_ns)
        assert self._report is not None
        leg.follow(run_s, self._position()[leg.joint], self._report.velocity[leg.joint])
        if run_s >= leg.program.duration_s + TAIL_S:
            self._spool = self._driven = None
            return None
        return self._spool_datagram(leg, leg.joint, run_s, now_ns)

    def _run_s(self, now_ns: int) -> float:
        """Return the time of the running spool program, s."""
        run_s = (now_ns - self._task_ns) * 1e-9 - LEAD_S
        assert self._spool is not None
        if run_s >= 0.0 and not self._spool.begun:
            # However late this tick is, the program starts from its beginning.
            self._spool.begun, self._task_ns, run_s = True, now_ns - round(LEAD_S * 1e9), 0.0
        return run_s

    def _spool_datagram(self, run: SpoolRun, which: Joint, run_s: float, now_ns: int) -> bytes | None:
        """Send a changed program at once, and its end always, however late this tick is."""
        if run.is_silent(run_s) or not (self._stream.due(now_ns) or run.changed):
            return None
        return self._stream.spool(now_ns, which, run.window(run_s))

    def _learn(self, which: Joint) -> None:
        """Keep what both wiggles of a joint show of its valve."""
        plus, minus = self.found.wiggles[-2:]
        profile = joint(self._profile, which)
        learned_spec = rough_spec(which, profile, plus, minus)
        self.found.specs[which] = learned_spec
        self._sweep_weak_sides_again(which, profile, learned_spec)
        self.found.travelled_by_spool = self.found.travelled_by_spool or not suits(profile, learned_spec)

    def _sweep_weak_sides_again(self, which: Joint, profile: JointSpec, found: JointSpec) -> None:
        """Plan a second sweep of each side of which one alone leaves the dead-band too uncertain."""
        sides = (
            (+1, found.valve.full_speed_plus / profile.valve.full_speed_plus, found.valve.deadband_plus_pct),
            (-1, found.valve.full_speed_minus / profile.valve.full_speed_minus, found.valve.deadband_minus_pct),
        )
        for side, speed_share, deadband_pct in sides:
            sweep = SpoolTask(which, side, "sweep")
            weak = speed_share < SLOW_SHARE or deadband_pct < NARROW_PCT
            if weak and sweep in self._tasks[self._at :]:
                self._tasks.insert(self._tasks.index(sweep, self._at), sweep)
