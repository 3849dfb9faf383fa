"""The crane's jobs of a mission, one after the other: each begins with what the one before it found out.

A job goes over the bunk, takes logs of the field into the bunk, or those of the bunk to a landing.  When it chooses its
grasp it is told which logs are to stay lying, by the list that it chooses from.  What it came to goes to the cargo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Final

from msgspec.structs import replace

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.rotator_estimate import Rotator
from autonomy.grasp.selection import Chooser, Grasp, lies_in
from autonomy.manager.load_bookkeeping import Cargo
from autonomy.manager.world_model import Outlook
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm
from autonomy.motion.motion_planner import Motions
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import N_JOINTS
from machine.profile import Profile

STOPS: Final = 3
"""So often the controller may stop the crane before a grasp is given up."""
FAILURES: Final = 3
"""So many grasps from the bunk may fail one after the other."""


class Hand:
    """Begins jobs and ends them; ``job`` is the one in hand, None between two.  ``chooser`` picks the grasps,
    ``emptier`` those from the bunk at a landing; ``rotator`` is what was known at first of one without an encoder.
    ``faithful``, as in paper B: a grasp takes its target alone, which is given up where it comes back empty, and ends
    over the bunk.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        outlook: Outlook,
        cargo: Cargo,
        chooser: Chooser,
        emptier: Chooser,
        motions: Motions,
        lease_ns: int,
        key: bytes | None,
        rotator: Rotator,
        faithful: bool,
    ) -> None:
        self.job: Activity | None = None
        self.trouble = ""
        """Why the mission cannot go on, once that is so."""
        self._profile, self._hash = profile, profile_hash
        self._outlook, self._cargo = outlook, cargo
        self._chooser, self._emptier, self._motions = chooser, emptier, motions
        self._lease_ns, self._key = lease_ns, key
        self._rotator, self._faithful = rotator, faithful
        self._rests: tuple[float, ...] | None = None
        self._stops = self._failures = 0

    @property
    def rotator(self) -> Rotator:
        """What is known now of one without an encoder."""
        return self._rotator if self.job is None else self.job.rotator

    # ------------------------------------------------------------------ how a job begins
    def fetch(self, target: int | None) -> None:
        """Take a log of the field into the bunk, by its number, and others with it."""
        self._begin(Mission(log_id=self._outlook.listed_as(target) if self._faithful else None), target)

    def unload(self) -> None:
        """Bring logs from the bunk to the landing of the load."""
        pile = self._outlook.pile_at(*self._cargo.landing())
        self._begin(Mission(source=self._profile.bunk, target=pile), None)

    def stow(self) -> None:
        """Go over the bunk."""
        self._begin(None, None)

    def _begin(self, mission: Mission | None, target: int | None) -> None:
        if self._rests is None:  # another planner may have turned a rotator of which nothing but its count is known
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
        """Whether the next grasp from the bunk would be of such a log."""
        return lies_in(self._profile.bunk, log)

    def _fetches_next(self, log: LogObservation) -> bool:
        """Whether the next grasp of the field would."""
        number = self._outlook.number_of(log.id)
        return number is not None and not self._cargo.full and number in {g.number for g in self._outlook.takable()}

    # ------------------------------------------------------------------ while it lasts
    def step(
        self, now_ns: int, report: StateReport | None, logs: Sequence[LogObservation], halted: bool
    ) -> bytes | None:
        """One turn of the job: the datagram to send now, or None.  ``halted``: a person lets the crane stand."""
        if self.job is None:
            return None
        self.job.halted = halted
        offered = tuple(log for log in logs if not self._outlook.given_up(log.id))
        return self.job.step(now_ns, report, offered)

    def abort(self, reason: str) -> None:
        """The crane stops smoothly."""
        if self.job is not None:
            self.job.abort(reason)

    def interrupted(self) -> None:
        """What was asked for is no longer obeyed; it counts where the controller has stopped the machine."""
        self._stops += self.job is not None and self._outlook.stopped

    def resumed(self) -> None:
        """It is obeyed again; a job that was stopped too often is given up."""
        if self._stops >= STOPS:
            self.abort(f"the controller stopped the crane {self._stops} times")

    # ------------------------------------------------------------------ how it ends
    def collected(self, now_ns: int) -> bool:
        """Whether a grasp lies in the bunk; then the job has ended, and the cargo knows."""
        job = self.job
        if job is None or not job.idle or not job.done or job.grasp is None:
            return False
        self._cargo.took(job, now_ns)
        self._end(job)
        return True

    def missed(self, target: int | None) -> bool:
        """Whether the crane came back empty; a log that was missed too often is given up."""
        job = self.job
        if job is None or not job.idle or job.failure is None:
            return False
        self._cargo.missed(job, target, for_good=self._faithful)
        self._end(job)
        return True

    def unloaded(self) -> bool:
        """Whether a grasp from the bunk is over, with or without logs."""
        job = self.job
        if job is None or not job.idle:
            return False
        self._failures = self._failures + 1 if self._cargo.unloaded(job) else 0
        if self._failures >= FAILURES:
            self.trouble = f"unloading: {job.failure}"
        self._end(job)
        return True

    def stowed(self) -> bool:
        """Whether the crane is out of the way for driving."""
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
