"""The planner of the experiment: moves from the middle of the trail to a goal, rests there and returns, repeatedly.

`ReachCycles.step` is pure (contract of `hil.harness.lockstep.Planner`): it plans with `autonomy.motion` and streams
windows of the motion every 50 ms, as the autonomy does.  A load is hung on the hook at the start, at rest; the planner
weighs it by the controller's report.  A stop ends the motion in progress as failed; the crane then returns to the start
and continues with the next motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from math import dist, isfinite
from statistics import fmean
from typing import Final

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.setpoint_stream import PERIOD_NS, SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, straight_line
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from experiments.crane_accuracy.measure import NEAR_M
from experiments.crane_accuracy.plan import GOALS_M, Visit, pose_at, start_pose
from machine.geometry.kinematics import Point, pin_position
from machine.geometry.sag import plausible_load_kg
from machine.joints import JOINTS
from machine.profile import Profile, joint
from machine.status.modes import Mode

LEASE_NS: Final = 200_000_000
REST_NS: Final = 3_500_000_000
"""Rest at a goal after the pin by encoders stays near it; the measurement ends 3 s after arrival."""
LONGEST_REST_NS: Final = 10_000_000_000
PAUSE_NS: Final = 1_000_000_000
"""Pause at the start before the next motion."""
LOAD_NS: Final = 5_000_000_000
"""Wait after the load was hung; it is weighed during the last `WEIGH_NS`."""
WEIGH_NS: Final = 2_000_000_000
LATE_NS: Final = 4_000_000_000
"""A reference that is not at its end this long after its planned duration has failed."""
SAME: Final = 1e-6


class Phase(IntEnum):
    """Phase of a cycle."""

    WAIT = 0
    """The controller is not armed."""
    BACK = 1
    PAUSE = 2
    LOAD = 3
    OUT = 4
    REST = 5
    DONE = 6


@dataclass(slots=True)
class Run:
    """One motion to a goal: the request, and when its reference started, ended and its rest ended (0: not yet)."""

    visit: Visit
    goal_m: Point
    motion: Trajectory
    commanded_m: Point
    """Commanded end point of the pin by encoders: offset from the goal if the profile has a sag model."""
    load_kg: float
    """Load that the planner weighed."""
    begun_ns: int
    ended_ns: int = 0
    over_ns: int = 0
    failed: bool = False


@dataclass(slots=True)
class ReachCycles:
    """``runs`` are the motions so far; ``phase`` tells whether the last one is still in progress."""

    profile: Profile
    profile_hash: int
    visits: Sequence[Visit]
    hang: Callable[[float], None]
    """Replaces the load on the hook by one of this mass [kg]."""
    shaped: bool = True
    phase: Phase = Phase.WAIT
    runs: list[Run] = field(default_factory=list)
    _arm: Arm = field(init=False)
    _stream: SetpointStream = field(init=False)
    _motion: Trajectory = field(init=False)
    _report: StateReport | None = None
    _weights: list[float] = field(default_factory=list)
    _hung_kg: float = 0.0
    """Load that hangs on the hook and was weighed."""
    _next: int = 0
    _begun_ns: int = 0
    _stands_ns: int = 0
    _due_ns: int = 0

    def __post_init__(self) -> None:
        self._arm = Arm(self.profile)
        self._stream = SetpointStream(self.profile_hash, LEASE_NS)
        self._motion = hold((0.0,) * len(JOINTS))

    @property
    def done(self) -> bool:
        """Whether all motions were made."""
        return self.phase is Phase.DONE

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Run one planner cycle: the datagram to send now, or None."""
        if report is not None:
            self._report = report
            self._evaluate(report, now_ns)
        if self._report is None or self.phase in (Phase.WAIT, Phase.DONE) or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + PERIOD_NS
        self._proceed(now_ns)
        if self.done:
            return None
        return self._stream.datagram(now_ns, self._motion, (now_ns - self._begun_ns) * 1e-9, GrappleCommand.NEUTRAL)

    def _evaluate(self, report: StateReport, now_ns: int) -> None:
        """Evaluate a report: mode, weight of the load, and whether the pin is away from its rest position."""
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            if self.phase is Phase.OUT or self.phase is Phase.REST:
                self._finish(now_ns, failed=True)
            if not self.done:
                self.phase = Phase.WAIT
        elif self.phase is Phase.WAIT and all(map(isfinite, self._measured(report))):
            self._begin(Phase.BACK, self._return_motion(self._measured(report)), now_ns)
        elif self.phase is Phase.LOAD and now_ns >= self._begun_ns + LOAD_NS - WEIGH_NS:
            self._weights.append(report.load_kg)
        elif self.phase is Phase.REST:
            pin = pin_position(self.profile.kinematics, report.position)
            if dist(pin, self.runs[-1].commanded_m) > NEAR_M:
                self._stands_ns = now_ns

    def _measured(self, report: StateReport) -> tuple[float, ...]:
        """Return the joint positions; a joint without an encoder counts as being where it was commanded."""
        return tuple(
            p if joint(self.profile, j).encoder is not None else q
            for j, p, q in zip(JOINTS, report.position, self._motion.goal, strict=True)
        )

    def _return_motion(self, q: Sequence[float]) -> Trajectory:
        return straight_line(self._arm, self._arm.pose(q), start_pose(self._arm))

    def _begin(self, phase: Phase, motion: Trajectory, now_ns: int) -> None:
        self.phase, self._motion, self._begun_ns, self._stands_ns = phase, motion, now_ns, 0

    def _reference_at_end(self, now_ns: int) -> bool:
        """Tell whether the controller's reference is at the end of the motion; stores since when."""
        assert self._report is not None
        reference = self._report.reference
        if not self._stands_ns and all(map(isfinite, reference)) and dist(reference, self._motion.goal) < SAME:
            self._stands_ns = now_ns
        return self._stands_ns > 0

    def _proceed(self, now_ns: int) -> None:
        stands = self._reference_at_end(now_ns)
        late = now_ns - self._begun_ns > int(self._motion.duration_s * 1e9) + LATE_NS
        match self.phase:
            case Phase.BACK if stands or late:
                self._begin(Phase.PAUSE, hold(self._motion.goal), now_ns)
                if self._next == len(self.visits):
                    self.phase = Phase.DONE
            case Phase.PAUSE if now_ns - self._begun_ns >= PAUSE_NS:
                self._load_or_depart(now_ns)
            case Phase.LOAD if now_ns - self._begun_ns >= LOAD_NS:
                self._hung_kg = self.visits[self._next].load_kg
                self._arm = self._arm.loaded(plausible_load_kg(fmean(self._weights)))
                self._begin(Phase.BACK, self._return_motion(self._motion.goal), now_ns)
            case Phase.OUT if stands or late:
                self.runs[-1].ended_ns, self.runs[-1].failed = now_ns, not stands
                self.phase, self._stands_ns = Phase.REST, now_ns
            case Phase.REST if now_ns >= min(self._stands_ns + REST_NS, self.runs[-1].ended_ns + LONGEST_REST_NS):
                self._finish(now_ns)
                self._begin(Phase.BACK, self._return_motion(self._motion.goal), now_ns)

    def _load_or_depart(self, now_ns: int) -> None:
        """Hang the next load, or start the next motion; the crane is at rest at the start."""
        visit = self.visits[self._next]
        if visit.load_kg != self._hung_kg:
            self.hang(visit.load_kg)
            self._weights.clear()
            self._begin(Phase.LOAD, self._motion, now_ns)
            return
        self._next += 1
        goal_m = GOALS_M[visit.goal]
        start = self._arm.pose(self._motion.goal)
        motion = straight_line(self._arm, start, pose_at(self._arm, goal_m), shaped=self.shaped)
        commanded_m = pin_position(self.profile.kinematics, motion.goal)
        self.runs.append(Run(visit, goal_m, motion, commanded_m, self._arm.load_kg, now_ns))
        self._begin(Phase.OUT, motion, now_ns)

    def _finish(self, now_ns: int, failed: bool = False) -> None:
        self.runs[-1].over_ns = now_ns
        self.runs[-1].failed |= failed
