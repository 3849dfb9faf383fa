"""One crane cycle: the grasp, the place, the motion of each phase, and whether the newest log list confirms them.

The activity knows when a phase begins and ends, and calls the `Cycle` then.  Joints are in ``Joint`` order, rad (EXT
m).
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable, Sequence
from math import cos, dist, pi, sin
from typing import Final

import msgspec

from autonomy.crane_job.grapple import THICK_LOG_M, GrappleSequence, is_between_stakes, is_measured_open
from autonomy.crane_job.grasp_verification import (
    COLUMN_RADIUS_M,
    GraspRecovery,
    corrected_place,
    end_sigma_m,
    ghosts,
    is_at_target,
    is_camera_measured,
    lifted_part,
    visible_grasped_logs,
    with_load_recognized,
)
from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.phase_motions import (
    approach_motion,
    bundle_lift_motion,
    carry_motion,
    closing_motion,
    corrected_grasp,
    extraction_motion,
    stow_motion,
    turn_motion,
)
from autonomy.crane_job.phases import Phase
from autonomy.crane_job.rotator_estimate import LoadView, has_no_encoder, play_rad
from autonomy.grasp.bunk_load import lies_in_bunk, plan_place
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M, retreat_height_m, travel_height_m
from autonomy.grasp.planner import Grasp, GraspSelector, NoGrasp
from autonomy.grasp.weight import bearable_kg, is_weighable
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import LEVEL, Arm, Pose
from autonomy.motion.motion_planner import MotionPlanner
from autonomy.motion.obstacles import collision_scene
from autonomy.motion.setpoint_stream import Axes
from autonomy.motion.trajectory import Trajectory, hold, straight_line, with_quick_rotation, with_rotation
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import grapple_yaw
from machine.geometry.kinematics import Unreachable
from machine.geometry.sag import plausible_load_kg
from machine.joints import Joint
from machine.profile import Profile
from runtime.errors import Problem

SHORTEST_LOG_M: Final = 1.6
"""Nothing shorter is cut: what is seen of it is a part, and its middle is elsewhere."""
MAX_ATTEMPTS: Final = 3
MAX_RESELECTIONS: Final = 2
"""A grasp is selected again from above it this often."""
LOOK_ASIDE_RAD: Final = 0.25
"""Turn of the crane that shows what boom and grapple hid: a metre and a half aside at its usual reach."""
SURE_PROBABILITY: Final = 0.8
"""A grasp that holds less often in the planner's draws is worth a look from the side: half seen, logs are measured
badly."""
SURE_END_M: Final = 0.3
"""An end that is known less well (1 sigma) is hidden."""
WEIGHABLE_RISE_M: Final = 0.2
"""A rise of the jaws after which at least half of the load weighs on the load cell."""
EXTRACTION_DEPTH_M: Final = 0.1
"""How much lower than usual the jaws begin to close for an extraction: usually they sweep down from 0.15 m or more over
the ground, and would slide over the log before they are beside its middle."""
LOOSE_TURN_S_RAD: Final = 5.0
"""Duration of a turn of the rotator above the place: a thin log in closed jaws, once it spins, spins on."""
MAX_FURTHER_TURNS: Final = 2
"""A load that has spun on above its place is turned back this often."""
TOUCH_DOWN_M: Final = 0.5
"""A load that rests on something is released from so far above its place."""
MAX_HIGHER: Final = 2
HIGHER_M: Final = 0.15
"""Jaws that push against other logs or the stakes while they open are raised by this, and open again, this often."""
TEST_RISE_M: Final = 0.4
"""Opened jaws rise by this much, still between the stakes, before the load cell is asked whether they are empty."""
_ASKEW_RAD: Final = 0.2
"""A thin load may lie askew by this much: its ends stay clear of the stakes, and each turn may make it spin."""
_SAME_GRASP_M, _SAME_GRASP_RAD = 0.02, 0.03
"""Grasps that differ by less share the same descent."""
_BUNDLE_RELEASE_HEIGHT_M: Final = 0.2
"""Height above the grasp at which a bundle is released again: pressed onto other logs, it would stop the crane."""
FREE_LOAD_SHARE, MOST_LOAD_SHARE = 0.3, 0.75
"""A bundle is lifted more slowly from this share of what the machine bears on, and from the other one not at all: the
oil lifts on for half a second, and a heap that was held by one log weighed a third more by then."""
HEAVY_LIFT_RATE: Final = 0.4
"""Rate just below `MOST_LOAD_SHARE`: the heaviest pile is up within the phase's time."""
_AT_PLACE_M, _AT_PLACE_RAD = 0.03, 0.03
"""A crane this near to the place need not move to release the log."""


class Cycle:
    """The grasp and the place of one cycle, and the motions between them.

    ``grasp`` and ``place`` are set once they are chosen.  ``lifted_kg`` is the load in the grapple, 0 without a load
    cell; ``missed`` counts the grasps that came up empty.  ``profile`` is the machine as motions are planned for it.
    """

    def __init__(
        self,
        profile: Profile,
        job: CraneJob,
        motion_planner: MotionPlanner,
        grasp_selector: GraspSelector,
        inbox: Inbox,
        slope: tuple[float, float] = LEVEL,
    ) -> None:
        self.grasp: Grasp | None = None
        self.place: Pose | None = None
        self.lifted_kg = 0.0
        self.missed = 0
        self._profile, self._job = profile, job
        self._motion_planner, self._select_grasp = motion_planner, grasp_selector
        self._target = job.to(profile.bunk)
        self._quick_rotation = has_no_encoder(profile) and motion_planner.direct
        self._turns_rotator = motion_planner.turns_rotator
        self._inbox = inbox
        self._arm = Arm(profile, free_telescope=motion_planner.free_telescope, slope=slope)
        """The arm with the load of the present phase."""
        self._phase_start_z_m = 0.0
        self._reselection_count, self._recovery = 0, GraspRecovery()
        self._side_slews: list[float] | None = None
        """Slew angles [rad] from which the crane has yet to look; None before it looks aside."""
        self.view: LoadView | None = None
        """Where the next lift shows its load to a camera; None: it goes straight to its place."""
        self.sees_bunk = True
        """Whether pictures show how the load hangs above its place."""
        self._turn_count = 0
        """Turns of a thin load above its place."""
        self._higher_count = 0
        """How often the jaws had to open higher above the place."""
        self._previous_grasp: Grasp | None = None
        self._ghost_ids: set[int] = set()
        """Numbers of what was seen between open jaws."""
        self._stirred = False
        """Whether the jaws have closed in vain since the last selection."""
        self._untried = False
        """Whether the jaws have not closed yet since the last selection."""
        self.drops_load = False
        """Whether the jaws open to grip anew, because the load was too heavy."""
        self.tests_release = False
        """Whether the next retreat rises only so far that the load cell can tell whether the jaws are empty."""
        self._load_id: int | None = None
        """The number under which the load was last seen in the jaws."""
        self._load_ids: set[int] = set()
        """All these numbers since the selection: the list remembers a load that is hidden where it was seen before."""

    @property
    def arm(self) -> Arm:
        """The arm with the load of the present phase."""
        return self._arm

    def plan_for(self, profile: Profile) -> None:
        """Plan motions for this profile of the machine from now on: its rotator is known better."""
        self._profile, self._arm = profile, self._arm.of(profile)

    @property
    def is_bundle(self) -> bool:
        """Whether the grasp is a bundle: its logs settle when it is lifted, and the jaws follow."""
        return self.grasp is not None and self.grasp.is_bundle

    @property
    def is_too_light(self) -> bool:
        """Whether the load cell cannot tell that the logs of the grasp hang in the jaws; logs from a bunk are left out,
        for nobody counts them by the grasp.
        """
        return self.grasp is not None and self._job.source is None and not is_weighable(self.grasp.logs)

    def select_grasp(self, q: Axes) -> None:
        """Select a grasp among the logs of the newest list, from the present joints; raises ``NoGrasp``."""
        self._recovery = GraspRecovery()
        self._select(q)

    def _select(self, q: Axes) -> None:
        self._reselection_count = self._turn_count = self._higher_count = 0
        leave, untried = self._job.leave + self._recovery.excluded_logs, self._untried
        self._untried = True
        self._load_ids.clear()
        self._previous_grasp = None
        self._stirred = False
        job = msgspec.structs.replace(self._job, leave=leave, untried=untried)
        self.grasp = self._unturned_grasp(
            self._select_grasp(self._arm, job, self._lying_logs(q), q[Joint.SLEW], q[Joint.ROT]), q
        )

    @property
    def is_unsure(self) -> bool:
        """Whether the grasp may well fail, or a hidden end of its logs keeps the crane from knowing it."""
        grasp = self.grasp
        if grasp is None or not is_camera_measured(grasp):
            return False
        fails = grasp.probability is not None and grasp.probability < SURE_PROBABILITY
        return fails or (not self._motion_planner.direct and max(map(end_sigma_m, grasp.logs)) > SURE_END_M)

    def _lying_logs(self, q: Axes) -> list[LogObservation]:
        """List the logs without what open jaws have shown to be none."""
        if is_measured_open(self._inbox.report):
            self._ghost_ids |= ghosts(self._arm, self._inbox.logs, self._arm.pose(q))
        return [log for log in self._inbox.logs if log.id not in self._ghost_ids]

    def look_aside(self, q: Axes) -> Trajectory | None:
        """Plan a turn to one side, later to the other, where the camera on the crane sees what boom and grapple hid.

        None when the crane has looked from both sides, as far as it can turn.
        """
        start, slew = self._arm.pose(q), self._profile.joints["slew"]
        if self._side_slews is None:
            middle_rad = 0.5 * (slew.lower + slew.upper)
            sides = [start.slew_rad - LOOK_ASIDE_RAD, start.slew_rad + LOOK_ASIDE_RAD]
            self._side_slews = sorted(sides, key=lambda side_rad: abs(side_rad - middle_rad))
        high_m = travel_height_m(self._profile)
        scene = collision_scene(self._profile, self._lying_logs(q))
        while self._side_slews:
            goal = start.at_height(max(start.z_m, high_m))._replace(slew_rad=self._side_slews.pop(0))
            with contextlib.suppress(Unreachable):
                return self._motion_planner(self._arm, start, goal, scene, None, high_m, 0.0)
        return None

    def _unturned_grasp(self, grasp: Grasp, q: Axes) -> Grasp:
        """Return the grasp with the rotator as it stands, where the planner does not turn it.

        The jaws then turn the log that they close on: it comes to lie across their opening.
        """
        if self._turns_rotator:
            return grasp
        pose = self._unturned(grasp.pose, q)
        across_rad = grapple_yaw(self._profile, (pose.slew_rad, 0.0, 0.0, 0.0, pose.rot_rad)) - pi / 2
        log = dataclasses.replace(grasp.log, axis=(cos(across_rad), sin(across_rad), 0.0))
        return dataclasses.replace(grasp, pose=pose, log=log)

    def _unturned(self, pose: Pose, q: Axes) -> Pose:
        return pose if self._turns_rotator else pose._replace(rot_rad=q[Joint.ROT])

    @property
    def sees_a_part(self) -> bool:
        """Whether only a part of the log to be gripped has been in view until now."""
        if self.grasp is None or not is_camera_measured(self.grasp):
            return False
        number = self.grasp.log.id
        newest = next((log for log in self._inbox.logs if log.id == number), self.grasp.log)
        return newest.length_m < SHORTEST_LOG_M

    @property
    def needs_reselection(self) -> bool:
        """Whether a detection from above may improve the grasp.

        It is of camera-measured logs among others, jaws that closed in vain may have moved its log, only a part of it
        was in view, or the crane comes to rest above it anyway: there it sees what lay hidden.
        """
        if self.grasp is None or not is_camera_measured(self.grasp) or self._reselection_count == MAX_RESELECTIONS:
            return False
        part = self.grasp.log.length_m < SHORTEST_LOG_M
        return self.is_bundle or self._stirred or part or not self._motion_planner.direct

    def reselect_grasp(self, q: Axes) -> bool:
        """Select again by the detection from above the grasp; return whether the crane must move above another one."""
        before = self.grasp
        assert before is not None
        count = self._reselection_count + 1
        try:
            self._select(q)
        except NoGrasp:
            return False
        finally:
            self._reselection_count = count
        assert self.grasp is not None
        self._previous_grasp, after = before, self.grasp.pose
        apart_m = dist((*self._arm.xy(before.pose), before.pose.z_m), (*self._arm.xy(after), after.z_m))
        return apart_m > _SAME_GRASP_M or abs(before.pose.rot_rad - after.rot_rad) > _SAME_GRASP_RAD

    def restore_previous_grasp(self) -> bool:
        """Return to the grasp before the last selection, above which the crane stands; False where there is none."""
        if self._previous_grasp is None:
            return False
        self.grasp, self._previous_grasp, self._reselection_count = self._previous_grasp, None, MAX_RESELECTIONS
        return True

    def after_closing(self, grapple: GrappleSequence) -> Phase | None:
        """Choose the next phase, None while the jaws still move."""
        assert self.grasp is not None
        following, self.grasp = self._recovery.after_closing(self.grasp, grapple)
        if following is Phase.ABOVE:
            self._allow_reselection()
        return following

    def has_slipped_off(self, grapple: GrappleSequence, q: Axes) -> bool:
        """Tell whether the rising jaws are measured empty; then the grasp restarts from above."""
        assert self.grasp is not None
        if self.risen_m(q) < WEIGHABLE_RISE_M:
            return False
        restarted = self._recovery.after_rising(self.grasp, grapple)
        if restarted is None:
            return False
        self.grasp = restarted
        self._allow_reselection()
        return True

    def lift_rate(self, q: Axes) -> float:
        """Compute the rate at which a bundle may be lifted on.

        1, less where its load comes near what the machine bears, for a pile that comes loose springs up and weighs
        more, and 0 where it comes too near.
        """
        most_kg = bearable_kg(self._arm, q)
        share = plausible_load_kg(self._inbox.report.load_kg) / most_kg if most_kg > 0.0 else 1.0
        if share > MOST_LOAD_SHARE:
            return 0.0
        heavy = max(share - FREE_LOAD_SHARE, 0.0) / (MOST_LOAD_SHARE - FREE_LOAD_SHARE)
        return 1.0 - (1.0 - HEAVY_LIFT_RATE) * heavy

    def drop_load(self, q: Axes) -> bool:
        """Lay the load down where it was gripped, and restart the grasp from above; False after too many times."""
        assert self.grasp is not None
        self.plan_return()
        assert self.place is not None
        self.place = self.place.at_height(min(self.place.z_m, self._arm.pose(q).z_m))
        restarted = self._recovery.after_overload(self.grasp)
        self.drops_load = restarted is not None
        if restarted is not None:
            self.grasp = restarted
            self._allow_reselection()
        return self.drops_load

    def _allow_reselection(self) -> None:
        self._reselection_count = min(self._reselection_count, MAX_RESELECTIONS - 1)
        self._stirred = True

    def plan(self, phase: Phase, q: Axes, closing_s: float = 0.0) -> Trajectory:
        """Plan the motion of a phase that begins at ``q``, with grasp and place updated by the newest log list.

        ``closing_s``: how long closing jaws have been closing.

        Raises:
            Unreachable, NoGrasp: there is no path.
        """
        self._phase_start_z_m = self._arm.pose(q).z_m
        self._arm = self._arm.loaded(self._hanging_kg(phase))
        motion = self._plan(phase, q, closing_s)
        return with_quick_rotation(self._arm, motion) if self._quick_rotation else motion

    def _plan(self, phase: Phase, q: Axes, closing_s: float) -> Trajectory:
        arm = self._arm
        grasp, start = self.grasp, arm.pose(q)
        logs: Sequence[LogObservation] = self._inbox.logs
        if phase is Phase.STOW:
            return stow_motion(arm, self._motion_planner, start, logs)
        if phase in (Phase.LOOK, Phase.OPEN, Phase.DONE, Phase.FAILED) or grasp is None:
            return hold(q)
        match phase:
            case Phase.ABOVE:
                self._side_slews = None
                return approach_motion(arm, self._motion_planner, start, grasp, self._lying_logs(q))
            case Phase.DESCEND:
                self.grasp = grasp = self._unturned_grasp(corrected_grasp(arm, grasp, logs), q)
                deeper_m = EXTRACTION_DEPTH_M if grasp.extracts else 0.0
                return straight_line(arm, start, grasp.pose.at_height(grasp.pose.z_m - deeper_m))
            case Phase.CLOSE:
                self.drops_load = self._untried = False
                if grasp.dragging:
                    return extraction_motion(arm, start, grasp)
                return closing_motion(arm, start, grasp, closing_s)
            case Phase.LIFT:
                if grasp.is_bundle:
                    return bundle_lift_motion(arm, start, grasp)
                if not self._motion_planner.direct:
                    return straight_line(arm, start, grasp.pose.at_height(grasp.pose.z_m + VERIFY_LIFT_M))
                if self.view is not None:
                    try:
                        shown = self.view.pose(arm, start, grasp.log.diameter_m)
                        return carry_motion(arm, self._motion_planner, start, shown, grasp, logs, hangs=False)
                    except Unreachable:
                        self.view = None
                self.place = self._plan_place(arm, grasp, logs)
                return carry_motion(arm, self._motion_planner, start, self.place, grasp, logs, hangs=False)
            case Phase.CARRY:
                self.lifted_kg = arm.load_kg
                logs = self._logs_with_load([q])
                hangs_at_rad = grapple_yaw(self._profile, q)
                place = self._plan_place(arm, grasp, logs, hangs_at_rad, q[Joint.ROT])
                self.place = drop_pose = self._unturned(place, q)
                if (
                    self._turns_rotator
                    and grasp.thinnest_m < THICK_LOG_M
                    and self._horizontal_distance_m(q, drop_pose) < COLUMN_RADIUS_M
                ):
                    load = next((log for log in logs if log.seen and log.id == grasp.log.id), None)
                    if load is not None:
                        self._turn_count += 1
                        return turn_motion(arm, start, drop_pose, self._target, load, LOOSE_TURN_S_RAD)
                return carry_motion(arm, self._motion_planner, start, self.place, grasp, logs, hangs=True)
        assert self.place is not None
        if phase is Phase.LOWER:
            return hold(q) if self._is_at_place(start, self.place) else straight_line(arm, start, self.place)
        high_m = max(start.z_m, retreat_height_m(self._profile))
        if self.tests_release:
            high_m = min(high_m, start.z_m + TEST_RISE_M)
        return straight_line(arm, start, start.at_height(high_m))

    def _plan_place(
        self,
        arm: Arm,
        grasp: Grasp,
        logs: Sequence[LogObservation],
        held_yaw_rad: float | None = None,
        stands_rad: float | None = None,
    ) -> Pose:
        knows_load = self._motion_planner.knows_load
        askew_rad = 0.0 if self.sees_bunk else play_rad(grasp.thinnest_m)
        return plan_place(arm, self._job, grasp, logs, held_yaw_rad, stands_rad, knows_load, askew_rad)

    def _hanging_kg(self, phase: Phase) -> float:
        """Return the load that bends the crane in a phase, kg: that of a lifted log, otherwise 0."""
        return plausible_load_kg(self._inbox.report.load_kg) if Phase.LIFT < phase < Phase.RETREAT else 0.0

    # ------------------------------------------------------------------ position of the crane
    def is_close_above_place(self, q: Axes) -> bool:
        """Tell whether the crane is in the last part of its way down to the place."""
        if self.place is None or self._horizontal_distance_m(q, self.place) > COLUMN_RADIUS_M:
            return False
        return 0.0 < self._arm.pose(q).z_m - self.place.z_m < TOUCH_DOWN_M

    def is_off_column(self, phase: Phase, q: Axes) -> bool:
        """Tell whether the crane is outside the column of the phase's grasp or place."""
        assert self.grasp is not None
        column = self.grasp.pose if phase < Phase.CARRY else self.place
        assert column is not None
        return self._horizontal_distance_m(q, column) > COLUMN_RADIUS_M

    def is_over_grasp(self, q: Axes) -> bool:
        """Tell whether the load would come down where it was gripped."""
        assert self.grasp is not None
        return self._horizontal_distance_m(q, self.grasp.pose) < COLUMN_RADIUS_M

    def _is_at_place(self, start: Pose, place: Pose) -> bool:
        """Tell whether a log released here lies as well as at its place."""
        apart_m = dist((*self._arm.xy(start), start.z_m), (*self._arm.xy(place), place.z_m))
        return apart_m < _AT_PLACE_M and abs(start.rot_rad - place.rot_rad) < _AT_PLACE_RAD

    def _horizontal_distance_m(self, q: Axes, column: Pose) -> float:
        return dist(self._arm.xy(self._arm.pose(q)), self._arm.xy(column))

    def risen_m(self, q: Axes) -> float:
        """Return the rise of the pin since the phase began, m."""
        return self._arm.pose(q).z_m - self._phase_start_z_m

    def is_between_stakes(self, q: Axes) -> bool:
        """Tell whether opening the jaws further would stir the load at the target."""
        return is_between_stakes(self._arm, self._target, q)

    # ------------------------------------------------------------------ the newest log list
    def primary_log(self) -> LogObservation | None:
        """Return the log that the grasp grips, as detected now; None when it is hidden."""
        assert self.grasp is not None
        return next((log for log in self._visible_grasped_logs() if log.id == self.grasp.log.id), None)

    def other_logs(self) -> list[LogObservation]:
        """List the logs outside the grasp."""
        taken = {log.id for log in self._visible_grasped_logs()}
        return [log for log in self._inbox.logs if log.id not in taken]

    def confirm_lift(self, positions: Iterable[Axes], grapple: GrappleSequence) -> bool:
        """Tell whether the gripped logs hang below one of the joint positions, and restrict the grasp to them.

        Hidden logs count as held where the jaws did not close on nothing, or the load cell reads a load; thick ones
        always weigh something.
        """
        assert self.grasp is not None
        reached = list(positions)
        seen = visible_grasped_logs(self.grasp, self._logs_with_load(reached))
        held = lifted_part(self._arm, self.grasp, seen, map(self._arm.pose, reached))
        self.grasp = held or self.grasp
        hidden = not seen and not grapple.lifts_nothing and not grapple.has_lost(self.grasp)
        return held is not None or hidden

    def is_load_hidden(self, q: Axes) -> bool:
        """Tell whether the load is thin, so that it may lie askew in closed jaws or weigh too little to tell, and no
        picture shows it.
        """
        assert self.grasp is not None
        if not is_camera_measured(self.grasp) or self.grasp.thinnest_m >= THICK_LOG_M:
            return False
        return not visible_grasped_logs(self.grasp, self._logs_with_load([q]))

    def _logs_with_load(self, positions: Iterable[Axes], remembered: bool = True) -> Sequence[LogObservation]:
        """Return the newest list, with or without what it remembers; what hangs in the jaws at one of these positions
        has the number of the gripped log, and is nowhere else.
        """
        assert self.grasp is not None
        pins, gripped = map(self._arm.pose, positions), self.grasp.log.id
        listed = [log for log in self._inbox.logs if remembered or log.seen]
        logs, self._load_id = with_load_recognized(self._arm, self.grasp, listed, pins)
        self._load_ids.add(self._load_id)
        return [log for log in logs if log.seen or log.id == gripped or log.id not in self._load_ids]

    def count_miss(self) -> Problem | None:
        """Count a grasp that came up empty; return why no other is tried, or None."""
        assert self.grasp is not None
        seen = self._visible_grasped_logs()
        lost = next((log for log in seen if lies_in_bunk(self._target, log)), None)
        if lost is not None:
            return Problem("activity.log-fell-into-bunk", f"log {lost.id} fell from the grapple into the bunk")
        self.missed += 1
        if self.missed < MAX_ATTEMPTS:
            return None
        number = (seen or self.grasp.logs)[0].id
        return Problem("activity.log-missed", f"log {number} was missed {MAX_ATTEMPTS} times")

    def rotator_correction(self, q: Axes) -> float | None:
        """Compute the further rotator turn [rad] during the running motion for the log as it hangs; None when a new
        path is needed.
        """
        assert self.grasp is not None and self.place is not None
        if not self._turns_rotator:
            return 0.0
        corrected_pose = corrected_place(self._arm, self._job, self.grasp, self.place, self._logs_with_load([q]), q)
        if corrected_pose is None:
            return None
        turn = corrected_pose.rot_rad - self.place.rot_rad
        self.place, self.lifted_kg = corrected_pose, self._hanging_kg(Phase.CARRY)
        return turn

    @property
    def may_spin_on(self) -> bool:
        """Whether a thin load has just been turned above its place, and may be turned back."""
        return 0 < self._turn_count <= MAX_FURTHER_TURNS

    def shows_load(self, q: Axes) -> bool:
        """Tell whether the newest picture shows the load, not only the list, which remembers it as it hung before."""
        assert self.grasp is not None
        return bool(visible_grasped_logs(self.grasp, self._logs_with_load([q], remembered=False)))

    def has_spun_on(self, q: Axes) -> bool:
        """Tell whether the newest picture shows the load askew above its place."""
        assert self.grasp is not None and self.place is not None
        shown = self._logs_with_load([q], remembered=False)
        corrected_pose = corrected_place(self._arm, self._job, self.grasp, self.place, shown, q)
        return corrected_pose is None or abs(corrected_pose.rot_rad - self.place.rot_rad) > _ASKEW_RAD

    def with_turn(self, motion: Trajectory, from_s: float, turn_rad: float) -> Trajectory | None:
        """Return the running motion with a further turn of the rotator; None where it ends too soon for that."""
        return with_rotation(self._arm, motion, from_s, turn_rad) if turn_rad else motion

    def plan_return(self) -> None:
        """Plan to lay the load down where it was gripped, because no path leads on."""
        assert self.grasp is not None
        # The logs under a bundle have settled and lie lower now.
        above_m = _BUNDLE_RELEASE_HEIGHT_M if self.grasp.is_bundle else 0.0
        self.place = self.grasp.pose.at_height(self.grasp.pose.z_m + above_m)

    def open_higher(self) -> bool:
        """Raise the place where the jaws open, because something is in their way; False after too many times."""
        assert self.place is not None
        if self._higher_count == MAX_HIGHER:
            return False
        self._higher_count += 1
        self.place = self.place.at_height(self.place.z_m + HIGHER_M)
        return True

    def misplaced_log(self) -> Problem | None:
        """Tell why a released log does not lie where it should, or None when all do."""
        seen = [log for log in self._inbox.logs if log.seen and log.id == self._load_id] or self._visible_grasped_logs()
        log = next((log for log in seen if not is_at_target(self._job, self._target, log)), None)
        if log is None:
            return None
        x, y, z = log.center_m
        where = "across the stakes" if lies_in_bunk(self._target, log) else "not in the bunk"
        sentence = f"log {log.id} was released but lies at ({x:.2f}, {y:.2f}, {z:.2f}) m, {where}"
        return Problem("activity.log-misplaced", sentence)

    def _visible_grasped_logs(self) -> list[LogObservation]:
        assert self.grasp is not None
        return visible_grasped_logs(self.grasp, self._inbox.logs)
