"""The whole controller as one pure function: ``step(state, inputs, now_ns) -> outputs``.

Inputs: the frames and datagrams of a tick and what the loop measured of itself.  Outputs: frames to send in
order, 50 times a second a state report and, from a machine that drives, 20 times a vehicle report.  No clock, no
socket, no randomness, no growth of memory; the same inputs in the same order give the same bytes, so a record can be
replayed.  Nothing raises on any input: what cannot be used is refused and counted.  ``mark`` is called after each stage
(`STAGES`); the loop stamps there.

    read -> decode -> check -> estimate -> law -> supervise -> encode
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from can_dbc.canopen import Wire, sync_frame
from can_dbc.codec import Database, DbcError, load
from can_dbc.frame import Frame
from can_dbc.setpoint import CraneSetpoint, OperatorAction, SpoolTest
from can_dbc.tick_record import BusReading
from can_dbc.vehicle_datagrams import DriveSetpoint
from controller.bus_watch import BusWatch
from controller.carrier.vehicle import Vehicle
from controller.config import ConfigError, Settings
from controller.crane import Crane
from controller.estimator import JointEstimator
from controller.inputs import Received
from controller.monitors import MotionMonitor
from controller.outputs import Writer
from controller.reports import Reports
from controller.requests import Gate, Refused
from controller.startup import Startup, check_nodes
from controller.supervisor import OPERATING, Event, Supervisor
from machine.encoder import position_from_counts
from machine.joints import JOINTS
from machine.modes import Mode
from machine.profile import joint
from machine.reasons import Reason

HALF_SPEED: Final = 0.5
STAGES: Final = ("decode", "estimate", "supervise", "law", "encode")
LONGEST_STEP: Final = 4
"""After a pause the law's rate limit counts at most this many periods."""


@dataclass(slots=True)
class Inputs:
    """One tick's inputs; the caller keeps one and refills it.  Counters are totals since start.

    ``frames`` and ``bus`` are of crane0; those of mach0 stay as they are on a machine without carrier.
    """

    frames: list[Frame] = field(default_factory=list)
    machine_frames: list[Frame] = field(default_factory=list)
    bus: BusReading = field(default_factory=BusReading)
    machine_bus: BusReading = field(default_factory=BusReading)
    datagrams: list[bytes] = field(default_factory=list)
    late_ns: int = 0
    missed_ticks: int = 0
    tick_ns: int = 0
    """How long the previous tick took."""


@dataclass(slots=True)
class Outputs:
    """One tick's outputs; valid until the next `step`.

    ``frames`` are sent at once on crane0, ``machine_frames`` on mach0.  ``sync`` is sent on crane0 a lead before the
    next tick, so that the encoders' answers to it are in when that tick begins, and no older than the lead.
    """

    frames: list[Wire] = field(default_factory=list)
    machine_frames: list[Wire] = field(default_factory=list)
    sync: Wire = field(default_factory=lambda: sync_frame(1))
    report: bytes | None = None
    vehicle_report: bytes | None = None
    mode: Mode = Mode.BOOT
    reason: Reason = Reason.NONE
    detail: int = 0


class Controller:
    """All state of the controller, built once; raises ConfigError.

    ``database`` (of crane0) and ``machine_databases`` (machine and gnss) spare reading them again.
    """

    __slots__ = (
        "_encoder_specs", "_last_ns", "_reports", "_settings", "commands", "crane", "crane_watch", "estimators",
        "follower", "gate", "grapple", "inputs_in_use", "law", "machine_bus", "monitors", "outputs", "received",
        "spool_run", "spools", "startup", "supervisor", "sway", "vehicle", "writer",
    )  # fmt: skip

    def __init__(
        self,
        settings: Settings,
        database: Database | None = None,
        machine_databases: tuple[Database, Database] | None = None,
    ) -> None:
        profile = settings.profile
        try:
            database = database or load("crane")
        except DbcError as error:
            raise ConfigError(str(error)) from error
        specs = [joint(profile, j) for j in JOINTS]
        check_nodes(database, profile)
        period_s = settings.period_ns * 1e-9
        self._settings = settings
        self._encoder_specs = [s.encoder for s in specs]
        self.received = Received(database, profile)
        self.crane_watch = BusWatch(0)
        carrier, articulation = profile.carrier, self.received.articulation
        self.vehicle = Vehicle(settings, carrier, articulation, machine_databases) if carrier and articulation else None
        """None, as ``machine_bus``, on a machine that stands still."""
        self.machine_bus = self.vehicle.bus if self.vehicle else None
        self.startup = Startup(profile)
        self.estimators = [JointEstimator(s, period_s) for s in specs]
        self.supervisor = Supervisor(
            profile, self.received, self.crane_watch, self.machine_bus, self.estimators, self.startup
        )
        self.gate = Gate(profile, settings.profile_hash, settings.key)
        self.crane = crane = Crane(settings, self.received, self.estimators, self.gate)
        self.law, self.follower, self.spool_run, self.sway = crane.law, crane.follower, crane.spool_run, crane.sway
        self.commands, self.spools, self.grapple = crane.commands, crane.spools, crane.grapple
        self.monitors = [MotionMonitor(s, period_s) for s in specs]
        self.writer = Writer(database, profile)
        slots = self.received.slots + (self.machine_bus.received.slots if self.machine_bus else ())
        self.inputs_in_use = tuple((slot.codec.name, slot) for slot in slots)
        """Every message that is listened to, of both buses."""
        self._reports = Reports(settings, self.supervisor, self.gate, self.received, crane, self.estimators)
        self.outputs = Outputs()
        self._last_ns = 0

    def elapse(self, now_ns: int) -> int:
        """Time since the tick before [ns]; after a pause the laws count only a part of it."""
        elapsed_ns = min(now_ns - self._last_ns, LONGEST_STEP * self._settings.period_ns)
        self._last_ns = now_ns
        return elapsed_ns

    def read(self, inputs: Inputs, now_ns: int) -> None:
        """Frames to values.  After an overflow of the receive queue this tick's frames are not trusted, and after a
        recovery of the bus nothing is known any more.
        """
        received, watch, machine = self.received, self.crane_watch, self.machine_bus
        watch.read(inputs.bus, True, now_ns)
        if watch.recovered:
            received.forget()
            self.startup.again()
        received.read([] if watch.lost else inputs.frames, now_ns, self.startup.receive)
        for number in received.nodes.booted:
            self.startup.booted(number)
        if machine is not None:
            machine.read(inputs.machine_frames, inputs.machine_bus, bool(self.outputs.machine_frames), now_ns)

    def estimate(self, elapsed_ns: int, now_ns: int) -> None:
        """Encoder counts to joint positions and velocities, and where the carrier is."""
        for j, (slot, spec) in enumerate(zip(self.received.encoders, self._encoder_specs, strict=True)):
            estimator = self.estimators[j]
            estimator.predict(now_ns)
            if slot is None or spec is None:
                continue
            if slot.fresh:
                estimator.sample(position_from_counts(spec, slot.get("Position")), slot.stamp_ns)
            elif slot.values is None:
                estimator.reset()
        if self.vehicle is not None:
            self.vehicle.estimate(elapsed_ns, now_ns)

    def refer(self, now_ns: int) -> None:
        """The crane's reference of this tick."""
        self.crane.refer(self.supervisor.mode is Mode.ACTIVE, self._cap, now_ns)

    @property
    def _cap(self) -> float:
        """Share of the speed limits that is allowed."""
        return HALF_SPEED if self.supervisor.half_speed else 1.0

    def hear(self, inputs: Inputs, now_ns: int) -> None:
        """Datagrams and the reset button."""
        # After a skip the nominal time is less than one period behind the clock, however long the stall was.
        late_ns = min(max(inputs.late_ns, 0), self._settings.period_ns)
        for data in inputs.datagrams:
            try:
                message = self.gate.take(data, now_ns, late_ns)
                if isinstance(message, CraneSetpoint):
                    self._accept(message, now_ns)
                elif isinstance(message, SpoolTest):
                    self._accept_test(message, now_ns)
                elif isinstance(message, DriveSetpoint):
                    self._accept_drive(message, now_ns, late_ns)
                else:
                    self._act(message, now_ns)
            except Refused as refused:
                self.gate.refuse(refused.reason, refused.detail, now_ns)
        if self.supervisor.mode is Mode.ACTIVE and self._too_many(now_ns):
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
            if self.vehicle is not None:
                self.vehicle.order.new_session()

    def _too_many(self, now_ns: int) -> bool:
        """Whether what moves now, crane or carrier, was asked for nonsense too often."""
        vehicle = self.vehicle
        drive = vehicle is not None and vehicle.setpoint is not None and vehicle.order.too_many(now_ns)
        return drive or (self.crane.leased and self.gate.too_many(now_ns))

    def _accept(self, setpoint: CraneSetpoint, now_ns: int) -> None:
        if self.supervisor.mode not in OPERATING:
            raise Refused(Reason.NOT_ARMED)
        if self.vehicle is not None and self.vehicle.moves and not self.crane.holds(setpoint):
            raise Refused(Reason.CARRIER_MOVES)
        tested = self.crane.take(setpoint, now_ns)
        self._activate(tested, now_ns)
        self.refer(now_ns)

    def _accept_test(self, test: SpoolTest, now_ns: int) -> None:
        if self.supervisor.mode not in OPERATING:
            raise Refused(Reason.NOT_ARMED)
        if self.vehicle is not None and self.vehicle.moves:
            raise Refused(Reason.CARRIER_MOVES)
        self.crane.take_test(test, now_ns)
        self._activate(False, now_ns)

    def _activate(self, anew: bool, now_ns: int) -> None:
        """ACTIVE from here on; the laws begin at neutral when they did not drive before."""
        self.supervisor.apply(Event.SETPOINT, Reason.NONE, 0, now_ns)
        began = not self.crane.leased
        self.crane.leased = True
        if began:
            self.gate.forgive()
        if began or anew:
            self.crane.begin()

    def _accept_drive(self, setpoint: DriveSetpoint, now_ns: int, late_ns: int) -> None:
        """Refusals of drive setpoints are the vehicle's, and the vehicle's report tells of them."""
        vehicle = self.vehicle
        if vehicle is None:
            raise Refused(Reason.CANNOT_DRIVE)
        try:
            if self.supervisor.mode not in OPERATING:
                raise Refused(Reason.NOT_ARMED)
            began = vehicle.take(setpoint, self.crane.moves(now_ns), now_ns, late_ns)
        except Refused as refused:
            vehicle.order.refuse(refused.reason, refused.detail, now_ns)
            return
        self.supervisor.apply(Event.SETPOINT, Reason.NONE, 0, now_ns)
        if began:
            vehicle.order.forgive()

    def supervise(self, inputs: Inputs, now_ns: int) -> None:
        """Modes: what is lost or wrong, the lease, and whether the joints do what they were told."""
        supervisor, period_ns = self.supervisor, self._settings.period_ns
        supervisor.judge(inputs.late_ns, period_ns, now_ns)
        if supervisor.mode is Mode.ACTIVE:
            self._judge_leases(now_ns)
        run = self.spool_run
        if supervisor.mode is Mode.ACTIVE and run.running:
            tested = self.estimators[run.function]
            reason = run.judge(tested.position, tested.velocity, self._cap, now_ns)
            if reason is not Reason.NONE:
                supervisor.find(reason, run.function, now_ns)
        if self.vehicle is not None:
            reason, detail = self.vehicle.judge(supervisor.armed, now_ns)
            if reason is not Reason.NONE:
                supervisor.find(reason, detail, now_ns)
        watched = supervisor.mode in OPERATING
        for j, monitor in enumerate(self.monitors):
            estimator = self.estimators[j]
            if not watched or not estimator.known:
                monitor.reset()
                continue
            reason = monitor.step(self.crane.commands[j], estimator.velocity)
            if reason is not Reason.NONE:
                supervisor.find(reason, j, now_ns)
                watched = supervisor.mode in OPERATING

    def _judge_leases(self, now_ns: int) -> None:
        """A lease that is over ends its motion in peace, or else the machine holds; without any it is armed again."""
        supervisor, crane, vehicle = self.supervisor, self.crane, self.vehicle
        if crane.leased and crane.over(now_ns):
            if not crane.finished(now_ns):
                supervisor.find(Reason.LEASE_LOST, 0, now_ns)
                return
            crane.leased = False
        if vehicle is not None and vehicle.setpoint is not None and vehicle.over(now_ns):
            if not vehicle.stands:
                supervisor.find(Reason.LEASE_LOST, 0, now_ns)
                return
            vehicle.end()
        if not crane.leased and (vehicle is None or vehicle.setpoint is None):
            supervisor.apply(Event.DONE, Reason.NONE, 0, now_ns)

    def control(self, elapsed_ns: int, now_ns: int) -> None:
        """The laws while ACTIVE; the last command fading while a stop's ramp runs; else neutral."""
        supervisor = self.supervisor
        active, ramping = supervisor.mode is Mode.ACTIVE, supervisor.ramping
        self.crane.control(active, self._ramp_share(now_ns), ramping, self._cap, now_ns, elapsed_ns)
        vehicle = self.vehicle
        if vehicle is not None:
            vehicle.control(active, ramping and not supervisor.latching, self._cap, now_ns)
            supervisor.coast_ns = int(vehicle.drive.stop_s * 1e9)

    def _ramp_share(self, now_ns: int) -> float:
        """What is left of the last command while a stop's ramp runs."""
        supervisor = self.supervisor
        if not supervisor.ramping or now_ns >= supervisor.ramp_end_ns:
            return 0.0
        left = (supervisor.ramp_end_ns - now_ns) / supervisor.ramp_ns
        return left * left * (3.0 - 2.0 * left)  # smooth at both ends

    def say(self, inputs: Inputs, now_ns: int) -> None:
        """Fills the outputs: frames in send order, and a report when it is due."""
        supervisor, outputs, writer, crane = self.supervisor, self.outputs, self.writer, self.crane
        frames = outputs.frames
        frames.clear()
        moving = crane.leased or supervisor.ramping
        writer.commands(crane.spools, crane.grapple.spool_pct, crane.grapple.mode, moving, supervisor.armed, frames)
        rates = crane.follower.ahead if supervisor.mode is Mode.ACTIVE else crane.commands
        writer.references(self.reference, rates, moving, frames)
        self._reports.measure(inputs.late_ns, inputs.tick_ns)
        if writer.status_due(now_ns):
            frames.append(
                writer.status(
                    supervisor.mode, supervisor.reason, supervisor.half_speed, self.stale_mask,
                    self._reports.late_ns, inputs.bus.errors,
                )
            )  # fmt: skip
        self.startup.step(now_ns, frames)
        outputs.sync = writer.finish(now_ns, frames)
        machine = self.machine_bus
        if machine is not None:
            machine.write(supervisor.mode, supervisor.reason, supervisor.half_speed, now_ns, outputs.machine_frames)
        outputs.mode, outputs.reason, outputs.detail = supervisor.mode, supervisor.reason, supervisor.detail
        heard = self.received.count + (machine.received.count if machine is not None else 0)
        outputs.report = self._reports.report(self.stale_mask, inputs.missed_ticks, heard, now_ns)
        outputs.vehicle_report = self.vehicle.report(now_ns) if self.vehicle is not None else None

    @property
    def reference(self) -> list[float]:
        """Where every joint is to be now."""
        return self.crane.follower.reference

    @property
    def reference_velocity(self) -> list[float]:
        """How fast the reference moves."""
        return self.crane.follower.velocity

    @property
    def stale_mask(self) -> int:
        """Inputs of both buses of which nothing fresh is known."""
        machine = self.machine_bus
        return self.received.stale_mask | (machine.received.stale_mask if machine is not None else 0)

    def farewell(self) -> list[Wire]:
        """The last frames of a process that ends: neutral commands without the arm key, and a status."""
        frames: list[Wire] = []
        grapple = self.crane.grapple
        grapple.release()
        self.writer.commands(self.crane.spools, 0.0, grapple.mode, False, False, frames)
        frames.append(self.writer.status(Mode.BOOT, Reason.CONTROLLER_ENDED, False, self.stale_mask, 0, 0))
        return frames

    def machine_farewell(self) -> list[Wire]:
        """The same for mach0."""
        return self.machine_bus.farewell() if self.machine_bus is not None else []


def _unmarked() -> None:
    """Nobody times the stages."""


def step(state: Controller, inputs: Inputs, now_ns: int, mark: Callable[[], None] = _unmarked) -> Outputs:
    """One tick at the nominal time ``now_ns``; the outputs are valid until the next call."""
    elapsed_ns = state.elapse(now_ns)
    state.read(inputs, now_ns)
    mark()
    state.estimate(elapsed_ns, now_ns)
    state.refer(now_ns)
    mark()
    state.hear(inputs, now_ns)
    state.supervise(inputs, now_ns)
    mark()
    state.control(elapsed_ns, now_ns)
    mark()
    state.say(inputs, now_ns)
    mark()
    return state.outputs
