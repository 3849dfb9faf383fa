"""Runs the crane jobs of a mission one after the other; each starts with the state that the previous one found.

A job stows the crane, loads mapped logs into the bunk, or unloads the bunk to a landing.  The logs that must not be
picked are given with the list from which a grasp is chosen.  Results are passed to the load bookkeeping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Final

from msgspec.structs import replace

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.rotator_estimate import RotatorEstimate
from autonomy.grasp.planner import GraspSelector
from autonomy.grasp.placement import lies_in_bunk
from autonomy.grasp.grasp import Grasp
from autonomy.manager.load_bookkeeping import Cargo
from autonomy.manager.world_model import Outlook
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm
from autonomy.motion.motion_planner import MotionPlanner
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import N_JOINTS
from machine.profile import Profile

STOPS: Final = 3
"""A grasp is given up after the controller has stopped the crane this many times."""
FAILURES: Final = 3
"""Unloading fails after this many failed grasps from the bunk in a row."""


class Hand:
    """Starts and ends crane jobs; ``job`` is the active one, None between two.

    ``chooser`` picks grasps on the ground, ``emptier`` those from the bunk.  ``rotator`` is the known state of a
    rotator without an encoder.  ``faithful`` works as paper B does: a grasp takes only its target, gives it up after
    one failure, and ends over the bunk.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        outlook: Outlook,
        cargo: Cargo,
        chooser: GraspSelector,
        emptier: GraspSelector,
        motions: MotionPlanner,
        lease_ns: int,
        key: bytes | None,
        rotator: RotatorEstimate,
        faithful: bool,
    ) -> None:
        self.job: Activity | None = None
        self.trouble = ""
        """Why the mission cannot continue; empty while it can."""
        self._profile, self._hash = profile, profile_hash
        self._outlook, self._cargo = outlook, cargo
        self._chooser, self._emptier, self._motions = chooser, emptier, motions
        self._lease_ns, self._key = lease_ns, key
        self._rotator, self._faithful = rotator, faithful
        self._rests: tuple[float, ...] | None = None
        self._stops = self._failures = 0

    @property
    def rotator(self) -> RotatorEstimate:
        """Known state of a rotator without an encoder."""
        return self._rotator if self.job is None else self.job.rotator

    # ------------------------------------------------------------------ starting a job
    def fetch(self, target: int | None) -> None:
        """Load the target log into the bunk, and other logs that one grasp holds."""
        self._begin(Mission(log_id=self._outlook.listed_as(target) if self._faithful else None), target)

    def unload(self) -> None:
        """Move logs from the bunk to the landing of the load."""
        pile = self._outlook.pile_at(*self._cargo.landing())
        self._begin(Mission(source=self._profile.bunk, target=pile), None)

    def stow(self) -> None:
        """Move the crane over the bunk."""
        self._begin(None, None)

    def _begin(self, mission: Mission | None, target: int | None) -> None:
        if self._rests is None:  # without an encoder only the reference of a previous planner is known
            told = self._outlook.report.reference if self._outlook.report is not None else ()
            told = tuple(r if isfinite(r) else 0.0 for r in told) or (0.0,) * N_JOINTS
            self._rests = self.rotator.believed(told)

        def choose(arm: Arm, job: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
            return self._chooser(arm, replace(job, leave=self._cargo.leave(logs, target)), logs, slew, rot)

        unloads = mission is not None and mission.source is not None
        onward: Callable[[LogObservation], bool] | None = self._unloads_next if unloads else self._fetches_next
        self._stops = 0
        self.job = Activity(
            self._profile, self._hash, mission, self._lease_ns, self._key, self._emptier if unloads else choose,
            self._rests, self._motions, None if self._faithful else onward, mission is None, self.rotator,
        )  # fmt: skip

    def _unloads_next(self, log: LogObservation) -> bool:
        """Whether the next grasp from the bunk could be of such a log."""
        return lies_in_bunk(self._profile.bunk, log)

    def _fetches_next(self, log: LogObservation) -> bool:
        """Whether the next grasp on the ground could be of such a log."""
        number = self._outlook.number_of(log.id)
        return number is not None and not self._cargo.full and number in {g.number for g in self._outlook.takable()}

    # ------------------------------------------------------------------ running a job
    def step(
        self, now_ns: int, report: StateReport | None, logs: Sequence[LogObservation], halted: bool
    ) -> bytes | None:
        """One step of the job: the datagram to send now, or None.  ``halted``: the operator has paused the crane."""
        if self.job is None:
            return None
        self.job.halted = halted
        offered = tuple(log for log in logs if not self._outlook.given_up(log.id))
        return self.job.step(now_ns, report, offered)

    def abort(self, reason: str) -> None:
        """End the job; the crane stops smoothly."""
        if self.job is not None:
            self.job.abort(reason)

    def interrupted(self) -> None:
        """Setpoints are no longer executed; this is counted when the controller has stopped the machine."""
        self._stops += self.job is not None and self._outlook.stopped

    def resumed(self) -> None:
        """Setpoints are executed again; a job that was stopped too often is aborted."""
        if self._stops >= STOPS:
            self.abort(f"the controller stopped the crane {self._stops} times")

    # ------------------------------------------------------------------ ending a job
    def collected(self, now_ns: int) -> bool:
        """Whether a grasp was placed in the bunk; ends the job and books the logs."""
        job = self.job
        if job is None or not job.idle or not job.done or job.grasp is None:
            return False
        self._cargo.took(job, now_ns)
        self._end(job)
        return True

    def missed(self, target: int | None) -> bool:
        """Whether a grasp failed; ends the job and gives the log up after too many failures."""
        job = self.job
        if job is None or not job.idle or job.failure is None:
            return False
        self._cargo.missed(job, target, for_good=self._faithful)
        self._end(job)
        return True

    def unloaded(self) -> bool:
        """Whether a grasp from the bunk is over, with or without logs; ends the job."""
        job = self.job
        if job is None or not job.idle:
            return False
        self._failures = self._failures + 1 if self._cargo.unloaded(job) else 0
        if self._failures >= FAILURES:
            self.trouble = f"unloading: {job.failure}"
        self._end(job)
        return True

    def stowed(self) -> bool:
        """Whether the crane is stowed for driving; ends the job."""
        job = self.job
        if job is None or not job.idle:
            return False
        if job.failure is not None:
            self.trouble = f"the crane cannot be brought over the bunk: {job.failure}"
        self._end(job)
        return not self.trouble

    def _end(self, job: Activity) -> None:
        self._rests, self._rotator = job.rests, job.rotator
        self.job = None
