"""The first mission as a state machine: one log from the ground into the bunk.

``Activity.step`` is pure: monotonic time, the controller's newest report and the detector's newest log list
go in, a setpoint datagram comes out, every 50 ms while the controller obeys (ARMED, ACTIVE) and something is
left to do.  A controller that stops, faults or falls silent pauses the activity; when it is armed again the
interrupted phase is planned anew from the measured pose.  Every phase has a time limit and a sentence for it;
``failure`` holds the one that ended the mission, after a smooth stop along the path.
"""

from __future__ import annotations

from math import dist, isfinite
from typing import Final

from autonomy.grasp.direct import (
    LIFT_M,
    Grasp,
    NoGrasp,
    approach_length,
    choose,
    closing_height,
    hover_height,
    is_held,
    lies_in,
    plan_place,
    retreat_height,
    travel_height,
)
from autonomy.logs import LogObservation
from autonomy.mission import Mission
from autonomy.motion.arm import Arm, Pose
from autonomy.motion.trajectory import Trajectory, follow, hold, straight, travel
from autonomy.phases import BEGIN_AGAIN, RULES, Phase
from autonomy.stream import PERIOD_NS, SetpointStream
from can_dbc.setpoint import GrappleCommand, StateReport
from machine.grapple import grapple_yaw, tong_angle_from_opening_pct
from machine.joints import JOINTS, Joint
from machine.kinematics import Unreachable
from machine.modes import Mode
from machine.profile import Profile, joint

ATTEMPTS: Final = 3
SILENT_NS: Final = 300_000_000
ARRIVED: Final = (0.015, 0.015, 0.02, 0.02, 0.06)
"""How near each joint comes to its goal before the next phase, rad (EXT m): a few cm at the pin."""
ASIDE_M: Final = 0.15
"""Farther than this from its column, an interrupted vertical phase begins again with the way to it."""
_GRIPPED: Final = (4, 5)  # GrappleStat.State: closed, holding
_OPEN_PCT: Final = 92.0
_BRAKE_S: Final = 0.8
_LAG_S: Final = 0.4
_SLOWEST: Final = 2.0
_LAST_HOLD_S: Final = 0.3
_CLOSE_GAIN_1_S: Final = 2.0
_CLOSE_FASTEST: Final = 1.3
_LONGEST_TICK_S: Final = 0.1


class Activity:
    """Picks the mission's log and lays it down; see the module's contract.

    ``phase``, ``paused`` (why it waits, or None), ``failure`` (why it ended, or None) and ``missed`` (grasps
    that came up empty) are for the operator; ``idle`` says that nothing more will be sent.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: Mission | None = None,
        lease_ns: int = 200_000_000,
        key: bytes | None = None,
    ) -> None:
        self.phase = Phase.WAIT
        self.paused: str | None = "the controller has not reported"
        self.failure: str | None = None
        self.missed = 0
        self.idle = False
        self.grasp: Grasp | None = None
        self.place: Pose | None = None
        self._arm = Arm(profile)
        self._profile = profile
        self._mission = mission or Mission()
        self._stream = SetpointStream(profile_hash, lease_ns, key)
        self._report: StateReport | None = None
        self._report_ns = 0
        self._logs: tuple[LogObservation, ...] = ()
        self._logs_ns = -1
        self._motion = hold((0.0,) * len(JOINTS))
        self._clock_s = 0.0
        self._rate = 1.0
        self._elapsed_s = 0.0
        self._close_from_s = 0.0
        self._arrived_ns: int | None = None
        self._last_ns: int | None = None
        self._due_ns = 0

    @property
    def done(self) -> bool:
        """Whether the log lies in the bunk and the crane is clear of it."""
        return self.phase is Phase.DONE

    def abort(self, reason: str) -> None:
        """Ends the mission: the crane stops smoothly on its path within ``_BRAKE_S``."""
        if self.phase not in (Phase.DONE, Phase.FAILED):
            self._fail(reason)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        """One turn at ``now_ns``: the datagram to send now, or None.

        ``report`` and ``logs`` are the newest since the last call; None and () when nothing new came.  To be
        called at 20 Hz or faster.
        """
        dt_s = min((now_ns - (self._last_ns or now_ns)) * 1e-9, _LONGEST_TICK_S)
        self._last_ns = now_ns
        if report is not None:
            self._report, self._report_ns = report, now_ns
        if logs:
            self._logs, self._logs_ns = logs, now_ns
        if self.idle:
            return None
        obstacle = self._obstacle(now_ns)
        if obstacle is not None:
            self.paused = obstacle
            self.idle = self.phase in (Phase.DONE, Phase.FAILED)
            return None
        if self.paused is not None:
            self._resume()
        else:
            self._advance(dt_s)
        self._proceed(now_ns)
        if self.idle or now_ns < self._due_ns:
            return None
        on_time = self._due_ns > now_ns - PERIOD_NS // 2
        self._due_ns = (self._due_ns if on_time else now_ns) + PERIOD_NS
        return self._stream.datagram(now_ns, self._motion, self._clock_s, self._grapple(), self._rate)

    def _obstacle(self, now_ns: int) -> str | None:
        """Why no setpoint would be obeyed now."""
        if self._report is None:
            return "the controller has not reported"
        if now_ns - self._report_ns > SILENT_NS:
            return "the controller is silent"
        if self._report.mode not in (Mode.ARMED, Mode.ACTIVE):
            name = next((mode.name for mode in Mode if mode == self._report.mode), str(self._report.mode))
            return f"the controller is in {name}"
        if not all(map(isfinite, self._position())):
            return "a joint position is unknown"
        return None

    def _position(self) -> tuple[float, ...]:
        """The measured joints; one without an encoder counts as standing where it was last sent."""
        assert self._report is not None
        sent, _ = self._motion.at(self._clock_s)
        return tuple(
            p if joint(self._profile, j).encoder is not None else q
            for j, p, q in zip(JOINTS, self._report.position, sent, strict=True)
        )

    def _resume(self) -> None:
        """Goes on from the measured pose, in the interrupted phase or at the way to it."""
        assert self._report is not None
        self.paused = None
        measured = self._position()
        follows = self._report.mode == Mode.ACTIVE and all(map(isfinite, self._report.reference))
        start = self._report.reference if follows else measured
        phase: Phase = Phase.LOOK if self.phase is Phase.WAIT else self.phase
        if phase in BEGIN_AGAIN:
            assert self.grasp is not None
            column = self.grasp.pose if phase < Phase.CARRY else self.place
            assert column is not None
            if dist(self._arm.xy(self._arm.pose(measured)), self._arm.xy(column)) > ASIDE_M:
                phase = BEGIN_AGAIN[phase]
        self._enter(phase, start)
        self._rate = 0.0

    def _enter(self, phase: Phase, start: tuple[float, ...]) -> None:
        """Plans a phase from a joint position and begins it."""
        self.phase = phase
        self._clock_s = self._elapsed_s = 0.0
        self._rate = 1.0
        self._arrived_ns = None
        try:
            self._motion = self._plan(phase, start)
        except (Unreachable, NoGrasp) as error:
            self._motion = hold(start)
            self._fail(str(error))

    def _plan(self, phase: Phase, q: tuple[float, ...]) -> Trajectory:
        arm, grasp, high_m = self._arm, self.grasp, travel_height(self._profile)
        if phase in (Phase.LOOK, Phase.OPEN, Phase.DONE, Phase.FAILED) or grasp is None:
            return hold(q)
        start = arm.pose(q)
        match phase:
            case Phase.ABOVE:
                return travel(arm, start, grasp.pose.at_height(hover_height(self._profile, grasp)), high_m)
            case Phase.DESCEND:
                return straight(arm, start, grasp.pose)
            case Phase.CLOSE:
                return self._closing(start, grasp)
            case Phase.LIFT:
                up_m = grasp.pose.z_m + LIFT_M
                return travel(arm, start, grasp.pose.at_height(up_m), up_m)
            case Phase.CARRY:
                held_yaw = grapple_yaw(self._profile, q)
                self.place = plan_place(arm, self._mission, grasp, self._logs, held_yaw)
                free_m = approach_length(self._profile, grasp.log)
                return travel(arm, start, self.place.at_height(high_m), high_m, free_m)
        assert self.place is not None
        if phase is Phase.LOWER:
            return straight(arm, start, self.place)
        up_m = retreat_height(self._profile)
        return travel(arm, start, self.place.at_height(up_m), up_m)

    def _closing(self, start: Pose, grasp: Grasp) -> Trajectory:
        height = closing_height(self._profile, grasp.support_z_m, grasp.log.diameter_m)
        measured_s = self._closed_for_s()
        self._close_from_s = begin_s = measured_s if isfinite(measured_s) else 0.0

        def path(time_s: float) -> Pose:
            return grasp.pose.at_height(height(begin_s + time_s))

        return follow(self._arm, start, path, self._profile.grapple.close_time_s, 1.0)

    def _closed_for_s(self) -> float:
        """How long tongs of the nominal speed have been closing to be where they are measured; NaN if
        unknown.
        """
        assert self._report is not None
        opening = self._report.opening_pct
        if not isfinite(opening):
            return opening
        tongs, close_s = self._profile.grapple.tongs, self._profile.grapple.close_time_s
        return tong_angle_from_opening_pct(tongs, opening) / tongs.angle_rad[-1] * close_s

    def _advance(self, dt_s: float) -> None:
        """Moves the clock of the motion; it slows down smoothly to wait for the tongs or to stop for good."""
        self._elapsed_s += dt_s
        wanted = 1.0
        if self.phase is Phase.FAILED or (self.phase is Phase.CLOSE and self._gripped()):
            wanted = 0.0
        elif self.phase is Phase.CLOSE:
            behind_s = self._closed_for_s() - self._close_from_s - self._clock_s
            if isfinite(behind_s):
                wanted = min(max(1.0 + _CLOSE_GAIN_1_S * behind_s, 0.0), _CLOSE_FASTEST)
        wanted = min(wanted, self._pace())
        self._clock_s += self._rate * dt_s  # as the last window foretold
        most = dt_s / _BRAKE_S
        self._rate += min(max(wanted - self._rate, -most), most)
        if self.phase is Phase.FAILED and self._rate == 0.0:
            self._motion = hold(self._motion.at(self._clock_s)[0])

    def _pace(self) -> float:
        """1 while the joints follow, less when one falls behind by more than ``_LAG_S``, 0 at twice that."""
        wanted, _ = self._motion.at(self._clock_s)
        lags = [
            abs(q - p) / joint(self._profile, j).speed_limit
            for j, q, p in zip(JOINTS, wanted, self._position(), strict=True)
        ]
        return min(max(2.0 - max(lags) / _LAG_S, 0.0), 1.0)

    def _proceed(self, now_ns: int) -> None:
        """Ends the phase when its work is done, or the mission when its time is over."""
        if self.phase is Phase.FAILED:
            self.idle = self._elapsed_s > _BRAKE_S + _LAST_HOLD_S
            return
        if self.phase is Phase.DONE:
            self.idle = self._elapsed_s > _LAST_HOLD_S
            return
        rule = RULES[self.phase]
        if self._arrived_ns is None and self._at_goal(rule.settle_s):
            self._arrived_ns = now_ns
        following = self._next() if self._arrived_ns is not None else None
        if following is not None:
            resting = self.phase is not Phase.CLOSE
            self._enter(following, self._motion.goal if resting else self._motion.at(self._clock_s)[0])
        elif self._elapsed_s > _SLOWEST * self._motion.duration_s + rule.settle_s + rule.slack_s:
            self._fail(f"{rule.trouble} within {self._elapsed_s:.0f} s{self._worst_joint()}")

    def _at_goal(self, settle_s: float) -> bool:
        if self.phase is Phase.CLOSE:
            return self._gripped() and self._rate == 0.0
        there = self._clock_s >= self._motion.duration_s + settle_s
        return there and all(
            abs(p - g) <= near for p, g, near in zip(self._position(), self._motion.goal, ARRIVED, strict=True)
        )

    def _next(self) -> Phase | None:
        """The phase after this one, whose motion is done; None while it still waits for something."""
        seen = self._arrived_ns is not None and self._logs_ns >= self._arrived_ns
        match self.phase:
            case Phase.LOOK:
                return self._after_look() if seen else None
            case Phase.ABOVE | Phase.OPEN:
                return Phase(self.phase + 1) if self._opened() else None
            case Phase.LIFT | Phase.CARRY:
                return self._after_lift() if seen else None
            case Phase.RETREAT:
                return self._after_retreat() if seen else None
        return Phase(self.phase + 1)

    def _after_look(self) -> Phase | None:
        q = self._motion.goal
        try:
            self.grasp = choose(self._arm, self._mission, self._logs, q[Joint.SLEW], q[Joint.ROT])
        except NoGrasp as error:
            self._fail(str(error))
            return None
        return Phase.ABOVE

    def _after_lift(self) -> Phase | None:
        log = self._picked()
        if log is None or is_held(self._arm, log, self._arm.pose(self._motion.goal)):
            return Phase(self.phase + 1)
        if lies_in(self._profile.bunk, log):
            self._fail(f"log {log.id} fell from the grapple into the bunk")
            return None
        self.missed += 1
        if self.missed < ATTEMPTS:
            return Phase.LOOK
        self._fail(f"log {log.id} was missed {ATTEMPTS} times")
        return None

    def _after_retreat(self) -> Phase | None:
        log = self._picked()
        if log is None or lies_in(self._profile.bunk, log):
            return Phase.DONE
        x, y, z = log.center_m
        self._fail(f"log {log.id} was released but lies at ({x:.2f}, {y:.2f}, {z:.2f}) m, not in the bunk")
        return None

    def _picked(self) -> LogObservation | None:
        """The log of the grasp as it is seen now; None when it is hidden."""
        assert self.grasp is not None
        return next((log for log in self._logs if log.id == self.grasp.log.id), None)

    def _gripped(self) -> bool:
        report = self._report
        return report is not None and self._elapsed_s > 0.5 and report.grapple_state in _GRIPPED

    def _opened(self) -> bool:
        assert self._report is not None
        if isfinite(self._report.opening_pct):
            return self._report.opening_pct >= _OPEN_PCT
        return self._elapsed_s > self._profile.grapple.open_time_s

    def _grapple(self) -> GrappleCommand:
        if self.phase in RULES:
            return RULES[self.phase].grapple
        return GrappleCommand.OPEN if self.phase is Phase.DONE else GrappleCommand.HOLD

    def _worst_joint(self) -> str:
        wanted, _ = self._motion.at(self._clock_s)
        errors = [
            (abs(p - w) / near, j, p - w)
            for j, p, w, near in zip(JOINTS, self._position(), wanted, ARRIVED, strict=True)
        ]
        share, axis, error = max(errors)
        unit = "m" if axis is Joint.EXT else "rad"
        return f": the {axis.name.lower()} is {error:+.3f} {unit} off" if share > 1.0 else ""

    def _fail(self, reason: str) -> None:
        self.failure = reason
        self.phase = Phase.FAILED
        self._elapsed_s = 0.0
