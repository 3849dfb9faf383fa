"""Runs the crane jobs of a mission one after the other; each starts with the state that the previous one found.

A job stows the crane, loads mapped logs into the bunk, or unloads the bunk to a landing.  The logs that must not be
picked are given with the list from which a grasp is chosen.  Results are passed to the load bookkeeping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, isfinite
from typing import Final

from msgspec.structs import replace

from autonomy.crane_job.activity import KEPT, Activity
from autonomy.crane_job.phases import Phase
from autonomy.crane_job.rotator_estimate import LoadView, RotatorEstimate, load_view, play_rad
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.planner import Grasp, GraspSelector
from autonomy.grasp.weight import UNSURE_KG
from autonomy.manager.load_bookkeeping import LoadBookkeeping
from autonomy.manager.log_memory import LogMemory
from autonomy.manager.world_model import WorldModel
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.motion_planner import MotionPlanner
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import N_JOINTS
from machine.profile import Profile
from runtime.errors import Problem

MAX_STOPS: Final = 3
"""A grasp is given up after the controller has stopped the crane this many times, ..."""
MAX_STOPS_WITH_LOAD: Final = 6
"""... with a log in the jaws after this many."""
MAX_FAILURES: Final = 3
"""Unloading fails after this many failed grasps from the bunk in a row."""


class CraneExecutor:
    """Starts and ends crane jobs; ``job`` is the active one, None between two.

    ``selector`` picks grasps on the ground, ``unloading_selector`` those from the bunk.  ``rotator`` is the known state
    of a rotator without an encoder.  ``log_memory``: the camera only looks ahead; a load is shown to it while the
    rotator is unsure, or where it is too light to weigh, and remembered as it was seen.  ``as_paper_b`` works as paper
    B does: a grasp takes only its target, gives it up after one failure, and ends over the bunk.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        world: WorldModel,
        load: LoadBookkeeping,
        selector: GraspSelector,
        unloading_selector: GraspSelector,
        motions: MotionPlanner,
        lease_ns: int,
        key: bytes | None,
        rotator: RotatorEstimate,
        as_paper_b: bool,
        log_memory: LogMemory | None = None,
    ) -> None:
        self.job: Activity | None = None
        self.failure: Problem | None = None
        """Why the mission cannot continue; None while it can."""
        self._profile, self._hash = profile, profile_hash
        self._world, self._load = world, load
        self._selector, self._unloading_selector, self._motions = selector, unloading_selector, motions
        self._lease_ns, self._key = lease_ns, key
        self._rotator, self._as_paper_b, self._log_memory = rotator, as_paper_b, log_memory
        self._reference: tuple[float, ...] | None = None
        self._stops = self._failures = 0

    @property
    def rotator(self) -> RotatorEstimate:
        """Known state of a rotator without an encoder."""
        return self._rotator if self.job is None else self.job.rotator

    # ------------------------------------------------------------------ starting a job
    def load_target(self, target: int | None, only: bool = False) -> None:
        """Load the target log into the bunk, and other logs that one grasp holds; ``only``: no other log."""
        self._begin(CraneJob(log_id=self._world.list_number(target) if self._as_paper_b or only else None), target)

    def unload_bunk(self) -> None:
        """Move logs from the bunk to the landing of the load."""
        pile = self._world.landing_pile(*self._load.landing())
        self._begin(CraneJob(source=self._profile.bunk, target=pile), None)

    def stow(self) -> None:
        """Move the crane over the bunk."""
        self._begin(None, None)

    def _begin(self, mission: CraneJob | None, target: int | None) -> None:
        if self._reference is None:  # without an encoder only the reference of a previous planner is known
            reference = self._world.report.reference if self._world.report is not None else ()
            reference = tuple(r if isfinite(r) else 0.0 for r in reference) or (0.0,) * N_JOINTS
            self._reference = self.rotator.to_angles(reference)

        def choose(arm: Arm, job: CraneJob, logs: Sequence[LogObservation], slew_rad: float, rot_rad: float) -> Grasp:
            job = replace(job, leave=self._load.logs_to_leave(logs, target))
            return self._selector(arm, job, logs, slew_rad, rot_rad)

        unloads = mission is not None and mission.source is not None
        onward: Callable[[LogObservation], bool] | None = self._unloads_next if unloads else self._fetches_next
        self._stops = 0
        self.job = Activity(
            self._profile,
            self._hash,
            mission,
            self._lease_ns,
            self._key,
            self._unloading_selector if unloads else choose,
            self._reference,
            self._motions,
            None if self._as_paper_b else onward,
            mission is None,
            self.rotator,
            self._world.slope,
            self._view(),
        )

    def _view(self) -> LoadView | None:
        """Return how a camera that only looks ahead sees a load; paper B leaves its rotator as it is."""
        vehicle = self._world.vehicle
        if self._log_memory is None or self._as_paper_b or vehicle is None:
            return None
        return load_view(self._profile, vehicle.articulation_rad)

    def _unloads_next(self, log: LogObservation) -> bool:
        """Tell whether the next grasp from the bunk could be of such a log."""
        return lies_in_bunk(self._profile.bunk, log)

    def _fetches_next(self, log: LogObservation) -> bool:
        """Tell whether the next grasp on the ground could be of such a log."""
        number = self._world.map_number(log.id)
        return number is not None and not self._load.full and number in {g.number for g in self._world.graspable()}

    # ------------------------------------------------------------------ running a job
    def step(
        self, now_ns: int, report: StateReport | None, logs: Sequence[LogObservation] | None, halted: bool
    ) -> bytes | None:
        """Take one step of the job; return the datagram to send, or None.  ``halted``: the operator has paused the
        crane.
        """
        if self.job is None:
            return None
        self.job.halted = halted
        if logs is not None:
            logs = tuple(log for log in logs if not self._world.is_given_up(log.id))
        return self.job.step(now_ns, report, logs)

    @property
    def shows_load(self) -> bool:
        """Whether the crane stands still with a load in front of the camera, and a picture of it is awaited."""
        return self.job is not None and self.job.shows_load

    def view_load(self, logs: Sequence[LogObservation]) -> None:
        """Accept the logs of a picture that was taken while `shows_load`, in the base frame."""
        assert self.job is not None and self._log_memory is not None and self._world.report is not None
        load, grasp = self.job.view_load(tuple(logs)), self.job.grasp
        # How a thin log lies in the jaws by then, it does not lie in them after the next turn.
        if load is not None and grasp is not None and not play_rad(grasp.thinnest_m):
            self._log_memory.correct(load, self._world.report)

    def abort(self, reason: str) -> None:
        """End the job; the crane stops smoothly."""
        if self.job is not None:
            self.job.abort(reason)

    def on_interrupted(self) -> None:
        """Count that setpoints are no longer executed, if the controller has stopped the machine."""
        self._stops += self.job is not None and self._world.stopped

    def on_resumed(self) -> None:
        """Take note that setpoints are executed again; a job that was stopped too often is aborted, one with a log in
        the jaws later: nobody else lays it down.
        """
        carries = self.job is not None and Phase.LIFT <= self.job.phase <= Phase.OPEN
        if self._stops >= (MAX_STOPS_WITH_LOAD if carries else MAX_STOPS):
            self.abort(f"the controller stopped the crane {self._stops} times")

    # ------------------------------------------------------------------ ending a job
    def collected(self, now_ns: int) -> bool:
        """Tell whether a grasp was placed in the bunk; if so, end the job and book the logs."""
        job = self.job
        if job is None or not job.idle or job.grasp is None or self._came_up_empty(job):
            return False
        if not (job.done or job.has_released):
            return False
        self._load.book_loaded(job, now_ns)
        if job.load_unseen:
            self._load.tally.remark(
                now_ns,
                "no picture showed a load that was held before the camera; the rotator's angle is known to "
                f"{degrees(job.rotator.sigma_rad):.0f} degrees only",
            )
        self._end(job)
        return True

    def missed(self, now_ns: int, target: int | None) -> bool:
        """Tell whether a grasp failed, or nothing has shown its load; if so, end the job and give the log up after too
        many failures.
        """
        job = self.job
        if job is None or not job.idle or (job.failure is None and not self._came_up_empty(job)):
            return False
        if job.failure is not None:
            self._load.book_miss(job, target, for_good=self._as_paper_b)
        else:
            assert self._log_memory is not None
            self._load.book_unseen(job, now_ns)
            self._log_memory.leave()
        self._end(job)
        return True

    def _came_up_empty(self, job: Activity) -> bool:
        """Tell whether neither a picture nor the scale has shown a load that was thought to hang in the jaws."""
        grip = self._world.grip
        return job.load_missing and not (grip is not None and grip.read_kg >= UNSURE_KG)

    def unloaded(self) -> bool:
        """Tell whether a grasp from the bunk is over, with or without logs; if so, end the job."""
        job = self.job
        if job is None or not job.idle:
            return False
        self._failures = self._failures + 1 if self._load.book_unloaded(job) else 0
        if self._failures >= MAX_FAILURES:
            self.failure = Problem("mission.unloading-failed", f"unloading: {job.failure}")
        self._end(job)
        return True

    def stowed(self) -> bool:
        """Tell whether the crane is stowed for driving; end a job that is over."""
        job = self.job
        if job is None or not job.idle:
            return False
        if job.failure is not None:
            self.failure = Problem(
                "mission.crane-not-stowed", f"the crane cannot be brought over the bunk: {job.failure}"
            )
        self._end(job)
        return not self.failure

    def _end(self, job: Activity) -> None:
        self._reference, self._rotator = job.last_setpoint, job.rotator
        if job.failure_code == KEPT.code:
            self.failure = KEPT
        self.job = None
