"""One crane job as a state machine: one log, or what one grasp holds, from the ground into the bunk.

``Activity.step`` is pure: monotonic time, the controller's newest report and the detector's newest log list go in; a
setpoint datagram comes out every 50 ms while the controller executes setpoints (ARMED, ACTIVE) and something is left
to do.  `autonomy.crane_job.cycle` decides what is gripped and along which path; this module decides when, and what
follows.

A controller that stops, faults or falls silent pauses the activity; when it is armed again, the activity plans the
interrupted phase again from the measured pose.  Every phase has a time limit.  Failure: ``failure`` holds the reason
that ended the job, after a smooth stop along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Final

from autonomy.crane_job.cycle import MAX_HIGHER, Cycle
from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.phase_conditions import is_motion_done, motion_rate
from autonomy.crane_job.phases import PHASE_RULES, RESUME_PHASE, Phase, grapple_command
from autonomy.crane_job.rotator_estimate import (
    LoadView,
    RotatorEstimate,
    has_no_encoder,
    load_in_view,
    planning_profile,
    play_rad,
    rotator_angle_of_hanging_log,
)
from autonomy.crane_job.trajectory_tracker import BRAKE_S, TrajectoryTracker
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M
from autonomy.grasp.planner import BunkFull, Grasp, GraspSelector, NoGrasp
from autonomy.grasp.selection import select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import LEVEL, Pose
from autonomy.motion.motion_planner import MotionPlanner, TimeOptimalPlanner
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.kinematics import Unreachable
from machine.joints import JOINTS, Joint
from machine.profile import Profile
from machine.status.modes import Mode
from runtime.errors import Problem

# -- State of one crane job: its parts, and what a manager and an operator read of it.


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
        view: LoadView | None = None,
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
        self._counts = has_no_encoder(profile)
        self._machine, self._profile = profile, planning_profile(profile, self._count)
        self._view, self._viewed = view, False
        self.has_released = False
        """Whether a job that failed had already released its logs at their place: only the way up was not done."""
        self.load_unseen = False
        """Whether a load was held before the camera and no picture showed it."""
        self.judged_by_picture = False
        """Whether only a picture can tell that the load hangs in the jaws: it is too light to weigh, and is shown."""
        self._first = Phase.STOW if stow_only else Phase.LOOK
        self._fetches_next = fetches_next
        motion_planner = motion_planner or TimeOptimalPlanner()
        self._direct = motion_planner.direct
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._inbox = Inbox(self._profile)
        self._cycle = Cycle(self._profile, job or CraneJob(), motion_planner, grasp_selector, self._inbox, slope)
        self._cycle.sees_bunk = view is None
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
    def load_missing(self) -> bool:
        """Whether a load that is too light to weigh was held before the camera, and no picture showed it."""
        return self.judged_by_picture and self.load_unseen

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
        retreats = self.phase is Phase.RETREAT and problem.code != KEPT.code
        self.has_released = retreats and self._cycle.misplaced_log() is None
        self._failure = problem
        self.phase = Phase.FAILED
        self._elapsed_s = 0.0


# -- One crane job as a state machine


SETTLE_AFTER_ARRIVAL_NS: Final = 300_000_000
"""A crane at rest above logs uses a detection made this much later, ..."""
DETECTION_TIMEOUT_NS: Final = 1_500_000_000
"""... and continues without one after this long."""
VIEW_TIMEOUT_NS: Final = 3_000_000_000
"""Time for a picture of a load that is shown to a camera."""
HIDDEN_LOAD_NS: Final = 1_200_000_000
"""Time for four pictures of a load that was hidden during the motion: three make it a log of the list."""
RELEASED_NS: Final = 600_000_000
"""Time in which the load cell tells that opened jaws, risen and at rest, are empty."""
KEPT: Final = Problem(
    "activity.log-kept",
    f"the opened jaws took the log along {1 + MAX_HIGHER} times; stop the machine, secure the crane, and free the log",
)
"""A person must see to it: the next job would drag the log with it."""
_TIMEOUT_FACTOR: Final = 2.0
_FINAL_HOLD_S: Final = 0.1
_MAX_TICK_S: Final = 0.1


class Activity(ActivityState):
    """Executes one crane job; see the module's contract.

    ``phase``, ``paused`` (why it waits, or None) and ``failure`` (why it ended, or None) are for the operator;
    ``paused_code`` and ``failure_code`` are their codes.  ``idle``: nothing more will be sent.

    Args:
        job: what to pick and where to put it; by default the topmost log, into the bunk.
        last_setpoint: where an earlier job left the joints; a joint without an encoder is assumed to be there.
        motion_planner: plans the paths; by default the time-optimal planner.
        fetches_next: whether the next job would fetch a log.  With such a log in view, the crane stays between the
            stakes with open jaws; otherwise it rises above them.
        stow_only: fetch no log, but move over the bunk with the present load so that the machine may drive.
        rotator: the estimate of earlier jobs for a rotator without an encoder; holds the newest estimate afterwards.
        slope: how the machine stands, see `autonomy.motion.arm_kinematics`; level by default.
        view: the camera to which a load is shown while the rotator's angle is unsure, or because it is too light to
            weigh, for the log list only remembers; None where pictures show the load at work.
    """

    # ------------------------------------------------------------------ one tick
    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Execute one tick at ``now_ns`` and return the datagram to send now, or None.

        ``report`` and ``logs`` are the newest since the last call, None when nothing arrived.  Call at 20 Hz or faster.
        """
        dt_s = min((now_ns - (self._last_ns or now_ns)) * 1e-9, _MAX_TICK_S)
        self._last_ns = now_ns
        self._inbox.accept(now_ns, report, logs)
        if self.idle:
            return None
        blocked = self._inbox.blocked_reason(now_ns, self._tracker.setpoint)
        if blocked is not None:
            self._paused = blocked
            self.idle = self.phase in (Phase.DONE, Phase.FAILED)
            return None
        if self._paused is not None:
            self._resume()
        else:
            self._advance(dt_s)
        self._check_transition(now_ns)
        self._follow_rotator()
        self._command_grapple(dt_s)
        if self.idle or not self._stream.due(now_ns):
            return None
        tracker = self._tracker
        return self._stream.datagram(
            now_ns, self._count.motion(tracker.motion), tracker.clock_s, self._grapple.command, tracker.announce()
        )

    def _position(self) -> tuple[float, ...]:
        return self._inbox.position(self._tracker.setpoint)

    def _resume(self) -> None:
        """Continue from the measured pose, in the interrupted phase or on the way to it."""
        self._paused = None
        measured = self._position()
        follows = self._inbox.report.mode == Mode.ACTIVE and all(map(isfinite, self._inbox.report.reference))
        start = self._count.to_angles(self._inbox.report.reference) if follows else measured
        phase = self._first if self.phase is Phase.WAIT else self.phase
        if phase in RESUME_PHASE and self._cycle.is_off_column(phase, measured):
            phase = RESUME_PHASE[phase]
        self._enter(phase, start)
        self._tracker.rate = 0.0

    def _enter(self, phase: Phase, start: tuple[float, ...]) -> None:
        """Plan a phase from a joint position and begin it."""
        self.phase = phase
        self._elapsed_s = 0.0
        self._arrived_ns = self._ready_ns = self._restart_phase = None
        closing_s = self._grapple.start_following() if phase is Phase.CLOSE else 0.0
        self._viewed = False
        view = self._view if phase is Phase.LIFT and self._direct and not self._cycle.is_bundle else None
        light = self._cycle.is_too_light
        needed = view is not None and (light or view.is_needed(self.rotator, start[Joint.SLEW]))
        self._cycle.view = view if needed else None
        try:
            self._tracker.begin(self._cycle.plan(phase, start, closing_s))
            if phase is Phase.LIFT:
                self.load_unseen, self.judged_by_picture = False, light and self._cycle.view is not None
        except (Unreachable, NoGrasp) as error:
            self._tracker.begin(hold(start))
            self.bunk_full = isinstance(error, BunkFull)
            if phase in (Phase.LIFT, Phase.CARRY) and self._cycle.is_over_grasp(start):
                self._put_back_reason = _problem(error)
                self._cycle.plan_return()
                self._enter(Phase.LOWER, start)
            elif phase is Phase.ABOVE and self._cycle.restore_previous_grasp():
                self._enter(Phase.DESCEND, start)
            else:
                self._fail(_problem(error))

    def _advance(self, dt_s: float) -> None:
        """Advance along the motion, or slow down smoothly to wait for the jaws or to stop for good."""
        tracker = self._tracker
        self._elapsed_s += 0.0 if self._is_halting else dt_s
        stops = self._is_halting or self.phase is Phase.FAILED or self._restart_phase is not None
        target_rate = 0.0 if stops else motion_rate(self.phase, self._elapsed_s, tracker, self._grapple, self.grasp)
        if self.phase is Phase.LIFT and self._cycle.is_bundle:
            target_rate *= self._cycle.lift_rate(self._position())
        tracker.advance(dt_s, target_rate, self._position())
        if self.phase is Phase.FAILED and tracker.is_stopped:
            tracker.hold_here()

    def _command_grapple(self, dt_s: float) -> None:
        command = grapple_command(self.phase, self._cycle.is_bundle, stow_only=self._first is Phase.STOW)
        if command is GrappleCommand.OPEN and self.phase is not Phase.OPEN:
            command = GrappleCommand.NEUTRAL if self._cycle.is_between_stakes(self._position()) else command
        self._grapple.laden_kg = self._cycle.lifted_kg
        if self.phase is Phase.OPEN:
            self._grapple.release(dt_s)
        else:
            self._grapple.apply(command, dt_s)

    # ------------------------------------------------------------------ transitions
    def _check_transition(self, now_ns: int) -> None:
        """End the phase when its work is done, or the job when its time is over."""
        if self.phase is Phase.FAILED:
            self.idle = self._elapsed_s > BRAKE_S + _FINAL_HOLD_S
            return
        if self.phase is Phase.DONE:
            self.idle = self._elapsed_s > _FINAL_HOLD_S
            return
        if self._is_halting:
            return
        if self._restart_phase is not None:
            if self._tracker.is_stopped:
                self._enter(self._restart_phase, self._tracker.setpoint)
            return
        rule = PHASE_RULES[self.phase]
        if self._arrived_ns is None and is_motion_done(
            self.phase, self._elapsed_s, self._tracker, self._grapple, self.grasp, self._position()
        ):
            self._arrived_ns = now_ns
        lifts_bundle = self.phase is Phase.LIFT and self._cycle.is_bundle
        if lifts_bundle and self._cycle.has_slipped_off(self._grapple, self._position()):
            self._restart_phase = Phase.ABOVE
            return
        if lifts_bundle and self._tracker.is_stopped and self._cycle.lift_rate(self._position()) == 0.0:
            self._drop_load()
            return
        if self.phase in (Phase.CARRY, Phase.LOWER) and self._touches_down():
            self._restart_phase = Phase.OPEN
            return
        shows = self._cycle.view is not None
        if self.phase in (Phase.LIFT, Phase.CARRY) and self._direct and not lifts_bundle and not shows:
            self._verify_load(now_ns)
            if self._restart_phase is not None or self._failure is not None:
                return  # this list has been evaluated
        following = self._next(now_ns) if self._arrived_ns is not None else None
        if following is not None and self.halted:
            return
        if following is Phase.OPEN and self._inbox.is_fresh(now_ns):
            self._update_rotator()
        if following is not None:
            self._enter(following, self._tracker.setpoint)
        elif self._elapsed_s > _TIMEOUT_FACTOR * self.motion.duration_s + rule.settle_s + rule.slack_s:
            if self.phase is Phase.LOOK and self._look_aside():
                return
            if self.phase is Phase.OPEN and self._may_have_released:
                self._cycle.tests_release = True
                self._enter(Phase.RETREAT, self._tracker.setpoint)
                return
            off = self._tracker.worst_joint(self._position())
            self._fail(rule.timeout._replace(sentence=f"{rule.timeout.sentence} within {self._elapsed_s:.0f} s{off}"))

    def _drop_load(self) -> None:
        """Lower what the jaws lift, for it is too heavy, and grip anew.

        Not opened where they are: rid of half a tonne the crane springs up, and the controller stops it.
        """
        q, load_kg = self._position(), self._inbox.report.load_kg
        if not self._cycle.drop_load(q):
            sentence = (
                f"what the jaws lift weighs {load_kg:.0f} kg or more, too much for the machine "
                f"{self._cycle.arm.pose(q).r_m:.1f} m away; bring it nearer, or lay the logs apart"
            )
            self._put_back_reason = Problem("activity.too-heavy", sentence)
        self._enter(Phase.LOWER, self._tracker.setpoint)

    def _next(self, now_ns: int) -> Phase | None:
        """Choose the phase after this one, whose motion is done; None while a condition is not met."""
        seen = self._arrived_ns is not None and self._inbox.logs_ns >= self._arrived_ns
        match self.phase:
            case Phase.LOOK:
                return self._after_look(now_ns) if seen else None
            case Phase.ABOVE:
                return self._after_above(now_ns) if self._grapple.is_open else None
            case Phase.CLOSE:
                return self._cycle.after_closing(self._grapple)
            case Phase.LIFT if self._cycle.view is not None and not self._viewed:
                assert self._arrived_ns is not None
                self.load_unseen = now_ns >= self._arrived_ns + VIEW_TIMEOUT_NS
                return self._after_lift() if self.load_unseen else None
            case Phase.LIFT | Phase.CARRY:
                if self._waits_for_load(now_ns):
                    return None
                if self.phase is Phase.CARRY and self._is_seen_in_grapple(now_ns):
                    return Phase.LOWER
                return self._after_lift() if seen else None
            case Phase.LOWER if self._cycle.may_spin_on:
                return self._after_turn(now_ns)
            case Phase.OPEN:
                return self._after_open(now_ns)
            case Phase.RETREAT:
                return self._after_retreat(now_ns) if seen else None
            case Phase.STOW:
                return Phase.DONE
        return Phase(self.phase + 1)

    def _look_aside(self) -> bool:
        """Begin to turn to where the camera may see what boom and grapple hid; False after both sides."""
        motion = self._cycle.look_aside(self._tracker.setpoint)
        if motion is None:
            return False
        self._tracker.begin(motion)
        self._elapsed_s, self._arrived_ns, self._ready_ns = 0.0, None, None
        return True

    def _after_look(self, now_ns: int) -> Phase | None:
        """Go on to a grasp; with camera measurements, further detections may still find one for a while."""
        first_ns = self._ready_ns
        if first_ns is not None and self._inbox.logs_ns < now_ns <= first_ns + DETECTION_TIMEOUT_NS:
            return None  # no new detection
        try:
            self._cycle.select_grasp(self.motion.goal)
        except NoGrasp as error:
            self._ready_ns = first_ns or now_ns
            measured = self._inbox.has_camera_measurements
            if measured and now_ns <= self._ready_ns + DETECTION_TIMEOUT_NS:
                return None
            if not measured or not self._look_aside():
                self._fail(_problem(error))
            return None
        return None if self._cycle.is_unsure and self._look_aside() else Phase.ABOVE

    def _after_above(self, now_ns: int) -> Phase | None:
        """Go down, or first above a better grasp: from above, a camera measures logs better than from the side."""
        assert self._arrived_ns is not None
        if not self._cycle.needs_reselection:
            return Phase.DESCEND
        seen = self._inbox.logs_ns >= self._arrived_ns + SETTLE_AFTER_ARRIVAL_NS
        if (not seen or self._cycle.sees_a_part) and now_ns < self._arrived_ns + DETECTION_TIMEOUT_NS:
            return None
        return Phase.ABOVE if seen and self._cycle.reselect_grasp(self.motion.goal) else Phase.DESCEND

    def _after_lift(self) -> Phase | None:
        if self._cycle.confirm_lift((self._position(), self._tracker.setpoint), self._grapple):
            if self.phase is Phase.LIFT:
                self._update_rotator()
            return Phase(self.phase + 1)
        if problem := self._cycle.count_miss():
            self._fail(problem)
            return None
        return Phase.LOOK

    def _touches_down(self) -> bool:
        """Tell whether the load already rests, close above its place: what lies there may lie higher than was known."""
        return self._grapple.load_rests and self._cycle.is_close_above_place(self._position())

    def _after_turn(self, now_ns: int) -> Phase | None:
        """Open the jaws, or first turn the load back: a picture that is newer than the turn tells."""
        assert self._arrived_ns is not None
        q = self._position()
        if self._inbox.logs_ns >= self._arrived_ns + SETTLE_AFTER_ARRIVAL_NS and self._cycle.shows_load(q):
            return Phase.CARRY if self._cycle.has_spun_on(q) else Phase.OPEN
        return None if now_ns < self._arrived_ns + DETECTION_TIMEOUT_NS else Phase.OPEN

    def _after_open(self, now_ns: int) -> Phase | None:
        """Go up and away, or be done here with the next log in view."""
        assert self.grasp is not None
        if not self._grapple.has_released(self.grasp, self._elapsed_s):
            higher = self._grapple.must_open_higher(self.grasp) and self._cycle.open_higher()
            return Phase.LOWER if higher else None
        if self._put_back_reason:
            self._fail(self._put_back_reason)
            return None
        if self._cycle.drops_load:
            return Phase.ABOVE
        self._cycle.tests_release = self._direct and self._grapple.may_keep_load
        if self._fetches_next is None or not self._direct or self._cycle.tests_release:
            return Phase.RETREAT
        self._ready_ns = self._ready_ns or now_ns
        if self._inbox.logs_ns < self._ready_ns:
            return None
        return self._after_release() if self._sees_next else Phase.RETREAT

    @property
    def _may_have_released(self) -> bool:
        """Whether jaws without a sensor, which something kept from opening, may have let go all the same: the load cell
        tells once they have risen.
        """
        lays_down = not (self._put_back_reason or self._cycle.drops_load)
        return self._direct and lays_down and self._grapple.opens_unseen

    def _after_retreat(self, now_ns: int) -> Phase | None:
        """Be done, or open the jaws again and higher, where they have taken the load along."""
        assert self._arrived_ns is not None
        if self._cycle.tests_release:
            if now_ns < self._arrived_ns + RELEASED_NS:
                return None
            if self._grapple.has_kept_load:
                if self._cycle.open_higher():
                    return Phase.LOWER
                self._fail(KEPT)
                return None
            self._cycle.tests_release = False
            if not self._sees_next:
                return Phase.RETREAT
        return self._after_release()

    @property
    def _sees_next(self) -> bool:
        """Whether a log is in view that the next job would fetch."""
        return self._fetches_next is not None and any(map(self._fetches_next, self._cycle.other_logs()))

    def _after_release(self) -> Phase | None:
        if problem := self._cycle.misplaced_log():
            self._fail(problem)
            return None
        return Phase.DONE

    # ------------------------------------------------------------------ the load in the grapple
    def _verify_load(self, now_ns: int) -> None:
        """Verify the load during the motion; where it is not what the path was planned for, stop and plan again."""
        if self._ready_ns is None:
            risen_m = self._cycle.risen_m(self._position())
            if self.phase is Phase.CARRY or risen_m > VERIFY_LIFT_M or self._arrived_ns is not None:
                self._ready_ns = now_ns
            return
        lost = self.grasp is not None and self._grapple.has_lost(self.grasp)
        if not lost and (self._inbox.logs_ns <= self._ready_ns or self._waits_for_load(now_ns)):
            return
        self._ready_ns = self._inbox.logs_ns
        before = self.grasp
        following = self._after_lift()
        if following is Phase.LOOK:
            self._restart_phase = Phase.LOOK
        elif following is Phase.CARRY:
            turn = self._cycle.rotator_correction(self._position()) if self.grasp is before else None
            turned = None if turn is None else self._cycle.with_turn(self.motion, self._tracker.clock_s, turn)
            if turned is None:
                self._restart_phase = Phase.CARRY
                return
            self.phase = Phase.CARRY
            self._tracker.motion = turned

    def _waits_for_load(self, now_ns: int) -> bool:
        """Tell whether a load that no picture shows may be seen yet: during the motion while something hangs in the
        jaws, and for a while when the crane stands.
        """
        if not self._cycle.is_load_hidden(self._position()):
            return False
        if self._arrived_ns is None:
            return not self._grapple.lifts_nothing
        return now_ns < self._arrived_ns + HIDDEN_LOAD_NS

    def _is_seen_in_grapple(self, now_ns: int) -> bool:
        """Tell whether a recent log list shows the log in the grapple."""
        return self._direct and self._ready_ns == self._inbox.logs_ns and self._inbox.is_fresh(now_ns)

    @property
    def shows_load(self) -> bool:
        """Whether the crane stands still with its load before the camera, and a picture of it is awaited."""
        if self._paused or self.phase is not Phase.LIFT or self._cycle.view is None or self._viewed:
            return False
        arrived_ns, now_ns = self._arrived_ns, self._last_ns
        return arrived_ns is not None and now_ns is not None and now_ns >= arrived_ns + SETTLE_AFTER_ARRIVAL_NS

    def view_load(self, logs: tuple[LogObservation, ...]) -> LogObservation | None:
        """Correct the rotator by the load that a picture shows; ``logs`` are all logs of the picture in the base frame,
        taken while `shows_load`.  Returns the load, None where the picture does not show it.
        """
        q = self._position()
        load = load_in_view(self._cycle.arm, logs, self._cycle.arm.pose(q))
        if load is None or not self.shows_load:
            return None
        if self._counts:
            self._correct_count(load, q[Joint.SLEW])
        self._arrived_ns, self._viewed = self._last_ns, True  # the way on needs a list that remembers the load so
        return load

    def _correct_count(self, load: LogObservation, slew_rad: float) -> None:
        """Correct the rotator by the direction of a load that a picture shows, and plan anew with it."""
        assert self.grasp is not None
        counts = self._count.to_counts(self._tracker.setpoint)
        stands = rotator_angle_of_hanging_log(self._profile, load, slew_rad)
        play = play_rad(self.grasp.thinnest_m)
        self.rotator = self._count = self.rotator.corrected(counts[Joint.ROT], stands, play)
        self._tracker.begin(hold(self._count.to_angles(counts)))
        # A rotator that proves slower than its count takes a faster count for the same turn: plan slower turns.
        self._profile = planning_profile(self._machine, self._count)
        self._cycle.plan_for(self._profile)

    def _follow_rotator(self) -> None:
        """Add what the rotator is told to turn to its estimates."""
        if self._counts:
            sent_rad = self._count.sent(self._tracker.setpoint[Joint.ROT])
            self.rotator, self._count = self.rotator.turned(sent_rad), self._count.turned(sent_rad)

    def _update_rotator(self) -> None:
        """Correct the rotator estimate by the log that hangs in the jaws, for the next job."""
        seen = self._cycle.primary_log()
        if seen is not None and self._counts and self._view is None:
            q = self._position()
            stands = rotator_angle_of_hanging_log(self._profile, seen, q[Joint.SLEW])
            assert self.grasp is not None
            play = play_rad(self.grasp.thinnest_m)
            self.rotator = self.rotator.corrected(self._count.sent(q[Joint.ROT]), stands, play)


def _problem(error: Unreachable | NoGrasp) -> Problem:
    return Problem(error.code if isinstance(error, NoGrasp) else "activity.unreachable", str(error))
