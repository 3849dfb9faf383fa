"""A crane whose valves are as its profile says, or as ``valves`` says, its controller and its bus: for tests of the
procedure.

It obeys setpoints and spool tests without judging them, and says on the bus what it does.  Faults by name:
``backward`` and ``stuck`` joints, a controller that ``refuses``, a ``mode``, an instrument that is ``no_compass``: it
cannot tell the grapple's direction, one that is ``silent``.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from math import nan, pi

from autonomy.calibration.plan import CalibrationPlan, make_plan
from autonomy.calibration.procedure import Calibration
from autonomy.calibration.procedure_state import READING_COUNT
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, SpoolTest, StateReport
from can_dbc.messages.datagrams import decode
from machine.geometry.grapple import grapple_yaw
from machine.geometry.sag import true_pin
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile, Sag, Valve, joint
from machine.sensing import counts_from_position, empty_moment_nm, lever_share
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.autonomy.crane_stand_in import QUIET

DATABASE = load("crane")
STEP_S = 0.01
REPORT_EVERY = 2
HOME = {"palms_471": (0.0, 0.75, -1.6, 0.30, 0.0), "aoro_fc8": (0.0, 1.25, -2.39, 0.10, nan)}
SAG = Sag(0.0054, 0.0036, 0.028, 1.2e-6, 4500.0, 3000.0)


@dataclass
class Crane:
    """``step`` is 10 ms of crane and procedure."""

    name: str = "palms_471"
    surveyed: bool = True
    mode: Mode = Mode.ARMED
    backward: set[Joint] = field(default_factory=set)
    stuck: set[Joint] = field(default_factory=set)
    valves: dict[Joint, Valve] = field(default_factory=dict)
    no_compass: bool = False
    silent: bool = False
    only_turns: bool = False
    refuses: int = 0
    refusal: Reason = Reason.FINAL_MOVING
    reason: Reason = Reason.NONE
    chosen: tuple[Joint, ...] = tuple(JOINTS)
    patience_s: float = 0.0
    readings: int = READING_COUNT
    now_ns: int = 5_000_000_000
    said: SpoolTest | CraneSetpoint | None = None
    heard: list[SpoolTest | CraneSetpoint] = field(default_factory=list)
    fastest: dict[Joint, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.profile: Profile = load_profile(self.name)
        self.q = [0.0 if p != p else p for p in HOME[self.name]]
        self.v = [0.0] * len(JOINTS)
        self.opening = 100.0
        self.lines = [deque([0.0] * round(self.valve(j).delay_s / STEP_S)) for j in JOINTS]
        self.ticks = 0
        self.plan: CalibrationPlan = make_plan(self.profile, HOME[self.name], self.surveyed, self.chosen)
        if self.only_turns:
            self.plan = replace(self.plan, joints=(), survey=())
        number, how = profile_hash(self.profile), {"asked_readings": self.readings, "patience_s": self.patience_s}
        self.calibration = Calibration(self.profile, number, self.plan, DATABASE, **how)

    def valve(self, j: Joint) -> Valve:
        """The true valve of a joint."""
        return self.valves.get(j) or joint(self.profile, j).valve

    def run(self, until_s: float = 400.0, done=lambda crane: False) -> Calibration:
        """Until the procedure is over, ``done`` says so or time is up."""
        end_ns = self.now_ns + int(until_s * 1e9)
        while self.now_ns < end_ns and not self.calibration.idle and not done(self):
            self.step()
        return self.calibration

    def step(self) -> bytes | None:
        """One turn."""
        self.now_ns += int(STEP_S * 1e9)
        self.ticks += 1
        spools = self._spools()
        for j in JOINTS:
            self._move(j, spools[j])
        report = self._report() if self.ticks % REPORT_EVERY == 0 else None
        run = self.calibration
        pin = true_pin(SAG, self.profile.kinematics, self.q) if run.wants_reading and not self.silent else None
        yaw_rad = self._yaw_rad() if run.wants_yaw and not self.silent else None
        data = self.calibration.step(self.now_ns, report, self._frames(spools), pin, yaw_rad)
        if data is not None:
            message = decode(data)
            assert isinstance(message, SpoolTest | CraneSetpoint)
            self.said = message
            self.heard.append(message)
        return data

    def _yaw_rad(self) -> float:
        """What an instrument without noise shows of the grapple."""
        return nan if self.no_compass else grapple_yaw(self.profile, self.q) % pi

    def _spools(self) -> list[float]:
        spools = [0.0] * len(JOINTS)
        test = self.said
        if not isinstance(test, SpoolTest) or self.mode not in (Mode.ARMED, Mode.ACTIVE):
            return spools
        points = [(test.stamp_ns + k.after_ns, k.percent) for k in test.knots]
        if self.now_ns > min(points[-1][0], test.stamp_ns + test.lease_ns):
            return spools
        before = points[0]
        for point in points:
            if point[0] >= self.now_ns:
                span = point[0] - before[0]
                share = (self.now_ns - before[0]) / span if span > 0 else 1.0
                spools[test.function] = before[1] + share * (point[1] - before[1])
                return spools
            before = point
        return spools

    def _move(self, j: Joint, spool: float) -> None:
        spec = joint(self.profile, j)
        valve, line = self.valve(j), self.lines[j]
        line.append(spool)
        spool = line.popleft()
        full, deadband = (
            (valve.full_speed_plus, valve.deadband_plus_pct)
            if spool > 0
            else (-valve.full_speed_minus, valve.deadband_minus_pct)
        )
        self.v[j] = full * max(0.0, abs(spool) - deadband) / (100.0 - deadband)
        self.v[j] *= 0.0 if j in self.stuck else -1.0 if j in self.backward else 1.0
        self.q[j] += self.v[j] * STEP_S
        self.fastest[j] = max(self.fastest.get(j, 0.0), abs(self.v[j]) / spec.speed_limit)
        if isinstance(self.said, CraneSetpoint) and self.mode in (Mode.ARMED, Mode.ACTIVE):
            target = self.said.knots[0].position[j] if j is not Joint.ROT or spec.encoder else self.q[j]
            self.q[j] = target
        assert spec.lower - 0.02 <= self.q[j] <= spec.upper + 0.02, f"{j.name} at {self.q[j]}"

    def _report(self) -> StateReport:
        sensed = tuple(q if joint(self.profile, j).encoder else nan for j, q in zip(JOINTS, self.q, strict=True))
        return replace(
            QUIET,
            profile_hash=profile_hash(self.profile),
            stamp_ns=self.now_ns,
            mode=self.mode,
            reason=self.reason,
            refusal=self.refusal,
            refused=self.refuses,
            position=sensed,
            velocity=tuple(self.v),
            reference=sensed,
            opening_pct=self.opening,
        )

    @property
    def _lift_areas(self) -> float:
        lift = joint(self.profile, Joint.LIFT).valve
        return lift.flow_minus / lift.flow_plus

    def _lift_bar(self) -> float:
        """Pressure that carries the empty crane."""
        lift = joint(self.profile, Joint.LIFT).valve
        arm = lift.flow_plus * lever_share(lift, self.q[Joint.LIFT])
        return empty_moment_nm(SAG, self.profile.kinematics, self.q) / arm / 1e5

    def _frames(self, spools: list[float]) -> list[Frame]:
        grapple = self.said.grapple if isinstance(self.said, CraneSetpoint) else GrappleCommand.NEUTRAL
        times = self.profile.grapple
        speeds = {GrappleCommand.CLOSE: -100.0 / times.close_time_s, GrappleCommand.OPEN: 100.0 / times.open_time_s}
        speed = speeds.get(grapple, 0.0)
        self.opening = min(100.0, max(0.0, self.opening + speed * STEP_S))
        state = 1.0 if self.opening > 98.0 else 4.0 if self.opening < 2.0 else 3.0
        values: dict[str, dict[str, float]] = {
            "GrappleStat": {"State": state, "Opening": self.opening},
            "PressA": {"LiftA": self._lift_bar() + 2.0, "LiftB": 2.0 / self._lift_areas},
        }
        for prefix, kind in (("", "Cmd"), ("Spool", "Fb")):
            for j in JOINTS:
                valve = joint(self.profile, j).valve
                message = f"Valve{kind}{'A' if j < 4 else 'B'}"
                shown = spools[j] if kind == "Cmd" else self.lines[j][0]
                values.setdefault(message, {})[f"{prefix}{valve.signal}"] = valve.sign * shown
        for j in JOINTS:
            encoder = joint(self.profile, j).encoder
            if encoder is not None:
                values[encoder.message] = {"Position": counts_from_position(encoder, self.q[j])}
        frames = []
        for name, signals in values.items():
            codec = DATABASE.message(name)
            data = codec.encode(*(signals.get(s.name, 0.0) for s in codec.signals))
            frames.append(Frame(self.now_ns, codec.key, data))
        return frames
