"""The crane's jobs of a mission, one after the other: each begins with what the one before it found out.

A job goes over the bunk, takes logs of the field into the bunk, or those of the bunk to a landing.  When it chooses its
grasp it is told which logs are to stay lying, by the list that it chooses from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from msgspec.structs import replace

from autonomy.activity import Activity
from autonomy.grasp.direct import Chooser, Grasp
from autonomy.logs import LogObservation
from autonomy.manager.cargo import Cargo
from autonomy.mission import Mission
from autonomy.motion.arm import Arm
from autonomy.motion.ways import Motions
from autonomy.rotator import Rotator
from can_dbc.setpoint import StateReport
from machine.joints import N_JOINTS
from machine.profile import Profile


class Hand:
    """Begins jobs and ends them.  ``chooser`` picks the grasps, ``emptier`` those from the bunk at a landing;
    ``rotator`` is what is known of one without an encoder.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        cargo: Cargo,
        chooser: Chooser,
        emptier: Chooser,
        motions: Motions,
        lease_ns: int,
        key: bytes | None,
        rotator: Rotator,
    ) -> None:
        self._profile, self._hash, self._cargo = profile, profile_hash, cargo
        self._chooser, self._emptier, self._motions = chooser, emptier, motions
        self._lease_ns, self._key = lease_ns, key
        self.rotator = rotator
        self._rests: tuple[float, ...] | None = None

    def begin(
        self,
        mission: Mission | None,
        target: int | None,
        onward: Callable[[LogObservation], bool] | None,
        report: StateReport | None,
    ) -> Activity:
        """A new job for the crane, that is about a log of the field; no mission: to go over the bunk.  ``onward``:
        whether the next grasp would be of such a log.  ``report`` is the controller's newest.
        """
        if self._rests is None:  # another planner may have turned a rotator of which nothing but its count is known
            told = report.reference if report is not None else ()
            told = tuple(r if isfinite(r) else 0.0 for r in told) or (0.0,) * N_JOINTS
            self._rests = self.rotator.believed(told)

        def choose(arm: Arm, job: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
            return self._chooser(arm, replace(job, leave=self._cargo.leave(logs, target)), logs, slew, rot)

        chooser = self._emptier if mission is not None and mission.source is not None else choose
        return Activity(
            self._profile, self._hash, mission, self._lease_ns, self._key, chooser, self._rests,
            self._motions, onward, mission is None, self.rotator,
        )  # fmt: skip

    def end(self, job: Activity) -> None:
        """A job is over."""
        self._rests, self.rotator = job.rests, job.rotator
