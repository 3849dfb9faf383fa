"""State of one crane job: its parts, and what a manager and an operator read of it."""

from __future__ import annotations

from collections.abc import Callable

from autonomy.crane_job.cycle import Cycle
from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.phases import Phase
from autonomy.crane_job.rotator_estimate import (
    RotatorEstimate,
    planning_profile,
)
from autonomy.crane_job.trajectory_tracker import TrajectoryTracker
from autonomy.grasp.grasp import Grasp
from autonomy.grasp.planner import GraspSelector
from autonomy.grasp.selection import select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import LEVEL
from autonomy.motion.motion_planner import MotionPlanner, TimeOptimalPlanner
from autonomy.motion.pose import Pose
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory
from autonomy.perception.log_list.observation import LogObservation
from machine.joints import JOINTS
from machine.profile import Profile
from runtime.errors import Problem


class ActivityState:
    """The parts of one crane job and its readable state; `Activity` documents the arguments."""

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        job: CraneJob | None = None,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
        grasp_selector: GraspSelector = select_direct,
        last_setpoint: tuple[float, ...] = (0.0,) * len(JOINTS),
        motion_planner: MotionPlanner | None = None,
        fetches_next: Callable[[LogObservation], bool] | None = None,
        stow_only: bool = False,
        rotator: RotatorEstimate | None = None,
        slope: tuple[float, float] = LEVEL,
    ) -> None:
        self.phase = Phase.WAIT
        self._paused: Problem | None = Problem("activity.no-report", "the controller has not reported")
        self._failure: Problem | None = None
        self.idle = False
        self.halted = False
        """Set by a person: the crane stops smoothly on its path, after finishing a grip that has begun."""
        self.bunk_full = False
        """Whether the gripped logs have no room in the bunk."""
        self.rotator = self._count = rotator or RotatorEstimate()
        self._profile = planning_profile(profile, self._count)
        self._first = Phase.STOW if stow_only else Phase.LOOK
        self._fetches_next = fetches_next
        motion_planner = motion_planner or TimeOptimalPlanner()
        self._direct = motion_planner.direct
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._inbox = Inbox(self._profile)
        self._cycle = Cycle(self._profile, job or CraneJob(), motion_planner, grasp_selector, self._inbox, slope)
        self._grapple = GrappleSequence(self._profile, self._inbox)
        self._tracker = TrajectoryTracker(profile, last_setpoint)
        self._elapsed_s = 0.0
        self._arrived_ns: int | None = None
        self._ready_ns: int | None = None
        self._restart_phase: Phase | None = None
        self._put_back_reason: Problem | None = None
        """Why the gripped logs are laid back."""
        self._last_ns: int | None = None

    @property
    def paused(self) -> str | None:
        """Why it waits, or None."""
        return self._paused.sentence if self._paused else None

    @property
    def paused_code(self) -> str | None:
        """The code of ``paused``."""
        return self._paused.code if self._paused else None

    @property
    def failure(self) -> str | None:
        """Why it ended before its goal, or None."""
        return self._failure.sentence if self._failure else None

    @property
    def failure_code(self) -> str | None:
        """The code of ``failure``."""
        return self._failure.code if self._failure else None

    @property
    def done(self) -> bool:
        """Whether the log lies in the bunk and the crane is clear of it."""
        return self.phase is Phase.DONE

    @property
    def arrived(self) -> bool:
        """Whether the motion of the present phase is done; the phase may still wait for a condition."""
        return self._arrived_ns is not None

    @property
    def profile(self) -> Profile:
        """The machine as motions are planned for it."""
        return self._profile

    @property
    def grasp(self) -> Grasp | None:
        """The grasp, once it is selected."""
        return self._cycle.grasp

    @property
    def place(self) -> Pose | None:
        """The pose in which the grapple releases, once it is planned."""
        return self._cycle.place

    @property
    def missed(self) -> int:
        """The number of grasps that came up empty."""
        return self._cycle.missed

    @property
    def lifted_kg(self) -> float:
        """The load in the grapple, kg; 0 without a load cell."""
        return self._cycle.lifted_kg

    @property
    def last_setpoint(self) -> tuple[float, ...]:
        """The last joint setpoint, rad (EXT m), with the newest rotator estimate."""
        return self.rotator.to_angles(self._count.to_counts(self._tracker.setpoint))

    @property
    def motion(self) -> Trajectory:
        """The motion of the present phase."""
        return self._tracker.motion

    @property
    def _is_halting(self) -> bool:
        return self.halted and self.phase not in (Phase.CLOSE, Phase.DONE, Phase.FAILED)

    def abort(self, reason: str) -> None:
        """End the job: the crane stops smoothly on its path within ``BRAKE_S``."""
        if self.phase not in (Phase.DONE, Phase.FAILED):
            self._fail(Problem("activity.aborted", reason))

    def _fail(self, problem: Problem) -> None:
        self._failure = problem
        self.phase = Phase.FAILED
        self._elapsed_s = 0.0
