"""A crane without mass: it follows every accepted setpoint exactly and grips what is really between its tongs.

It judges setpoints as a controller does (order, lease, range, speed, jump) and records a trace of what happened.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import atan2, cos, hypot, inf, nan, pi, remainder, sin

import numpy as np

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.selection import PlannerSelection
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.motion_planner import TimeOptimalPlanner
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, ModeSwitch, StateReport
from can_dbc.messages.datagrams import decode
from machine.geometry.grapple import grapple_yaw, half_gap_m, opening_pct_from_jaw_angle, tip_below_pin_m
from machine.geometry.sag import true_pin
from machine.joints import JOINTS
from machine.loading.profile_file import profile_hash
from machine.profile import Profile, joint
from machine.status.modes import Mode
from tests.autonomy.grasp_scenes import PROFILE
from tests.console.state_reports import REPORT

CYCLE = ["LOOK", "ABOVE", "DESCEND", "CLOSE", "LIFT", "CARRY", "LOWER", "OPEN", "RETREAT", "DONE"]
GROUND_LOG = LogObservation(0, (-1.8, 4.4, -1.29), (0.6, 0.8, 0.0), 2.6, 0.2)
HOME = (0.0, 0.75, -1.6, 0.30, 0.0)
TICK_NS = 50_000_000
GRIP_RAD = 1.15
DROP_RAD = 0.95
QUIET = dataclasses.replace(REPORT, grapple_state=0, reason=0, setpoint_sequence=0, refused=0, stale_mask=0)
"""A report without troubles."""


def activity(
    job: CraneJob | None = None, direct: bool = True, profile: Profile = PROFILE, planner=None, **how
) -> Activity:
    """A crane job; with a grasp planner, by that one's choice."""
    if planner is not None:
        how["grasp_selector"] = PlannerSelection(planner)
    return Activity(profile, profile_hash(profile), job, motion_planner=TimeOptimalPlanner(direct), **how)


def refusing(trouble: Exception) -> Callable[..., None]:
    """A function that raises, for one that finds no way or place."""

    def refuse(*_: object, **__: object) -> None:
        raise trouble

    return refuse


@dataclass
class Moment:
    """One instant of a run."""

    phase: str
    q: tuple[float, ...]
    pin: tuple[float, float, float]
    tong_rad: float
    held: LogObservation | None


@dataclass
class StandIn:
    """Controller, crane and yard in one; ``step`` is one tick of 50 ms."""

    profile: Profile
    logs: list[LogObservation]
    q: tuple[float, ...] = HOME
    mode: Mode = Mode.ARMED
    feedback: bool = True
    log_kg: float = nan  # what a load cell shows of a held log, and what the column feels
    slippery: int = 0  # so many grips come up empty
    turned_rad: float = 0.1  # the jaws grip a log that lies so far from across them, and turn it
    now_ns: int = 5_000_000_000
    tong_rad: float = 0.0
    gripped: bool = False
    held: int | None = None
    setpoint: CraneSetpoint | None = None
    trace: list[Moment] = field(default_factory=list)
    mode_switch: ModeSwitch = ModeSwitch.NOT_FITTED

    @cached_property
    def profile_hash(self) -> int:
        """Of the profile."""
        return profile_hash(self.profile)

    def report(self) -> StateReport:
        """What the controller says now."""
        opening = opening_pct_from_jaw_angle(self.profile.grapple.jaws, self.tong_rad)
        return dataclasses.replace(
            QUIET,
            profile_hash=self.profile_hash,
            stamp_ns=self.now_ns,
            mode=self.mode,
            grapple_state=5 if self.gripped else 0,
            setpoint_sequence=self.setpoint.sequence if self.setpoint else 0,
            position=self.q,
            reference=self.q,
            opening_pct=opening if self.feedback else nan,
            clamp_bar=nan,
            load_kg=self.load_kg,
            mode_switch=self.mode_switch,
        )

    def report_with(self, **changes: object) -> StateReport:
        """The same, with these values."""
        return dataclasses.replace(self.report(), **changes)

    @property
    def load_kg(self) -> float:
        """What hangs in the grapple, by its load cell; NaN without one."""
        return self.log_kg if self.held is not None else 0.0 * self.log_kg

    def pin(self) -> tuple[float, float, float]:
        """Where the hanger pin truly is."""
        load_kg = self.load_kg if 0.0 <= self.load_kg < 1e4 else 0.0  # else the cell is broken, and nothing is known
        return true_pin(self.profile.sag, self.profile.kinematics, self.q, load_kg)

    def seen(self) -> tuple[LogObservation, ...]:
        """The log list of a perfect detector."""
        return tuple(self.logs)

    def run(self, activity: Activity, limit_s: float = 120.0) -> float:
        """Runs the activity to its end; the time it took, s."""
        start_ns = self.now_ns
        while not activity.idle and self.now_ns - start_ns < limit_s * 1e9:
            self.step(activity)
        return (self.now_ns - start_ns) * 1e-9

    def until(self, activity: Activity, phase: Phase, more_s: float = 0.0) -> list[Phase]:
        """Runs the activity until it is in a phase, which it has to reach, and some time on; the phases up to there."""
        phases, start_ns = [activity.phase], self.now_ns
        while activity.phase is not phase and not activity.idle and self.now_ns - start_ns < 200e9:
            self.step(activity)
            if activity.phase is not phases[-1]:
                phases.append(activity.phase)
        assert activity.phase is phase, activity.failure
        self.steps(activity, int(more_s * 1e9 / TICK_NS))
        return phases

    def steps(self, activity: Activity, count: int) -> None:
        """So many ticks."""
        for _ in range(count):
            self.step(activity)

    def phases(self) -> list[str]:
        """The phases of the run up to now."""
        names = [moment.phase for moment in self.trace]
        return [name for k, name in enumerate(names) if k == 0 or name != names[k - 1]]

    def misreport(self, activity: Activity, **reported: object) -> CraneSetpoint:
        """A tick in which the controller reports these values, wherever the crane goes; the newest setpoint."""
        data = activity.step(self.now_ns, self.report_with(mode=Mode.ACTIVE, **reported), self.seen())
        self.setpoint = self.setpoint if data is None else decode(data)
        self.now_ns += TICK_NS
        self.q = self._knot_at(self.now_ns).position
        self._carry()
        return self.setpoint

    def step(self, activity: Activity) -> bytes | None:
        """One tick: the activity's datagram is judged, obeyed and its effect recorded."""
        data = activity.step(self.now_ns, self.report(), self.seen())
        if data is not None:
            setpoint = decode(data)
            assert isinstance(setpoint, CraneSetpoint)
            self._judge(setpoint)
            self.setpoint, self.mode = setpoint, Mode.ACTIVE
        elif self.mode is Mode.ACTIVE and self.setpoint and not self.setpoint.final:
            assert self.now_ns < self.setpoint.stamp_ns + self.setpoint.lease_ns, "the lease ran out in motion"
        self.now_ns += TICK_NS
        if self.setpoint is not None and self.mode is Mode.ACTIVE:
            self.q = self._knot_at(self.now_ns).position
            self._grapple(self.setpoint.grapple)
        self._carry()
        log = next((log for log in self.logs if log.id == self.held), None)
        pin = self.pin()
        self.trace.append(Moment(activity.phase.name, self.q, pin, self.tong_rad, log))
        return data

    def _knot_at(self, now_ns: int) -> Knot:
        after = now_ns - self.setpoint.stamp_ns
        return next((k for k in self.setpoint.knots if k.after_ns >= after), self.setpoint.knots[-1])

    def _judge(self, new: CraneSetpoint) -> None:
        assert new.stamp_ns == self.now_ns and new.profile_hash == self.profile_hash
        assert new.lease_ns <= self.profile.timeouts.lease_max_ms * 1_000_000
        assert self.mode in (Mode.ARMED, Mode.ACTIVE), f"a setpoint in {self.mode.name}"
        if self.setpoint is not None:
            assert new.sequence > self.setpoint.sequence and new.stamp_ns > self.setpoint.stamp_ns
        assert not new.final or max(map(abs, new.knots[-1].velocity)) < 1e-9
        old = self._knot_at(self.now_ns).velocity if self.setpoint else (0.0,) * 5
        for j, spec in enumerate(joint(self.profile, j) for j in JOINTS):
            for k in new.knots:
                assert spec.lower <= k.position[j] <= spec.upper
                assert abs(k.velocity[j]) <= spec.speed_limit
            assert abs(new.knots[0].position[j] - self.q[j]) <= 0.02 * spec.speed_limit
            if self.mode is Mode.ACTIVE:
                kick = abs(new.knots[0].velocity[j] - old[j])
                assert kick <= 0.25 * spec.acceleration_limit + 0.1 * spec.speed_limit

    def _grapple(self, command: GrappleCommand) -> None:
        grapple = self.profile.grapple
        full = grapple.jaws.angle_rad[-1]
        step_s = TICK_NS * 1e-9
        if command is GrappleCommand.OPEN:
            self.gripped = False
            self.tong_rad = max(0.0, self.tong_rad - full / grapple.open_time_s * step_s)
            if self.held is not None and self.tong_rad < DROP_RAD:
                self._drop()
        elif command is GrappleCommand.CLOSE and not self.gripped:
            before, self.tong_rad = self.tong_rad, self.tong_rad + full / grapple.close_time_s * step_s
            if before < GRIP_RAD <= self.tong_rad:
                self._grip()
            self.gripped = self.held is not None or self.tong_rad >= full
            self.tong_rad = min(self.tong_rad, full)

    def _grip(self) -> None:
        x, y, z = self.pin()
        tip_z = z - tip_below_pin_m(self.profile.grapple.jaws, self.tong_rad)
        for log in self.logs:
            dx, dy = x - log.center_m[0], y - log.center_m[1]
            along = dx * log.axis[0] + dy * log.axis[1]
            across = dx * log.axis[1] - dy * log.axis[0]
            yaw = atan2(log.axis[1], log.axis[0]) + pi / 2 - grapple_yaw(self.profile, self.q)
            under = tip_z < log.center_m[2]
            if abs(along) < 0.35 and abs(across) < 0.05 and abs(remainder(yaw, pi)) < self.turned_rad and under:
                if self.slippery > 0:
                    self.slippery -= 1
                else:
                    self.held, self._along = log.id, along
                    self._hangs_m = z - tip_z - log.diameter_m / 2  # its underside at the tips
                    heading = atan2(log.axis[1], log.axis[0]) - remainder(yaw, pi)  # the jaws turn it
                    self._psi = heading - grapple_yaw(self.profile, self.q)

    def _carry(self) -> None:
        if self.held is None:
            return
        x, y, z = self.pin()
        psi = self._psi + grapple_yaw(self.profile, self.q)
        at = (x - self._along * cos(psi), y - self._along * sin(psi), z - self._hangs_m)
        self._move(self.held, at, (cos(psi), sin(psi), 0.0))

    def _drop(self) -> None:
        log = next(log for log in self.logs if log.id == self.held)
        floor = self.profile.bunk.floor_z_m if over_bunk(self.profile, log.center_m) else None
        support = self.profile.workspace.ground_z_m if floor is None else floor
        self._move(log.id, (*log.center_m[:2], support + log.diameter_m / 2), log.axis)
        self.held = None

    def _move(self, which: int, center: tuple[float, ...], axis: tuple[float, float, float]) -> None:
        x, y, z = center
        self.logs = [dataclasses.replace(o, center_m=(x, y, z), axis=axis) if o.id == which else o for o in self.logs]


def to_bunk(profile: Profile, point: tuple[float, ...]) -> tuple[float, float]:
    """Along and across coordinates of a point in the bunk, m."""
    b = profile.bunk
    x, y = point[0] - b.center_m[0], point[1] - b.center_m[1]
    return x * cos(b.yaw_rad) + y * sin(b.yaw_rad), y * cos(b.yaw_rad) - x * sin(b.yaw_rad)


def over_bunk(profile: Profile, point: tuple[float, ...], margin_m: float = 0.0) -> bool:
    """Whether a point is inside the bunk's rectangle, grown by a margin."""
    along, across = to_bunk(profile, point)
    b = profile.bunk
    return abs(along) <= b.length_m / 2 + margin_m and abs(across) <= b.width_m / 2 + margin_m


def log_ends(log: LogObservation) -> list[tuple[float, ...]]:
    """Points along the axis of a log, end to end."""
    shares = np.linspace(-0.5, 0.5, 9)
    return [tuple(c + s * log.length_m * a for c, a in zip(log.center_m, log.axis, strict=True)) for s in shares]


def tips(profile: Profile, moment: Moment) -> list[tuple[float, float, float]]:
    """The two tong tips of the hanging grapple, base frame."""
    gap = half_gap_m(profile.grapple.jaws, moment.tong_rad)
    yaw = grapple_yaw(profile, moment.q)
    x, y, z = moment.pin
    z -= tip_below_pin_m(profile.grapple.jaws, moment.tong_rad)
    return [(x + s * gap * cos(yaw), y + s * gap * sin(yaw), z) for s in (-1, 1)]


def clearances(profile: Profile, trace: list[Moment]) -> dict[str, float]:
    """The least distances of a run, m: tips over ground and bunk, log over ground, bunk floor and stakes, base."""
    ground, bunk = profile.workspace.ground_z_m, profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    least = dict.fromkeys(("tip", "log", "stakes", "tips_in_stakes", "base"), inf)

    def note(what: str, value: float) -> None:
        least[what] = min(least[what], value)

    for moment in trace:
        for tip in tips(profile, moment):
            note("tip", tip[2] - (bunk.floor_z_m if over_bunk(profile, tip, 0.02) else ground))
            note("base", hypot(*tip[:2]))
            opens = moment.phase in ("OPEN", "RETREAT", "DONE")  # between single stakes, not walls
            if over_bunk(profile, tip, 0.3) and tip[2] < top and not opens:
                note("tips_in_stakes", bunk.width_m / 2 - abs(to_bunk(profile, tip)[1]))  # between them: sideways
        if moment.held is None:
            continue
        bottom = moment.held.diameter_m / 2
        for point in log_ends(moment.held):
            note("base", hypot(*point[:2]))
            inside = over_bunk(profile, point, 0.0)
            note("log", point[2] - bottom - (bunk.floor_z_m if inside else ground))
            across = abs(to_bunk(profile, point)[1])
            if over_bunk(profile, point, 0.3) and point[2] - bottom < top:
                note("stakes", bunk.width_m / 2 - across - bottom)  # between them: sideways
    return least
