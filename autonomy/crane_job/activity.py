"""The first mission as a state machine: one log, or what one grasp holds, from the ground into the bunk.

``Activity.step`` is pure: monotonic time, the controller's newest report and the detector's newest log list
go in, a setpoint datagram comes out, every 50 ms while the controller obeys (ARMED, ACTIVE) and something is
left to do.  What is gripped and which way it goes is in `autonomy.crane_job.cycle`; here is when, and what follows.  A controller
that stops, faults or falls silent pauses the activity; when it is armed again the interrupted phase is planned anew
from the measured pose.  Every phase has a time limit and a sentence for it; ``failure`` holds the one that ended the
mission, after a smooth stop along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Final

from autonomy.crane_job.cycle import Cycle
from autonomy.crane_job.grapple import GrappleSequence
from autonomy.crane_job.inbox import Inbox
from autonomy.crane_job.phase_conditions import is_motion_done, motion_rate
from autonomy.crane_job.phases import RESUME_PHASE, PHASE_RULES, Phase, grapple_command
from autonomy.crane_job.rotator_estimate import RotatorEstimate, rotator_angle_of_hanging_log, has_no_encoder, planning_profile
from autonomy.crane_job.trajectory_tracker import BRAKE_S, TrajectoryTracker
from autonomy.grasp.grapple_heights import VERIFY_LIFT_M
from autonomy.grasp.grasp import Grasp
from autonomy.grasp.planner import BunkFull, GraspSelector, NoGrasp
from autonomy.grasp.selection import select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.motion_planner import MotionPlanner, TimeOptimalPlanner
from autonomy.motion.pose import Pose
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, with_rotation
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.joints import JOINTS, Joint
from machine.geometry.kinematics import Unreachable
from machine.status.modes import Mode
from machine.profile import Profile

SETTLE_AFTER_ARRIVAL_NS: Final = 300_000_000
"""A crane that has come to rest over logs looks at them so much later, ..."""
DETECTION_TIMEOUT_NS: Final = 1_500_000_000
"""... and without that look it goes on after so long."""
_TIMEOUT_FACTOR: Final = 2.0
_FINAL_HOLD_S: Final = 0.1
_MAX_TICK_S: Final = 0.1


class Activity:
    """Picks the mission's log and lays it down; see the module's contract.

    ``phase``, ``paused`` (why it waits, or None) and ``failure`` (why it ended, or None) are for the operator;
    ``idle`` says that nothing more will be sent.  ``last_setpoint`` is where an earlier job left the joints: one without an
    encoder is taken to stand there.  ``motion_planner``: whose motions it makes.  ``fetches_next`` says of a log whether the next
    job would fetch it; where there is such a log the crane stays between the stakes, with open tongs, to go on from
    there, and otherwise rises above them.  With ``stow_only`` no log is fetched: the crane goes over the bunk, holding
    what it may hold, for the machine to drive; where it rests there already nothing moves.  ``rotator``: what earlier
    jobs found out about one without an encoder; afterwards what is known now.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: CraneJob | None = None,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
        grasp_selector: GraspSelector = select_direct,
        last_setpoint: tuple[float, ...] = (0.0,) * len(JOINTS),
        motion_planner: MotionPlanner | None = None,
        fetches_next: Callable[[LogObservation], bool] | None = None,
        stow_only: bool = False,
        rotator: RotatorEstimate | None = None,
    ) -> None:
        self.phase = Phase.WAIT
        self.paused: str | None = "the controller has not reported"
        self.failure: str | None = None
        self.idle = False
        self.halted = False
        """A person lets it stand: it stops smoothly on its way; a grip that has begun is ended first."""
        self.bunk_full = False
        """What was gripped has no room in the bunk."""
        self.rotator = self._count = rotator or RotatorEstimate()
        self._profile = planning_profile(profile, self._count)
        self._first = Phase.STOW if stow_only else Phase.LOOK
        self._fetches_next = fetches_next
        motion_planner = motion_planner or TimeOptimalPlanner()
        self._direct = motion_planner.direct
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._inbox = Inbox(self._profile)
        self._cycle = Cycle(self._profile, mission or CraneJob(), motion_planner, grasp_selector, self._inbox)
        self._grapple = GrappleSequence(self._profile, self._inbox)
        self._tracker = TrajectoryTracker(profile, last_setpoint)
        self._elapsed_s = 0.0
        self._arrived_ns: int | None = None
        self._ready_ns: int | None = None
        self._restart_phase: Phase | None = None
        self._put_back_reason = ""
        """Why what was gripped is put back."""
        self._last_ns: int | None = None

    @property
    def done(self) -> bool:
        """Whether the log lies in the bunk and the crane is clear of it."""
        return self.phase is Phase.DONE

    @property
    def arrived(self) -> bool:
        """Whether the motion of the present phase is done; it may still wait for something."""
        return self._arrived_ns is not None

    @property
    def grasp(self) -> Grasp | None:
        """What is gripped, once that is chosen."""
        return self._cycle.grasp

    @property
    def place(self) -> Pose | None:
        """Where it goes, once that is chosen."""
        return self._cycle.place

    @property
    def missed(self) -> int:
        """Grasps that came up empty."""
        return self._cycle.missed

    @property
    def lifted_kg(self) -> float:
        """What hung in the grapple; 0 when nobody weighs it."""
        return self._cycle.lifted_kg

    @property
    def last_setpoint(self) -> tuple[float, ...]:
        """Where the joints were last sent, rad (EXT m), as far as is known now."""
        return self.rotator.believed(self._count.counted(self._tracker.sent))

    @property
    def motion(self) -> Trajectory:
        """What the crane drives in the present phase."""
        return self._tracker.motion

    @property
    def _is_halting(self) -> bool:
        return self.halted and self.phase not in (Phase.CLOSE, Phase.DONE, Phase.FAILED)

    def abort(self, reason: str) -> None:
        """Ends the mission: the crane stops smoothly on its path within ``BRAKE_S``."""
        if self.phase not in (Phase.DONE, Phase.FAILED):
            self._fail(reason)

    # ------------------------------------------------------------------ one turn
    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        """One turn at ``now_ns``: the datagram to send now, or None.

        ``report`` and ``logs`` are the newest since the last call; None and () when nothing new came.  To be
        called at 20 Hz or faster.
        """
        dt_s = min((now_ns - (self._last_ns or now_ns)) * 1e-9, _MAX_TICK_S)
        self._last_ns = now_ns
        self._inbox.accept(now_ns, report, logs)
        if self.idle:
            return None
        obstacle = self._inbox.blocked_reason(now_ns, self._tracker.sent)
        if obstacle is not None:
            self.paused = obstacle
            self.idle = self.phase in (Phase.DONE, Phase.FAILED)
            return None
        if self.paused is not None:
            self._resume()
        else:
            self._advance(dt_s)
        self._check_transition(now_ns)
        self._command_grapple(dt_s)
        if self.idle or not self._stream.due(now_ns):
            return None
        way = self._tracker
        return self._stream.datagram(now_ns, self._count.motion(way.motion), way.clock_s, self._grapple.command, way.rate)

    def _position(self) -> tuple[float, ...]:
        return self._inbox.position(self._tracker.sent)

    def _resume(self) -> None:
        """Goes on from the measured pose, in the interrupted phase or at the way to it."""
        self.paused = None
        measured = self._position()
        follows = self._inbox.report.mode == Mode.ACTIVE and all(map(isfinite, self._inbox.report.reference))
        start = self._count.believed(self._inbox.report.reference) if follows else measured
        phase = self._first if self.phase is Phase.WAIT else self.phase
        if phase in RESUME_PHASE and self._cycle.is_off_column(phase, measured):
            phase = RESUME_PHASE[phase]
        self._enter(phase, start)
        self._tracker.rate = 0.0

    def _enter(self, phase: Phase, start: tuple[float, ...]) -> None:
        """Plans a phase from a joint position and begins it."""
        self.phase = phase
        self._elapsed_s = 0.0
        self._arrived_ns = self._ready_ns = self._restart_phase = None
        closing_s = self._grapple.follow() if phase is Phase.CLOSE else 0.0
        try:
            self._tracker.begin(self._cycle.plan(phase, start, closing_s))
        except (Unreachable, NoGrasp) as error:
            self._tracker.begin(hold(start))
            self.bunk_full = isinstance(error, BunkFull)
            if phase in (Phase.LIFT, Phase.CARRY) and self._cycle.is_over_grasp(start):
                self._put_back_reason = str(error)
                self._cycle.plan_return()
                self._enter(Phase.LOWER, start)
            elif phase is Phase.ABOVE and self._cycle.restore_previous_grasp():
                self._enter(Phase.DESCEND, start)
            else:
                self._fail(str(error))

    def _fail(self, reason: str) -> None:
        self.failure = reason
        self.phase = Phase.FAILED
        self._elapsed_s = 0.0

    def _advance(self, dt_s: float) -> None:
        """Moves on along the motion, or smoothly slower to wait for the tongs or to stop for good."""
        way = self._tracker
        self._elapsed_s += 0.0 if self._is_halting else dt_s
        stops = self._is_halting or self.phase is Phase.FAILED or self._restart_phase is not None
        wanted = 0.0 if stops else motion_rate(self.phase, self._elapsed_s, way, self._grapple, self.grasp)
        way.advance(dt_s, wanted, self._position())
        if self.phase is Phase.FAILED and way.is_stopped:
            way.hold_here()

    def _command_grapple(self, dt_s: float) -> None:
        command = grapple_command(self.phase, self._cycle.is_bundle, stow_only=self._first is Phase.STOW)
        if command is GrappleCommand.OPEN and self.phase is not Phase.OPEN:
            command = GrappleCommand.NEUTRAL if self._cycle.is_between_stakes(self._position()) else command
        if self.phase is Phase.OPEN:
            self._grapple.release(dt_s)
        else:
            self._grapple.apply(command, dt_s)

    # ------------------------------------------------------------------ what follows
    def _check_transition(self, now_ns: int) -> None:
        """Ends the phase when its work is done, or the mission when its time is over."""
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
                self._enter(self._restart_phase, self._tracker.sent)
            return
        rule = PHASE_RULES[self.phase]
        if self._arrived_ns is None and is_motion_done(
            self.phase, self._elapsed_s, self._tracker, self._grapple, self.grasp, self._position()
        ):
            self._arrived_ns = now_ns
        gathers = self.phase is Phase.LIFT and self._cycle.is_bundle
        if gathers and self._cycle.has_slipped_off(self._grapple, self._position()):
            self._restart_phase = Phase.ABOVE
            return
        if self.phase in (Phase.LIFT, Phase.CARRY) and self._direct and not gathers:
            self._verify_load(now_ns)
            if self._restart_phase is not None or self.phase is Phase.FAILED:
                return  # the list is judged, and not to be judged again
        following = self._next(now_ns) if self._arrived_ns is not None else None
        if following is not None and self.halted:
            return
        if following is Phase.OPEN and self._inbox.is_fresh(now_ns):
            self._update_rotator()
        if following is not None:
            self._enter(following, self._tracker.sent)
        elif self._elapsed_s > _TIMEOUT_FACTOR * self.motion.duration_s + rule.settle_s + rule.slack_s:
            off = self._tracker.worst_joint(self._position())
            self._fail(f"{rule.timeout_message} within {self._elapsed_s:.0f} s{off}")

    def _next(self, now_ns: int) -> Phase | None:
        """The phase after this one, whose motion is done; None while it still waits for something."""
        seen = self._arrived_ns is not None and self._inbox.logs_ns >= self._arrived_ns
        match self.phase:
            case Phase.LOOK:
                return self._after_look(now_ns) if seen else None
            case Phase.ABOVE:
                return self._after_above(now_ns) if self._grapple.open else None
            case Phase.CLOSE:
                return self._cycle.after_closing(self._grapple)
            case Phase.LIFT | Phase.CARRY:
                if self.phase is Phase.CARRY and self._is_seen_in_grapple(now_ns):
                    return Phase.LOWER
                return self._after_lift() if seen else None
            case Phase.OPEN:
                return self._after_open(now_ns)
            case Phase.RETREAT:
                return self._after_retreat() if seen else None
            case Phase.STOW:
                return Phase.DONE
        return Phase(self.phase + 1)

    def _after_look(self, now_ns: int) -> Phase | None:
        """Over a grasp.  What a camera measures is looked at for a while before there is said to be none."""
        first_ns = self._ready_ns
        if first_ns is not None and self._inbox.logs_ns < now_ns <= first_ns + DETECTION_TIMEOUT_NS:
            return None  # nothing new is known
        try:
            self._cycle.select_grasp(self.motion.goal)
        except NoGrasp as error:
            self._ready_ns = first_ns or now_ns
            if now_ns > self._ready_ns + DETECTION_TIMEOUT_NS or not self._inbox.has_camera_measurements:
                self._fail(str(error))
            return None
        return Phase.ABOVE

    def _after_above(self, now_ns: int) -> Phase | None:
        """Down, or first over a better grasp: from above, logs that a camera measured from aside are known better."""
        assert self._arrived_ns is not None
        if not self._cycle.needs_reselection:
            return Phase.DESCEND
        if self._inbox.logs_ns < self._arrived_ns + SETTLE_AFTER_ARRIVAL_NS:
            return None if now_ns < self._arrived_ns + DETECTION_TIMEOUT_NS else Phase.DESCEND
        return Phase.ABOVE if self._cycle.reselect_grasp(self.motion.goal) else Phase.DESCEND

    def _after_lift(self) -> Phase | None:
        if self._cycle.confirm_lift((self._position(), self._tracker.sent)):
            if self.phase is Phase.LIFT:
                self._update_rotator()
            return Phase(self.phase + 1)
        if reason := self._cycle.count_miss():
            self._fail(reason)
            return None
        return Phase.LOOK

    def _after_open(self, now_ns: int) -> Phase | None:
        """Up and away, or done here with the next log in view."""
        assert self.grasp is not None
        if not self._grapple.has_released(self.grasp, self._elapsed_s):
            return None
        if self._put_back_reason:
            self._fail(self._put_back_reason)
            return None
        if self._fetches_next is None or not self._direct:
            return Phase.RETREAT
        self._ready_ns = self._ready_ns or now_ns
        if self._inbox.logs_ns < self._ready_ns:
            return None
        return self._after_retreat() if any(map(self._fetches_next, self._cycle.others())) else Phase.RETREAT

    def _after_retreat(self) -> Phase | None:
        if reason := self._cycle.misplaced_log():
            self._fail(reason)
            return None
        return Phase.DONE

    # ------------------------------------------------------------------ what hangs in the grapple
    def _verify_load(self, now_ns: int) -> None:
        """Judges on the way what hangs in the grapple; where it is not what the way was planned for, a stop and
        another.
        """
        if self._ready_ns is None:
            risen_m = self._cycle.risen_m(self._position())
            if self.phase is Phase.CARRY or risen_m > VERIFY_LIFT_M or self._arrived_ns is not None:
                self._ready_ns = now_ns
            return
        if self._inbox.logs_ns <= self._ready_ns:
            return
        self._ready_ns = self._inbox.logs_ns
        before = self.grasp
        following = self._after_lift()
        if following is Phase.LOOK:
            self._restart_phase = Phase.LOOK
        elif following is Phase.CARRY:
            turn = self._cycle.rotator_correction(self._position()) if self.grasp is before else None
            if turn is None:
                self._restart_phase = Phase.CARRY
                return
            self.phase = Phase.CARRY
            if turn:
                self._tracker.motion = with_rotation(self.motion, self._tracker.clock_s, turn)

    def _is_seen_in_grapple(self, now_ns: int) -> bool:
        """Whether the log was seen in the grapple a moment ago."""
        return self._direct and self._ready_ns == self._inbox.logs_ns and self._inbox.is_fresh(now_ns)

    def _update_rotator(self) -> None:
        """What hangs in the tongs tells how the rotator stands: the next job is to know."""
        seen = self._cycle.first()
        if seen is not None and has_no_encoder(self._profile):
            q = self._position()
            stands = rotator_angle_of_hanging_log(self._profile, seen, q[Joint.SLEW])
            self.rotator = self.rotator.seen(self._count.sent(q[Joint.ROT]), stands)
