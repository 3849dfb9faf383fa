"""The part of a calibration run that moves joints by their spools: programs, travels, and what a wiggle teaches.

See `autonomy.calibration.procedure.Calibration`, of which this is one half.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from autonomy.calibration.plan import MIN_REACH_M
from autonomy.calibration.procedure_state import CalibrationState
from autonomy.calibration.spool_program import SpoolProgram
from autonomy.calibration.spool_run import LEAD_S, TAIL_S, SpoolRun, program_for
from autonomy.calibration.spool_travel import Leg, SpoolTravel, best_order
from autonomy.calibration.tasks import MoveTask, SpoolTask
from autonomy.calibration.valve_search import rough_spec, suits
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, joint

SLOW_SHARE, NARROW_PCT = 0.6, 5.0
"""A side of a valve with less than this share of the profile's full speed is slow: on what a sweep lets through its
joint goes a shorter way, and the encoder's noise counts for more.  A dead-band narrower than the second is not much
wider than the spool's play.  Elsewhere one sweep is better: two drew a full speed down by 2.5 % (measured)."""


class SpoolTasks(CalibrationState):
    """Joints, their programs and their travels by spools."""

    def _position(self) -> tuple[float, ...]:
        """The measured joints; one without an encoder at 0."""
        assert self._report is not None
        return tuple(p if isfinite(p) else 0.0 for p in self._report.position)

    def _spec(self, which: Joint) -> JointSpec:
        """The joint as far as it is known: with the valve that its wiggles have shown, else with the profile's."""
        return self.found.specs.get(which) or joint(self._profile, which)

    def _program(self, task: SpoolTask) -> SpoolProgram:
        return program_for(self._spec(task.joint), task, self._allowed[task.joint])

    def _travel_to(self, pose: Sequence[float]) -> SpoolTravel:
        """The way to a pose by spools, in the order that keeps the pin clear."""
        sensed = [j for j in JOINTS if joint(self._profile, j).encoder is not None]
        kinematics, start = self._profile.kinematics, self._position()
        order = best_order(kinematics, start, pose, sensed, self._plan.clear_z_m, MIN_REACH_M)
        return SpoolTravel(pose, order)

    def _next_task(self) -> None:
        self._at += 1
        self._entered = False
        self.wants_reading = self.wants_yaw = False

    def _run_travel(self, task: MoveTask, now_ns: int) -> bytes | None:
        """Leg after leg to the pose."""
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
        """Time of the running spool program, s."""
        run_s = (now_ns - self._task_ns) * 1e-9 - LEAD_S
        assert self._spool is not None
        if run_s >= 0.0 and not self._spool.begun:
            # However late this tick is, the program starts from its beginning.
            self._spool.begun, self._task_ns, run_s = True, now_ns - round(LEAD_S * 1e9), 0.0
        return run_s

    def _spool_datagram(self, run: SpoolRun, which: Joint, run_s: float, now_ns: int) -> bytes | None:
        """A changed program is sent at once, and its end always, however late this tick is."""
        if run.is_silent(run_s) or not (self._stream.due(now_ns) or run.changed):
            return None
        return self._stream.spool(now_ns, which, run.window(run_s))

    def _learn(self, which: Joint) -> None:
        """Keep what both wiggles of a joint show of its valve."""
        plus, minus = self.found.wiggles[-2:]
        profile = joint(self._profile, which)
        found = rough_spec(which, profile, plus, minus)
        self.found.specs[which] = found
        self._sweep_weak_sides_again(which, profile, found)
        self.found.travelled_by_spool = self.found.travelled_by_spool or not suits(profile, found)

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
