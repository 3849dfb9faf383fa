"""One crane cycle: what is gripped, where it goes, the motion of each phase, and whether the newest list bears it out.

A `Cycle` is asked by the activity, which alone knows when a phase begins and ends.  Joints are in ``Joint`` order, rad
(EXT m).
"""

from __future__ import annotations

from collections.abc import Iterable
from math import dist
from typing import Final

import msgspec

from autonomy.crane_job.grapple import GrappleSequence, is_between_stakes, lifts_nothing
from autonomy.crane_job.grasp_recovery import GraspRecovery, is_camera_measured
from autonomy.crane_job.grasp_verification import COLUMN_RADIUS_M, lifted_part, is_at_target, visible_grasped_logs, corrected_place
from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.phase_motions import approach_motion, corrected_grasp, carry_motion, closing_motion, extraction_motion, bundle_lift_motion, stow_motion
from autonomy.crane_job.phases import Phase
from autonomy.crane_job.rotator_estimate import has_no_encoder
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M, retreat_height_m
from autonomy.grasp.grasp import Grasp
from autonomy.grasp.placement import lies_in_bunk, plan_place
from autonomy.grasp.planner import GraspSelector, NoGrasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm import Arm
from autonomy.motion.motion_planner import MotionPlanner
from autonomy.motion.pose import Pose
from autonomy.motion.setpoint_stream import Axes
from autonomy.motion.trajectory import Trajectory, with_quick_rotation, hold, straight_line
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import grapple_yaw
from machine.joints import Joint
from machine.profile import Profile
from machine.geometry.sag import sane_load_kg

MAX_ATTEMPTS: Final = 3
MAX_RESELECTIONS: Final = 2
"""So often a grasp is chosen again from over it."""
WEIGHABLE_RISE_M: Final = 0.2
"""What is gripped weighs in tongs that have risen so far, half of it at least."""
EXTRACTION_DEPTH_M: Final = 0.1
"""Open tongs that draw a log are pressed in beside it so much lower than others begin to close: those sweep down from
0.15 m over the ground or more, and would slide over the log before they are beside its middle."""
_SAME_GRASP_M, _SAME_GRASP_RAD = 0.02, 0.03
"""Grasps that differ by less are gone down to from the same place."""
_BUNDLE_RELEASE_HEIGHT_M: Final = 0.2
"""So far over where it was gripped a bundle is let go again: pressed onto others, it would stop the crane."""

_AT_PLACE_M, _AT_PLACE_RAD = 0.03, 0.03
"""A crane so near to where it lets a log go need not go nearer."""


class Cycle:
    """``grasp`` is what is gripped and ``place`` where it goes, each once it is chosen; ``lifted_kg`` hung in the
    grapple, 0 when nobody weighs it; ``missed`` grasps came up empty.  ``profile`` is the machine as motions are
    planned for it.
    """

    def __init__(self, profile: Profile, mission: CraneJob, motion_planner: MotionPlanner, grasp_selector: GraspSelector, inbox: Inbox) -> None:
        self.grasp: Grasp | None = None
        self.place: Pose | None = None
        self.lifted_kg = 0.0
        self.missed = 0
        self._profile, self._mission, self._motion_planner, self._select_grasp = profile, mission, motion_planner, grasp_selector
        self._target = mission.to(profile.bunk)
        self._quick_rotation = has_no_encoder(profile) and motion_planner.direct
        self._inbox = inbox
        self._arm = Arm(profile, free_telescope=motion_planner.free_telescope)
        """With what hangs in the grapple in the present phase."""
        self._phase_start_z_m = 0.0
        self._reselection_count, self._recovery = 0, GraspRecovery()
        self._previous_grasp: Grasp | None = None

    @property
    def is_bundle(self) -> bool:
        """Whether a bundle is gripped: its logs settle when it is lifted, and the tongs follow."""
        return self.grasp is not None and self.grasp.is_bundle

    def select_grasp(self, q: Axes) -> None:
        """A grasp among the logs of the newest list, from where the crane stands; raises ``NoGrasp``."""
        self._recovery = GraspRecovery()
        self._select(q)

    def _select(self, q: Axes) -> None:
        self._reselection_count = 0
        self._previous_grasp = None
        mission = msgspec.structs.replace(self._mission, leave=self._mission.leave + self._recovery.excluded_logs)
        self.grasp = self._select_grasp(self._arm, mission, self._inbox.logs, q[Joint.SLEW], q[Joint.ROT])

    @property
    def needs_reselection(self) -> bool:
        """Whether the grasp is worth another look from above: of logs among others that a camera has measured."""
        return self.grasp is not None and self.is_bundle and is_camera_measured(self.grasp) and self._reselection_count < MAX_RESELECTIONS

    def reselect_grasp(self, q: Axes) -> bool:
        """Choose again by what is seen from over the grasp; whether the crane has to go over another place for it."""
        before = self.grasp
        assert before is not None
        looks = self._reselection_count + 1
        try:
            self._select(q)
        except NoGrasp:
            return False
        finally:
            self._reselection_count = looks
        assert self.grasp is not None
        self._previous_grasp, after = before, self.grasp.pose
        apart_m = dist((*self._arm.xy(before.pose), before.pose.z_m), (*self._arm.xy(after), after.z_m))
        return apart_m > _SAME_GRASP_M or abs(before.pose.rot_rad - after.rot_rad) > _SAME_GRASP_RAD

    def restore_previous_grasp(self) -> bool:
        """Go back to the grasp before the last look, over which the crane stands; whether there is one."""
        if self._previous_grasp is None:
            return False
        self.grasp, self._previous_grasp, self._reselection_count = self._previous_grasp, None, MAX_RESELECTIONS
        return True

    def after_closing(self, tongs: GrappleSequence) -> Phase | None:
        """The phase that follows, None while the tongs still move."""
        assert self.grasp is not None
        following, self.grasp = self._recovery.after_closing(self.grasp, tongs)
        if following is Phase.ABOVE:
            self._allow_reselection()
        return following

    def has_slipped_off(self, tongs: GrappleSequence, q: Axes) -> bool:
        """Whether tongs that begin to rise are seen to hold nothing: the grasp is to be begun anew, from above."""
        assert self.grasp is not None
        anew = self._recovery.after_rising(self.grasp, tongs) if WEIGHABLE_RISE_M < self.risen_m(q) < VERIFY_LIFT_M else None
        if anew is None:
            return False
        self.grasp = anew
        self._allow_reselection()
        return True

    def _allow_reselection(self) -> None:
        self._reselection_count = min(self._reselection_count, MAX_RESELECTIONS - 1)  # the tongs have stirred the logs

    def plan(self, phase: Phase, q: Axes, closing_s: float = 0.0) -> Trajectory:
        """The motion of a phase that begins at ``q``, with the grasp and the place as they are now seen to be best.
        ``closing_s``: how long tongs that close have been closing.

        Raises:
            Unreachable, NoGrasp: there is no way, in one sentence.
        """
        self._phase_start_z_m = self._arm.pose(q).z_m
        self._arm = self._arm.loaded(self._hanging_kg(phase))
        motion = self._plan(phase, q, closing_s)
        return with_quick_rotation(self._arm, motion) if self._quick_rotation else motion

    def _plan(self, phase: Phase, q: Axes, closing_s: float) -> Trajectory:
        arm = self._arm
        grasp, start, logs = self.grasp, arm.pose(q), self._inbox.logs
        if phase is Phase.STOW:
            return stow_motion(arm, self._motion_planner, start, logs)
        if phase in (Phase.LOOK, Phase.OPEN, Phase.DONE, Phase.FAILED) or grasp is None:
            return hold(q)
        match phase:
            case Phase.ABOVE:
                return approach_motion(arm, self._motion_planner, start, grasp, logs)
            case Phase.DESCEND:
                self.grasp = grasp = corrected_grasp(arm, grasp, logs)
                deeper_m = EXTRACTION_DEPTH_M if grasp.extracts else 0.0
                return straight_line(arm, start, grasp.pose.at_height(grasp.pose.z_m - deeper_m))
            case Phase.CLOSE:
                return extraction_motion(arm, start, grasp) if grasp.dragging else closing_motion(arm, start, grasp, closing_s)
            case Phase.LIFT:
                if grasp.is_bundle:
                    return bundle_lift_motion(arm, start, grasp)
                if not self._motion_planner.direct:
                    return straight_line(arm, start, grasp.pose.at_height(grasp.pose.z_m + VERIFY_LIFT_M))
                self.place = plan_place(arm, self._mission, grasp, logs)
                return carry_motion(arm, self._motion_planner, start, self.place, grasp, logs, hangs=False)
            case Phase.CARRY:
                self.lifted_kg = arm.load_kg
                self.place = plan_place(arm, self._mission, grasp, logs, grapple_yaw(self._profile, q))
                return carry_motion(arm, self._motion_planner, start, self.place, grasp, logs, hangs=True)
        assert self.place is not None
        if phase is Phase.LOWER:
            return hold(q) if self._is_at_place(start, self.place) else straight_line(arm, start, self.place)
        return straight_line(arm, start, start.at_height(max(start.z_m, retreat_height_m(self._profile))))

    def _hanging_kg(self, phase: Phase) -> float:
        """What the crane carries in a phase: a log that it has lifted bends it, and nothing else does."""
        return sane_load_kg(self._inbox.report.load_kg) if Phase.LIFT < phase < Phase.RETREAT else 0.0

    # ------------------------------------------------------------------ where the crane is
    def is_off_column(self, phase: Phase, q: Axes) -> bool:
        """Whether it stands aside of the column in which it grips or lays down in a phase."""
        assert self.grasp is not None
        column = self.grasp.pose if phase < Phase.CARRY else self.place
        assert column is not None
        return self._horizontal_distance_m(q, column) > COLUMN_RADIUS_M

    def is_over_grasp(self, q: Axes) -> bool:
        """Whether what hangs in the grapple would come down where it was gripped."""
        assert self.grasp is not None
        return self._horizontal_distance_m(q, self.grasp.pose) < COLUMN_RADIUS_M

    def _is_at_place(self, start: Pose, place: Pose) -> bool:
        """Whether a log that is let go here is as well laid as at its place."""
        apart_m = dist((*self._arm.xy(start), start.z_m), (*self._arm.xy(place), place.z_m))
        return apart_m < _AT_PLACE_M and abs(start.rot_rad - place.rot_rad) < _AT_PLACE_RAD

    def _horizontal_distance_m(self, q: Axes, column: Pose) -> float:
        return dist(self._arm.xy(self._arm.pose(q)), self._arm.xy(column))

    def risen_m(self, q: Axes) -> float:
        """How much higher it stands than where the phase began."""
        return self._arm.pose(q).z_m - self._phase_start_z_m

    def is_between_stakes(self, q: Axes) -> bool:
        """Whether tongs that open farther would stir what lies where the logs go."""
        return is_between_stakes(self._arm, self._target, q)

    # ------------------------------------------------------------------ what the newest list says
    def first(self) -> LogObservation | None:
        """The log that the grasp is of, as it is now seen; None when it is hidden."""
        assert self.grasp is not None
        return next((log for log in self._visible_grasped_logs() if log.id == self.grasp.log.id), None)

    def others(self) -> list[LogObservation]:
        """The logs that are not of the grasp."""
        taken = {log.id for log in self._visible_grasped_logs()}
        return [log for log in self._inbox.logs if log.id not in taken]

    def confirm_lift(self, positions: Iterable[Axes]) -> bool:
        """Whether what was gripped hangs under the crane, measured or sent, or is hidden in tongs that did not shut on
        nothing or in which something weighs; the grasp is of that now."""
        assert self.grasp is not None
        seen = self._visible_grasped_logs()
        held = lifted_part(self._arm, self.grasp, seen, [self._arm.pose(q) for q in positions])
        self.grasp = held or self.grasp
        return held is not None or (not seen and not lifts_nothing(self._inbox.report))

    def count_miss(self) -> str:
        """Count a grasp that did; why there is to be no other, or empty."""
        assert self.grasp is not None
        seen = self._visible_grasped_logs()
        lost = next((log for log in seen if lies_in_bunk(self._target, log)), None)
        if lost is not None:
            return f"log {lost.id} fell from the grapple into the bunk"
        self.missed += 1
        return "" if self.missed < MAX_ATTEMPTS else f"log {(seen or self.grasp.logs)[0].id} was missed {MAX_ATTEMPTS} times"

    def rotator_correction(self, q: Axes) -> float | None:
        """How much farther the rotator is to turn [rad] on a way that is driven already, for what is now seen to hang;
        None when it asks for another way.
        """
        assert self.grasp is not None and self.place is not None
        place = corrected_place(self._arm, self._mission, self.grasp, self.place, self._inbox.logs, q)
        if place is None:
            return None
        turn = place.rot_rad - self.place.rot_rad
        self.place, self.lifted_kg = place, self._hanging_kg(Phase.CARRY)
        return turn

    def plan_return(self) -> None:
        """There is no way on with what is gripped: its place is where it lay."""
        assert self.grasp is not None
        above_m = _BUNDLE_RELEASE_HEIGHT_M if self.grasp.is_bundle else 0.0  # what lay under a bundle has settled, and hangs lower now
        self.place = self.grasp.pose.at_height(self.grasp.pose.z_m + above_m)

    def misplaced_log(self) -> str:
        """Why what was let go does not lie where it was to be; empty when it does."""
        log = next((log for log in self._visible_grasped_logs() if not is_at_target(self._mission, self._target, log)), None)
        if log is None:
            return ""
        x, y, z = log.center_m
        return f"log {log.id} was released but lies at ({x:.2f}, {y:.2f}, {z:.2f}) m, not in the bunk"

    def _visible_grasped_logs(self) -> list[LogObservation]:
        assert self.grasp is not None
        return visible_grasped_logs(self.grasp, self._inbox.logs)
