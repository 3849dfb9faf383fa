"""The whole controller as one pure function: ``step(state, inputs, now_ns) -> outputs``.

Inputs: the frames and datagrams of a tick and what the loop measured of itself.  Outputs: frames to send in
order and, 50 times a second, a state report.  No clock, no socket, no randomness, no growth of memory; the
same inputs in the same order give the same bytes, so a record can be replayed.  Nothing raises on any input:
what cannot be used is refused and counted.

    read -> decode -> check -> estimate -> law -> supervise -> encode
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from can_dbc.canopen import Wire
from can_dbc.codec import Database, DbcError, load
from can_dbc.frame import Frame
from can_dbc.setpoint import CraneSetpoint, GrappleCommand, OperatorAction, StateReport, encode
from controller.config import ConfigError, Settings
from controller.estimator import JointEstimator
from controller.inputs import Received
from controller.laws.grapple import GrappleLaw
from controller.laws.pd import PdLaw
from controller.monitors import MotionMonitor
from controller.outputs import Every, Writer
from controller.requests import Gate, Refused
from controller.startup import TPDO1, Startup
from controller.supervisor import Event, Supervisor
from controller.trajectory import Trajectory
from controller.valve import ValveMap
from machine.encoder import position_from_counts
from machine.faults import Reason, pack
from machine.joints import JOINTS, N_JOINTS
from machine.modes import Mode
from machine.profile import Encoder, joint

REPORT_NS: Final = 20_000_000
HALF_SPEED: Final = 0.5
LONGEST_STEP: Final = 4
"""After a pause the law's rate limit counts at most this many periods."""


@dataclass(slots=True)
class Inputs:
    """One tick's inputs; the caller keeps one and refills it.  Counters are totals since start."""

    frames: list[Frame] = field(default_factory=list)
    datagrams: list[bytes] = field(default_factory=list)
    late_ns: int = 0
    missed_ticks: int = 0
    tick_ns: int = 0
    """How long the previous tick took."""
    bus_state: int = 0
    bus_dropped: int = 0
    """Received frames that were lost."""
    bus_refused: int = 0
    """Frames the bus did not take."""
    bus_errors: int = 0


@dataclass(slots=True)
class Outputs:
    """One tick's outputs; valid until the next `step`."""

    frames: list[Wire] = field(default_factory=list)
    report: bytes | None = None
    mode: Mode = Mode.BOOT
    reason: Reason = Reason.NONE
    detail: int = 0


class Controller:
    """All state of the controller, built once; raises ConfigError.  ``database`` spares reading the DBC again."""

    __slots__ = (
        "_dropped", "_encoder_specs", "_final", "_grapple_wanted", "_last_ns", "_lead_ns", "_lease_end_ns",
        "_longest_tick_ns", "_report_due", "_sequence", "_settings", "_worst_late_ns", "candidate",
        "commands", "estimators", "gate", "grapple", "laws", "monitors", "outputs", "received", "reference",
        "reference_velocity", "spools", "startup", "supervisor", "trajectory", "valves", "writer",
    )  # fmt: skip

    def __init__(self, settings: Settings, database: Database | None = None) -> None:
        profile = settings.profile
        try:
            database = database or load("crane")
        except DbcError as error:
            raise ConfigError(str(error)) from error
        specs = [joint(profile, j) for j in JOINTS]
        for j, spec in zip(JOINTS, specs, strict=True):
            _check_message(database, j.name.lower(), spec.encoder)
        period_s = settings.period_ns * 1e-9
        self._settings = settings
        self._encoder_specs = [s.encoder for s in specs]
        self._lead_ns = [int(s.valve.delay_s * 1e9) for s in specs]
        self.received = Received(database, profile)
        self.startup = Startup(profile)
        self.estimators = [JointEstimator(s, period_s) for s in specs]
        self.supervisor = Supervisor(profile, self.received, self.estimators, self.startup)
        self.gate = Gate(profile, settings.profile_hash, settings.key)
        self.valves = [ValveMap(s.valve) for s in specs]
        self.laws = [PdLaw(s, v) for s, v in zip(specs, self.valves, strict=True)]
        self.monitors = [MotionMonitor(s, period_s) for s in specs]
        self.grapple = GrappleLaw(profile.grapple)
        self.writer = Writer(database, profile)
        self.trajectory, self.candidate = Trajectory(), Trajectory()
        self.reference = [math.nan] * N_JOINTS
        self.reference_velocity = [0.0] * N_JOINTS
        self.commands = [0.0] * N_JOINTS
        """Joint velocities commanded in this tick."""
        self.spools = [0.0] * N_JOINTS
        self.outputs = Outputs()
        self._report_due = Every(REPORT_NS)
        self._grapple_wanted = GrappleCommand.NEUTRAL
        self._final = False
        self._last_ns = self._lease_end_ns = 0
        self._dropped = self._sequence = 0
        self._worst_late_ns = self._longest_tick_ns = 0

    def read(self, inputs: Inputs, now_ns: int) -> None:
        """Frames to values.  After an overflow of the receive queue this tick's frames are not trusted."""
        overflowed, self._dropped = inputs.bus_dropped != self._dropped, inputs.bus_dropped
        self.received.read([] if overflowed else inputs.frames, now_ns, self.startup.receive)
        for number, node in self.received.nodes.items():
            if node.booted:
                self.startup.booted(number)

    def estimate(self, now_ns: int) -> None:
        """Encoder counts to joint positions and velocities."""
        for j, (slot, spec) in enumerate(zip(self.received.encoders, self._encoder_specs, strict=True)):
            estimator = self.estimators[j]
            estimator.predict(now_ns)
            if slot is None or spec is None:
                continue
            if slot.fresh:
                estimator.sample(position_from_counts(spec, slot.get("Position")), now_ns)
            elif slot.values is None:
                estimator.reset()

    def refer(self, now_ns: int) -> None:
        """The reference of this tick: the trajectory while ACTIVE, else where the machine is."""
        active = self.supervisor.mode is Mode.ACTIVE
        for j, estimator in enumerate(self.estimators):
            if active:
                self.reference[j], self.reference_velocity[j] = self.trajectory.sample(j, now_ns)
            else:
                if estimator.known or self._encoder_specs[j] is not None:
                    self.reference[j] = estimator.position
                self.reference_velocity[j] = 0.0

    def hear(self, inputs: Inputs, now_ns: int) -> None:
        """Datagrams and the reset button."""
        # After a skip the nominal time is less than one period behind the clock, however long the stall was.
        late_ns = min(max(inputs.late_ns, 0), self._settings.period_ns)
        for data in inputs.datagrams:
            try:
                message = self.gate.take(data, now_ns, late_ns)
                if isinstance(message, CraneSetpoint):
                    self._accept(message, now_ns)
                else:
                    self._act(message, now_ns)
            except Refused as refused:
                self.gate.refuse(refused.reason, refused.detail, now_ns)
        if self.supervisor.mode is Mode.ACTIVE and self.gate.too_many(now_ns):
            self.supervisor.find(Reason.SETPOINTS_REFUSED, 0, now_ns)
        if self.supervisor.reset_edge():
            self.supervisor.ask_reset(now_ns)

    def _act(self, action: OperatorAction, now_ns: int) -> None:
        supervisor = self.supervisor
        if action is OperatorAction.STOP:
            supervisor.apply(Event.HOLD, Reason.OPERATOR_STOP, 0, now_ns)
        elif action is OperatorAction.DISARM:
            supervisor.ask_disarm(now_ns)
        elif action is OperatorAction.RESET:
            supervisor.ask_reset(now_ns)
        else:
            reason, detail = supervisor.ask_arm(now_ns)
            if reason is not Reason.NONE:
                raise Refused(reason, detail)
            self.gate.new_session()

    def _accept(self, setpoint: CraneSetpoint, now_ns: int) -> None:
        supervisor = self.supervisor
        if supervisor.mode not in (Mode.ARMED, Mode.ACTIVE):
            raise Refused(Reason.NOT_ARMED)
        self.gate.check_motion(setpoint, self.candidate, self.reference, self.reference_velocity, now_ns)
        self.trajectory, self.candidate = self.candidate, self.trajectory
        self._lease_end_ns = setpoint.stamp_ns + setpoint.lease_ns
        self._final = setpoint.final
        self._grapple_wanted = setpoint.grapple
        if supervisor.apply(Event.SETPOINT, Reason.NONE, 0, now_ns):
            self.gate.forgive()
            for law in self.laws:
                law.reset()
        self.refer(now_ns)

    def supervise(self, inputs: Inputs, now_ns: int) -> None:
        """Modes: what is lost or wrong, the lease, and whether the joints do what they were told."""
        supervisor, period_ns = self.supervisor, self._settings.period_ns
        supervisor.judge(inputs.bus_state, inputs.bus_refused, inputs.late_ns, period_ns, now_ns)
        if supervisor.mode is Mode.ACTIVE and self._lease_over(now_ns):
            if self._final and self._at_rest(now_ns):
                supervisor.apply(Event.DONE, Reason.NONE, 0, now_ns)
            else:
                supervisor.find(Reason.LEASE_LOST, 0, now_ns)
        for j, monitor in enumerate(self.monitors):
            estimator = self.estimators[j]
            if supervisor.mode not in (Mode.ARMED, Mode.ACTIVE) or not estimator.known:
                monitor.reset()
                continue
            reason = monitor.step(self.commands[j], estimator.velocity)
            if reason is not Reason.NONE:
                supervisor.find(reason, j, now_ns)

    def _lease_over(self, now_ns: int) -> bool:
        """Whether the setpoint no longer says what to do: its time is over, or its last knot still moves."""
        if now_ns >= self._lease_end_ns:
            return True
        return now_ns > self.trajectory.end_ns and not self.trajectory.ends_at_rest

    def _at_rest(self, now_ns: int) -> bool:
        return now_ns >= self.trajectory.end_ns or not any(self.reference_velocity)

    def control(self, now_ns: int) -> None:
        """The laws while ACTIVE; the last command fading while a stop's ramp runs; else neutral."""
        supervisor = self.supervisor
        mode = supervisor.mode
        elapsed_ns = min(now_ns - self._last_ns, LONGEST_STEP * self._settings.period_ns)
        if mode is Mode.ACTIVE:
            cap = HALF_SPEED if supervisor.half_speed else 1.0
            for j, law in enumerate(self.laws):
                estimator = self.estimators[j]
                lead = self.trajectory.sample(j, now_ns + self._lead_ns[j])[1]
                self.commands[j] = law.step(
                    self.reference[j],
                    self.reference_velocity[j],
                    lead,
                    estimator.position,
                    estimator.velocity,
                    cap,
                    elapsed_ns * 1e-9,
                )
            clamp = known(self.received.grapple.get("ClampPress"))
            self.grapple.step(self._grapple_wanted, clamp, self._opening_pct(), now_ns)
        else:
            share = 0.0
            if supervisor.ramping:
                left = (supervisor.ramp_end_ns - now_ns) / supervisor.ramp_ns
                share = left * left * (3.0 - 2.0 * left)  # smooth at both ends
            for j, law in enumerate(self.laws):
                self.commands[j] = law.velocity_command * share
            self.grapple.release()
        for j, valve in enumerate(self.valves):
            self.spools[j] = valve.spool_pct(self.commands[j])
        self._last_ns = now_ns

    def say(self, inputs: Inputs, now_ns: int) -> None:
        """Fills the outputs: frames in send order, and a report when it is due."""
        supervisor, outputs, writer = self.supervisor, self.outputs, self.writer
        frames = outputs.frames
        frames.clear()
        moving = supervisor.mode is Mode.ACTIVE or supervisor.ramping
        writer.commands(self.spools, self.grapple.spool_pct, self.grapple.mode, moving, supervisor.armed, frames)
        self._worst_late_ns = max(self._worst_late_ns, inputs.late_ns)
        self._longest_tick_ns = max(self._longest_tick_ns, inputs.tick_ns)
        if writer.status_due(now_ns):
            frames.append(
                writer.status(
                    supervisor.mode, supervisor.reason, supervisor.half_speed, self.received.stale_mask,
                    self._worst_late_ns, inputs.bus_errors,
                )
            )  # fmt: skip
        self.startup.step(now_ns, frames)
        writer.finish(now_ns, frames)
        outputs.mode, outputs.reason, outputs.detail = supervisor.mode, supervisor.reason, supervisor.detail
        outputs.report = self._report(inputs, now_ns) if self._report_due.due(now_ns) else None

    def _opening_pct(self) -> float:
        """The measured opening; NaN on a machine that has no sensor for it, whatever the bus says."""
        sensed = self._settings.profile.grapple.opening_sensor
        return known(self.received.grapple.get("Opening")) if sensed else math.nan

    def _report(self, inputs: Inputs, now_ns: int) -> bytes:
        supervisor, gate, grapple = self.supervisor, self.gate, self.received.grapple
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        report = StateReport(
            sequence=self._sequence,
            profile_hash=self._settings.profile_hash,
            stamp_ns=now_ns,
            mode=supervisor.mode,
            grapple_state=self.grapple.state,
            reason=pack(supervisor.reason, supervisor.detail),
            setpoint_sequence=gate.sequence,
            refusal=pack(gate.refusal, gate.detail),
            refused=gate.refused,
            stale_mask=self.received.stale_mask,
            position=tuple(e.position for e in self.estimators),
            velocity=tuple(e.velocity for e in self.estimators),
            reference=tuple(self.reference),
            opening_pct=self._opening_pct(),
            clamp_bar=known(grapple.get("ClampPress")),
            load_kg=known(grapple.get("Load")),
            tick_ns=self._longest_tick_ns,
            late_ns=self._worst_late_ns,
            missed_ticks=inputs.missed_ticks,
            frames_received=self.received.count,
        )
        self._worst_late_ns = self._longest_tick_ns = 0
        return encode(report, self._settings.key)

    def farewell(self) -> list[Wire]:
        """The last frames of a process that ends: neutral commands without the arm key, and a status."""
        frames: list[Wire] = []
        self.grapple.release()
        self.writer.commands(self.spools, 0.0, self.grapple.mode, False, False, frames)
        mask = self.received.stale_mask
        frames.append(self.writer.status(Mode.BOOT, Reason.CONTROLLER_ENDED, False, mask, 0, 0))
        return frames


def known(value: float | None) -> float:
    """A received value, NaN when there is none."""
    return math.nan if value is None else value


def _check_message(database: Database, name: str, encoder: Encoder | None) -> None:
    """Refuses a profile whose node cannot send the message it names; start-up would write to another device."""
    if encoder is None:
        return
    key = database.message(encoder.message).key
    if key != TPDO1 + encoder.node:
        raise ConfigError(
            f"joints.{name}.encoder.node: node {encoder.node} does not send {encoder.message} ({key:03X}); "
            f"give it node {key - TPDO1} or another message"
        )


def step(state: Controller, inputs: Inputs, now_ns: int) -> Outputs:
    """One tick at the nominal time ``now_ns``; the outputs are valid until the next call."""
    state.read(inputs, now_ns)
    state.estimate(now_ns)
    state.refer(now_ns)
    state.hear(inputs, now_ns)
    state.supervise(inputs, now_ns)
    state.control(now_ns)
    state.say(inputs, now_ns)
    return state.outputs
