"""The first mission as a state machine: one log, or what one grasp holds, from the ground into the bunk.

``Activity.step`` is pure: monotonic time, the controller's newest report and the detector's newest log list
go in, a setpoint datagram comes out, every 50 ms while the controller obeys (ARMED, ACTIVE) and something is
left to do.  A controller that stops, faults or falls silent pauses the activity; when it is armed again the
interrupted phase is planned anew from the measured pose.  Every phase has a time limit and a sentence for it;
``failure`` holds the one that ended the mission, after a smooth stop along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from math import dist, isfinite
from typing import Final

from autonomy import tongs
from autonomy.carried import ASIDE_M, came_up, laid, picked, place_as_seen
from autonomy.course import above, aimed, carrying, closing, gathering, stowing
from autonomy.grasp.direct import LIFT_M, Chooser, Grasp, choose, lies_in, plan_place, retreat_height
from autonomy.grasp.proposal import BunkFull, NoGrasp
from autonomy.heard import Heard
from autonomy.logs import LogObservation
from autonomy.mission import Mission
from autonomy.motion.arm import Arm, Pose
from autonomy.motion.trajectory import Trajectory, hold, straight, turned
from autonomy.motion.ways import Motions, Swiftest
from autonomy.phases import BEGIN_AGAIN, RULES, Phase
from autonomy.pursuit import BRAKE_S, Pursuit
from autonomy.rotator import Rotator, hanging, is_counted, planned
from autonomy.stream import SetpointStream
from can_dbc.setpoint import GrappleCommand, StateReport
from machine.grapple import grapple_yaw
from machine.joints import JOINTS, Joint
from machine.kinematics import Unreachable
from machine.modes import Mode
from machine.profile import Profile
from machine.sag import sane_load_kg

ATTEMPTS: Final = 3
_LAYING: Final = 2.0
"""So much less near to its goal than elsewhere a log over the bunk need come: it need not lie so exactly."""
_PRESS_S: Final = 0.6
"""So long what is pressed onto a heap may still sink."""
_LOOSE_M: Final = 0.2
"""So far over where it was gripped a bundle is let go again: pressed onto others, it would stop the crane."""
GATE_S: Final = 3.0
"""With so much of its way left an arm waits until the tongs are open: they are still high."""
_SLOWEST: Final = 2.0
_LAST_HOLD_S: Final = 0.1
_LONGEST_TICK_S: Final = 0.1


class Activity:
    """Picks the mission's log and lays it down; see the module's contract.

    ``phase``, ``paused`` (why it waits, or None), ``failure`` (why it ended, or None) and ``missed`` (grasps
    that came up empty) and ``lifted_kg`` (what hung in the grapple; 0 when nobody weighs it) are for the operator;
    ``idle`` says that nothing more will be sent.  ``rests`` is where an earlier job left the joints: one without an
    encoder is taken to stand there.  ``motions``: whose motions it makes.  ``onward`` says of a log whether the next
    job would fetch it; where there is such a log the crane stays between the stakes, with open tongs, to go on from
    there, and otherwise rises above them.  With ``stows`` no log is fetched: the crane goes over the bunk, holding
    what it may hold, for the machine to drive; where it rests there already nothing moves.  ``rotator``: what earlier
    jobs found out about one without an encoder; afterwards what is known now.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: Mission | None = None,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
        chooser: Chooser = choose,
        rests: tuple[float, ...] = (0.0,) * len(JOINTS),
        motions: Motions | None = None,
        onward: Callable[[LogObservation], bool] | None = None,
        stows: bool = False,
        rotator: Rotator | None = None,
    ) -> None:
        self.phase = Phase.WAIT
        self.paused: str | None = "the controller has not reported"
        self.failure: str | None = None
        self.missed = 0
        self.idle = False
        self.halted = False
        """A person lets it stand: it stops smoothly on its way; a grip that has begun is ended first."""
        self.grasp: Grasp | None = None
        self.place: Pose | None = None
        self.lifted_kg = 0.0
        self.no_room = False
        """What was gripped has no room in the bunk."""
        self._motions, self._onward = motions or Swiftest(), onward
        self.rotator = self._count = rotator or Rotator()
        self._profile = planned(profile, self._count)
        self._arm = Arm(self._profile, stretches=self._motions.stretches)
        self._mission = mission or Mission()
        self._target = self._mission.to(profile.bunk)
        self._choose = chooser
        self._first = Phase.STOW if stows else Phase.LOOK
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._heard = Heard(self._profile)
        self._pursuit = Pursuit(profile, rests)
        self._elapsed_s = 0.0
        self._opening_s = 0.0
        """How long the tongs have been told to open since they were closed."""
        self._command = GrappleCommand.HOLD
        self._close_from_s = 0.0
        self._arrived_ns: int | None = None
        self._ready_ns: int | None = None
        self._begun_z_m = 0.0
        self._anew: Phase | None = None
        self._sorry = ""
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
    def rests(self) -> tuple[float, ...]:
        """Where the joints were last sent, rad (EXT m), as far as is known now."""
        return self.rotator.believed(self._count.counted(self._pursuit.sent))

    @property
    def motion(self) -> Trajectory:
        """What the crane drives in the present phase."""
        return self._pursuit.motion

    @property
    def _held(self) -> bool:
        return self.halted and self.phase not in (Phase.CLOSE, Phase.DONE, Phase.FAILED)

    def abort(self, reason: str) -> None:
        """Ends the mission: the crane stops smoothly on its path within ``BRAKE_S``."""
        if self.phase not in (Phase.DONE, Phase.FAILED):
            self._fail(reason)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        """One turn at ``now_ns``: the datagram to send now, or None.

        ``report`` and ``logs`` are the newest since the last call; None and () when nothing new came.  To be
        called at 20 Hz or faster.
        """
        dt_s = min((now_ns - (self._last_ns or now_ns)) * 1e-9, _LONGEST_TICK_S)
        self._last_ns = now_ns
        self._heard.take(now_ns, report, logs)
        if self.idle:
            return None
        obstacle = self._heard.obstacle(now_ns, self._pursuit.sent)
        if obstacle is not None:
            self.paused = obstacle
            self.idle = self.phase in (Phase.DONE, Phase.FAILED)
            return None
        if self.paused is not None:
            self._resume()
        else:
            self._advance(dt_s)
        self._proceed(now_ns)
        self._tell_tongs(dt_s)
        if self.idle or not self._stream.due(now_ns):
            return None
        way = self._pursuit
        return self._stream.datagram(now_ns, self._count.motion(way.motion), way.clock_s, self._command, way.rate)

    def _position(self) -> tuple[float, ...]:
        return self._heard.position(self._pursuit.sent)

    def _resume(self) -> None:
        """Goes on from the measured pose, in the interrupted phase or at the way to it."""
        self.paused = None
        measured = self._position()
        follows = self._heard.report.mode == Mode.ACTIVE and all(map(isfinite, self._heard.report.reference))
        start = self._count.believed(self._heard.report.reference) if follows else measured
        phase = self._first if self.phase is Phase.WAIT else self.phase
        if phase in BEGIN_AGAIN:
            assert self.grasp is not None
            column = self.grasp.pose if phase < Phase.CARRY else self.place
            assert column is not None
            if dist(self._arm.xy(self._arm.pose(measured)), self._arm.xy(column)) > ASIDE_M:
                phase = BEGIN_AGAIN[phase]
        self._enter(phase, start)
        self._pursuit.rate = 0.0

    def _enter(self, phase: Phase, start: tuple[float, ...]) -> None:
        """Plans a phase from a joint position and begins it."""
        self.phase = phase
        self._elapsed_s = 0.0
        self._arrived_ns = self._ready_ns = self._anew = None
        self._begun_z_m = self._arm.pose(start).z_m
        try:
            self._pursuit.begin(self._plan(phase, start))
        except (Unreachable, NoGrasp) as error:
            self._pursuit.begin(hold(start))
            self.no_room = isinstance(error, BunkFull)
            if phase in (Phase.LIFT, Phase.CARRY) and self._over_its_place(start):
                self._put_back(str(error), start)
            else:
                self._fail(str(error))

    def _over_its_place(self, q: tuple[float, ...]) -> bool:
        """Whether what hangs in the grapple would come down where it was gripped."""
        assert self.grasp is not None
        return dist(self._arm.xy(self._arm.pose(q)), self._arm.xy(self.grasp.pose)) < ASIDE_M

    def _put_back(self, reason: str, start: tuple[float, ...]) -> None:
        """There is no way on with what is gripped: down again where it lay, and open the tongs."""
        assert self.grasp is not None
        above_m = _LOOSE_M if self.grasp.gathered else 0.0  # what lay under a bundle has settled, and hangs lower now
        self._sorry, self.place = reason, self.grasp.pose.at_height(self.grasp.pose.z_m + above_m)
        self._enter(Phase.LOWER, start)

    def _plan(self, phase: Phase, q: tuple[float, ...]) -> Trajectory:
        arm = self._arm = self._arm.loaded(self._hanging_kg(phase))
        grasp, start = self.grasp, arm.pose(q)
        if phase is Phase.STOW:
            return stowing(arm, self._motions, start, self._heard.logs)
        if phase in (Phase.LOOK, Phase.OPEN, Phase.DONE, Phase.FAILED) or grasp is None:
            return hold(q)
        match phase:
            case Phase.ABOVE:
                return above(arm, self._motions, start, grasp, self._heard.logs)
            case Phase.DESCEND:
                self.grasp = grasp = aimed(arm, grasp, self._heard.logs)
                return straight(arm, start, grasp.pose)
            case Phase.CLOSE:
                measured_s = self._closed_for_s()
                self._close_from_s = measured_s if isfinite(measured_s) else 0.0
                return closing(arm, start, grasp, self._close_from_s)
            case Phase.LIFT:
                if grasp.gathered:
                    return gathering(arm, start, grasp)
                if not self._motions.direct:
                    return straight(arm, start, grasp.pose.at_height(grasp.pose.z_m + LIFT_M))
                self.place = plan_place(arm, self._mission, grasp, self._heard.logs)
                return carrying(arm, self._motions, start, self.place, grasp, self._heard.logs, hangs=False)
            case Phase.CARRY:
                self.lifted_kg = arm.load_kg
                self.place = plan_place(arm, self._mission, grasp, self._heard.logs, grapple_yaw(self._profile, q))
                return carrying(arm, self._motions, start, self.place, grasp, self._heard.logs, hangs=True)
        assert self.place is not None
        if phase is Phase.LOWER:
            return straight(arm, start, self.place)
        return straight(arm, start, start.at_height(max(start.z_m, retreat_height(self._profile))))

    def _hanging_kg(self, phase: Phase) -> float:
        """What the crane carries in a phase: a log that it has lifted bends it, and nothing else does."""
        return sane_load_kg(self._heard.report.load_kg) if Phase.LIFT < phase < Phase.RETREAT else 0.0

    def _closed_for_s(self) -> float:
        return tongs.closed_for_s(self._profile, self._heard.report)

    def _advance(self, dt_s: float) -> None:
        """Moves on along the motion, or smoothly slower to wait for the tongs or to stop for good."""
        way = self._pursuit
        self._elapsed_s += 0.0 if self._held else dt_s
        wanted = 1.0
        if self._stops():
            wanted = 0.0
        elif self.phase is Phase.CLOSE:
            wanted = tongs.pace(self._closed_for_s() - self._close_from_s - way.clock_s)
        elif self._gathers() and not self._gripped():
            wanted = 0.0  # the logs have settled: up again when the tongs have followed
        way.advance(dt_s, wanted, self._position())
        if self.phase is Phase.FAILED and way.stands:
            way.stand()

    def _stops(self) -> bool:
        """Whether the motion is to come to a stop on its way: for good, for another, or until the tongs are ready."""
        if self._held:
            return True
        if self.phase is Phase.CLOSE:
            return self._gripped()
        if self.phase is Phase.ABOVE and self._pursuit.left_s < GATE_S and not self._opened():
            return True
        return self.phase is Phase.FAILED or self._anew is not None

    def _proceed(self, now_ns: int) -> None:
        """Ends the phase when its work is done, or the mission when its time is over."""
        if self.phase is Phase.FAILED:
            self.idle = self._elapsed_s > BRAKE_S + _LAST_HOLD_S
            return
        if self.phase is Phase.DONE:
            self.idle = self._elapsed_s > _LAST_HOLD_S
            return
        if self._held:
            return
        if self._anew is not None:
            if self._pursuit.stands:
                self._enter(self._anew, self._pursuit.sent)
            return
        rule = RULES[self.phase]
        if self._arrived_ns is None and self._at_goal(rule.settle_s):
            self._arrived_ns = now_ns
        if self.phase in (Phase.LIFT, Phase.CARRY) and self._motions.direct and not self._gathers():
            self._watch(now_ns)
        following = self._next(now_ns) if self._arrived_ns is not None else None
        if following is not None and self.halted:
            return
        if following is Phase.OPEN and self._heard.fresh(now_ns):
            self._see_rotator()
        if following is not None:
            self._enter(following, self._pursuit.sent)
        elif self._elapsed_s > _SLOWEST * self.motion.duration_s + rule.settle_s + rule.slack_s:
            off = self._pursuit.worst_joint(self._position())
            self._fail(f"{rule.trouble} within {self._elapsed_s:.0f} s{off}")

    def _at_goal(self, settle_s: float) -> bool:
        way = self._pursuit
        if self.phase is Phase.CLOSE:
            return self._gripped() and (way.stands or way.left_s <= 0.0)
        if self._rests_on_wood():
            return True
        share = _LAYING if self.phase in (Phase.CARRY, Phase.LOWER) else 1.0
        return way.clock_s >= way.motion.duration_s + settle_s and way.arrived(self._position(), share)

    def _next(self, now_ns: int) -> Phase | None:
        """The phase after this one, whose motion is done; None while it still waits for something."""
        seen = self._arrived_ns is not None and self._heard.logs_ns >= self._arrived_ns
        match self.phase:
            case Phase.LOOK:
                return self._after_look() if seen else None
            case Phase.ABOVE:
                return Phase.DESCEND if self._opened() else None
            case Phase.LIFT | Phase.CARRY:
                if self.phase is Phase.CARRY and self._carried(now_ns):
                    return Phase.LOWER
                return self._after_lift() if seen else None
            case Phase.OPEN:
                return self._after_open(now_ns)
            case Phase.RETREAT:
                return self._after_retreat() if seen else None
            case Phase.STOW:
                return Phase.DONE
        return Phase(self.phase + 1)

    def _after_look(self) -> Phase | None:
        q = self.motion.goal
        try:
            self.grasp = self._choose(self._arm, self._mission, self._heard.logs, q[Joint.SLEW], q[Joint.ROT])
        except NoGrasp as error:
            self._fail(str(error))
            return None
        return Phase.ABOVE

    def _after_lift(self) -> Phase | None:
        assert self.grasp is not None
        seen = self._picked()
        pins = [self._arm.pose(q) for q in (self._position(), self._pursuit.sent)]
        held = came_up(self._arm, self.grasp, seen, pins)
        self.grasp = held or self.grasp
        if held and self.phase is Phase.LIFT:
            self._see_rotator()
        if held or not seen:
            return Phase(self.phase + 1)
        lost = next((log for log in seen if lies_in(self._target, log)), None)
        if lost is not None:
            self._fail(f"log {lost.id} fell from the grapple into the bunk")
            return None
        self.missed += 1
        if self.missed < ATTEMPTS:
            return Phase.LOOK
        self._fail(f"log {seen[0].id} was missed {ATTEMPTS} times")
        return None

    def _watch(self, now_ns: int) -> None:
        """Judges on the way what hangs in the grapple; where it is not what the way was planned for, a stop and
        another.
        """
        assert self.grasp is not None
        if self._ready_ns is None:
            risen_m = self._arm.pose(self._position()).z_m - self._begun_z_m
            if self.phase is Phase.CARRY or risen_m > LIFT_M or self._arrived_ns is not None:
                self._ready_ns = now_ns
            return
        if self._heard.logs_ns <= self._ready_ns:
            return
        self._ready_ns = self._heard.logs_ns
        before = self.grasp
        following = self._after_lift()
        if following is Phase.LOOK:
            self._anew = Phase.LOOK
        elif following is Phase.CARRY:
            if self.phase is Phase.LIFT and not (self.grasp is before and self._goes_on_so()):
                self._anew = Phase.CARRY
            elif self.phase is Phase.LIFT:
                self.phase, self.lifted_kg = Phase.CARRY, self._hanging_kg(Phase.CARRY)

    def _gathers(self) -> bool:
        """Whether a bundle comes up slowly."""
        return self.phase is Phase.LIFT and self.grasp is not None and self.grasp.gathered

    def _rests_on_wood(self) -> bool:
        """Whether open tongs that are pressed into a heap get no deeper; they sink as they close."""
        if self.phase is not Phase.DESCEND or self.grasp is None or not self.grasp.pressed:
            return False
        late = self._elapsed_s > self.motion.duration_s + _PRESS_S
        return late or (self._pursuit.stands and self._elapsed_s > _PRESS_S)

    def _goes_on_so(self) -> bool:
        """Whether the motion will do for the log as it is now seen to hang, with another turn of the rotator."""
        assert self.grasp is not None and self.place is not None
        place = place_as_seen(self._arm, self._mission, self.grasp, self.place, self._heard.logs, self._position())
        if place is None:
            return False
        if turn := place.rot_rad - self.place.rot_rad:
            self._pursuit.motion = turned(self.motion, self._pursuit.clock_s, turn)
            self.place = place
        return True

    def _see_rotator(self) -> None:
        """What hangs in the tongs tells how the rotator stands: the next job is to know."""
        assert self.grasp is not None
        seen = next((log for log in self._picked() if log.id == self.grasp.log.id), None)
        if seen is not None and is_counted(self._profile):
            q = self._position()
            stands = hanging(self._profile, seen, q[Joint.SLEW])
            self.rotator = self.rotator.seen(self._count.sent(q[Joint.ROT]), stands)

    def _carried(self, now_ns: int) -> bool:
        """Whether the log was seen in the grapple a moment ago."""
        return self._motions.direct and self._ready_ns == self._heard.logs_ns and self._heard.fresh(now_ns)

    def _after_open(self, now_ns: int) -> Phase | None:
        """Up and away, or done here with the next log in view."""
        assert self.grasp is not None
        if not tongs.released(self._profile, self._heard.report, self.grasp, self._elapsed_s):
            return None
        if self._sorry:
            self._fail(self._sorry)
            return None
        if self._onward is None or not self._motions.direct:
            return Phase.RETREAT
        self._ready_ns = self._ready_ns or now_ns
        if self._heard.logs_ns < self._ready_ns:
            return None
        picked = {log.id for log in self._picked()}
        if any(log.id not in picked and self._onward(log) for log in self._heard.logs):
            return self._after_retreat()
        return Phase.RETREAT

    def _after_retreat(self) -> Phase | None:
        astray = next((log for log in self._picked() if not laid(self._mission, self._target, log)), None)
        if astray is None:
            return Phase.DONE
        x, y, z = astray.center_m
        self._fail(f"log {astray.id} was released but lies at ({x:.2f}, {y:.2f}, {z:.2f}) m, not in the bunk")
        return None

    def _picked(self) -> list[LogObservation]:
        """The logs of the grasp as they are seen now, without those that are hidden."""
        assert self.grasp is not None
        return picked(self.grasp, self._heard.logs)

    def _gripped(self) -> bool:
        return tongs.gripped(self._heard.report, self._elapsed_s)

    def _opened(self) -> bool:
        return tongs.opened(self._profile, self._heard.report, self._opening_s)

    def _tell_tongs(self, dt_s: float) -> None:
        command = self._command = self._grapple()
        if command is GrappleCommand.OPEN:
            self._opening_s += dt_s
        elif command is not GrappleCommand.NEUTRAL:
            self._opening_s = 0.0

    def _grapple(self) -> GrappleCommand:
        wanted = self._wanted()
        low = self.phase is not Phase.OPEN and tongs.among_stakes(self._arm, self._target, self._position())
        return GrappleCommand.NEUTRAL if wanted is GrappleCommand.OPEN and low else wanted

    def _wanted(self) -> GrappleCommand:
        if Phase.LIFT <= self.phase <= Phase.LOWER and self.grasp is not None and self.grasp.gathered:
            return GrappleCommand.CLOSE  # the logs of a bundle settle; the tongs follow
        if self.phase in RULES:
            return RULES[self.phase].grapple
        opens = self.phase is Phase.DONE and self._first is not Phase.STOW
        return GrappleCommand.OPEN if opens else GrappleCommand.HOLD

    def _fail(self, reason: str) -> None:
        self.failure = reason
        self.phase = Phase.FAILED
        self._elapsed_s = 0.0
