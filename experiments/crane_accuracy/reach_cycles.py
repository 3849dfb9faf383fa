"""The planner of the experiment: from the middle of the trail to a goal, rest there, back, as often as asked.

`Rounds.step` is pure (contract of `hil.harness.lockstep.Planner`): it plans with `autonomy.motion` and streams windows of the
motion every 50 ms, as autonomy does.  A load is put on the hook at the start, at rest; how heavy it is, the planner
takes from the controller's report.  A stop ends the motion under way as failed; after it the crane goes back to the
start and the next motion follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from math import dist, isfinite
from statistics import fmean
from typing import Final

from autonomy.motion.arm import Arm
from autonomy.motion.setpoint_stream import PERIOD_NS, SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, straight_line
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from experiments.crane_accuracy.measure import NEAR_M
from experiments.crane_accuracy.plan import GOALS_M, Visit, pose_at, start_pose
from machine.geometry.kinematics import Point, pin_position
from machine.geometry.sag import sane_load_kg
from machine.joints import JOINTS
from machine.profile import Profile, joint
from machine.status.modes import Mode

LEASE_NS: Final = 200_000_000
REST_NS: Final = 3_500_000_000
"""At a goal, after the pin by encoders has come near it and stays: what is measured there is over 3 s after arrival."""
LONGEST_REST_NS: Final = 10_000_000_000
PAUSE_NS: Final = 1_000_000_000
"""At the start, before the next motion."""
LOAD_NS: Final = 5_000_000_000
"""After the load came on; the last `WEIGH_NS` of it show how heavy it is."""
WEIGH_NS: Final = 2_000_000_000
LATE_NS: Final = 4_000_000_000
"""A reference that is not at its end so long after its time has failed."""
SAME: Final = 1e-6


class Part(IntEnum):
    """What a round is doing."""

    WAIT = 0
    """The controller is not armed yet, or no longer."""
    BACK = 1
    PAUSE = 2
    LOAD = 3
    OUT = 4
    REST = 5
    DONE = 6


@dataclass(slots=True)
class Run:
    """One motion to a goal: what was asked and when its reference began, ended and its rest was over (0: not yet)."""

    visit: Visit
    goal_m: Point
    motion: Trajectory
    commanded_m: Point
    """Where the encoders' pin is to end: beside the goal when the profile knows the sag."""
    load_kg: float
    """What the planner took the load to be."""
    begun_ns: int
    ended_ns: int = 0
    over_ns: int = 0
    failed: bool = False


@dataclass(slots=True)
class Rounds:
    """``runs`` are the motions so far, the last one perhaps under way; ``part`` says so."""

    profile: Profile
    profile_hash: int
    visits: Sequence[Visit]
    hang: Callable[[float], None]
    """Puts a load of so many kg on the hook, in place of the one before."""
    shaped: bool = True
    part: Part = Part.WAIT
    runs: list[Run] = field(default_factory=list)
    _arm: Arm = field(init=False)
    _stream: SetpointStream = field(init=False)
    _motion: Trajectory = field(init=False)
    _report: StateReport | None = None
    _weights: list[float] = field(default_factory=list)
    _hung_kg: float = 0.0
    """The load that was put on and weighed."""
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
        """Whether every motion was made."""
        return self.part is Part.DONE

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        """One turn: the datagram to send now, or None."""
        if report is not None:
            self._report = report
            self._heed(report, now_ns)
        if self._report is None or self.part in (Part.WAIT, Part.DONE) or now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + PERIOD_NS
        self._proceed(now_ns)
        if self.done:
            return None
        return self._stream.datagram(now_ns, self._motion, (now_ns - self._begun_ns) * 1e-9, GrappleCommand.NEUTRAL)

    def _heed(self, report: StateReport, now_ns: int) -> None:
        """Modes, what the load weighs, and whether the pin is away from where it is to rest."""
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            if self.part is Part.OUT or self.part is Part.REST:
                self._over(now_ns, failed=True)
            if not self.done:
                self.part = Part.WAIT
        elif self.part is Part.WAIT and all(map(isfinite, self._measured(report))):
            self._begin(Part.BACK, self._way_back(self._measured(report)), now_ns)
        elif self.part is Part.LOAD and now_ns >= self._begun_ns + LOAD_NS - WEIGH_NS:
            self._weights.append(report.load_kg)
        elif self.part is Part.REST:
            pin = pin_position(self.profile.kinematics, report.position)
            if dist(pin, self.runs[-1].commanded_m) > NEAR_M:
                self._stands_ns = now_ns

    def _measured(self, report: StateReport) -> tuple[float, ...]:
        """The joints; one without an encoder counts as standing where it was sent."""
        return tuple(
            p if joint(self.profile, j).encoder is not None else q
            for j, p, q in zip(JOINTS, report.position, self._motion.goal, strict=True)
        )

    def _way_back(self, q: Sequence[float]) -> Trajectory:
        return straight_line(self._arm, self._arm.pose(q), start_pose(self._arm))

    def _begin(self, part: Part, motion: Trajectory, now_ns: int) -> None:
        self.part, self._motion, self._begun_ns, self._stands_ns = part, motion, now_ns, 0

    def _stands(self, now_ns: int) -> bool:
        """Whether the controller's reference has come to the end of the motion; notes since when."""
        assert self._report is not None
        reference = self._report.reference
        if not self._stands_ns and all(map(isfinite, reference)) and dist(reference, self._motion.goal) < SAME:
            self._stands_ns = now_ns
        return self._stands_ns > 0

    def _proceed(self, now_ns: int) -> None:
        stands = self._stands(now_ns)
        late = now_ns - self._begun_ns > int(self._motion.duration_s * 1e9) + LATE_NS
        match self.part:
            case Part.BACK if stands or late:
                self._begin(Part.PAUSE, hold(self._motion.goal), now_ns)
                if self._next == len(self.visits):
                    self.part = Part.DONE
            case Part.PAUSE if now_ns - self._begun_ns >= PAUSE_NS:
                self._load_or_set_out(now_ns)
            case Part.LOAD if now_ns - self._begun_ns >= LOAD_NS:
                self._hung_kg = self.visits[self._next].load_kg
                self._arm = self._arm.loaded(sane_load_kg(fmean(self._weights)))
                self._begin(Part.BACK, self._way_back(self._motion.goal), now_ns)
            case Part.OUT if stands or late:
                self.runs[-1].ended_ns, self.runs[-1].failed = now_ns, not stands
                self.part, self._stands_ns = Part.REST, now_ns
            case Part.REST if now_ns >= min(self._stands_ns + REST_NS, self.runs[-1].ended_ns + LONGEST_REST_NS):
                self._over(now_ns)
                self._begin(Part.BACK, self._way_back(self._motion.goal), now_ns)

    def _load_or_set_out(self, now_ns: int) -> None:
        """At the start and at rest."""
        visit = self.visits[self._next]
        if visit.load_kg != self._hung_kg:
            self.hang(visit.load_kg)
            self._weights.clear()
            self._begin(Part.LOAD, self._motion, now_ns)
            return
        self._next += 1
        goal_m = GOALS_M[visit.goal]
        start = self._arm.pose(self._motion.goal)
        motion = straight_line(self._arm, start, pose_at(self._arm, goal_m), shaped=self.shaped)
        commanded_m = pin_position(self.profile.kinematics, motion.goal)
        self.runs.append(Run(visit, goal_m, motion, commanded_m, self._arm.load_kg, now_ns))
        self._begin(Part.OUT, motion, now_ns)

    def _over(self, now_ns: int, failed: bool = False) -> None:
        self.runs[-1].over_ns = now_ns
        self.runs[-1].failed |= failed
