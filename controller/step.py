"""The whole controller as one pure function: ``step(state, inputs, now_ns) -> outputs``.

Inputs: the frames and datagrams of one tick, and the loop's own lateness and duration.  Outputs: frames to send in
order, a state report 50 times a second and, on a machine with a carrier, a vehicle report 20 times a second.  `step`
has no clock, no socket, no randomness and no growing memory: the same inputs in the same order give the same bytes, so
a recorded tick can be replayed.  No input makes it raise; what cannot be used is refused and counted.

The stages of a tick, in order (the loop does the first and the last two)::

    receive -> decode -> estimate -> reference -> accept -> supervise -> control -> encode -> send -> record
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.dbc.codec import Database, load
from can_dbc.frame import RawFrame
from can_dbc.messages.crane import CraneSetpoint, OperatorAction, SpoolTest
from can_dbc.messages.vehicle import DriveSetpoint
from controller.bus_io import BusMonitor
from controller.carrier.vehicle import Vehicle
from controller.config import Settings
from controller.crane.inputs import CraneInputs, spool_signals
from controller.crane.motion import Crane
from controller.crane.outputs import CraneWriter
from controller.crane.startup import Startup, check_nodes
from controller.estimation.joint_estimator import JointEstimator, SensedJoint
from controller.estimation.pressure_monitor import NO_FUNCTION
from controller.joint_watch import JointWatch
from controller.requests import RequestGate, RequestRefused
from controller.state_report import Evidence, StateReporter
from controller.supervisor import Supervisor
from controller.tick import Inputs, Outputs
from controller.transitions import OPERATING, Event
from controller.valve_watch import ValveWatch
from machine.joints import JOINTS
from machine.profile import joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import ConfigError

# A constant of the module is found faster than a member of an enumeration, in every tick.
_NONE: Final = Reason.NONE
_UNREADABLE: Final = (Reason.DATAGRAM_LENGTH, Reason.DATAGRAM_VALUE)
"""First and last reason of a datagram without a readable setpoint."""
_ACTIVE: Final = Mode.ACTIVE
HALF_SPEED_SHARE: Final = 0.5
MAX_ELAPSED_PERIODS: Final = 4
"""After a pause the laws count at most this many periods."""


class Controller:
    """All state of the controller, built once.

    ``database`` (crane0) and ``machine_databases`` (machine and gnss) are loaded when they are not given.

    Raises:
        ConfigError: profile and databases do not fit together.
    """

    __slots__ = (
        "_last_ns",
        "_period_ns",
        "_receive_sdo",
        "_reporter",
        "_sensed",
        "carrier_bus",
        "crane",
        "crane_bus_monitor",
        "crane_inputs",
        "estimators",
        "evidence",
        "gate",
        "inputs_in_use",
        "joint_watch",
        "outputs",
        "startup",
        "supervisor",
        "valve_watch",
        "vehicle",
        "writer",
    )

    def __init__(
        self,
        settings: Settings,
        database: Database | None = None,
        machine_databases: tuple[Database, Database] | None = None,
    ) -> None:
        profile = settings.profile
        try:
            database = database or load("crane")
        except ConfigError as error:
            raise ConfigError(error.code, str(error)) from error
        specs = [joint(profile, j) for j in JOINTS]
        check_nodes(database, profile)
        period_s = settings.period_ns * 1e-9
        self._period_ns = settings.period_ns
        self.crane_inputs = CraneInputs(database, profile)
        self.crane_bus_monitor = BusMonitor(0)
        carrier, articulation = profile.carrier, self.crane_inputs.articulation
        self.vehicle = Vehicle(settings, carrier, articulation, machine_databases) if carrier and articulation else None
        """None on a fixed base, as is ``carrier_bus``."""
        self.carrier_bus = self.vehicle.bus if self.vehicle else None
        self.startup = Startup(profile)
        self._receive_sdo = self.startup.receive
        sample_s = period_s if profile.plc is None else max(period_s, profile.plc.sample_ms * 1e-3)
        self.estimators = [JointEstimator(s, sample_s, profile.plc is None) for s in specs]
        sensed = [
            SensedJoint(state, s.encoder, estimator) if state is not None and s.encoder is not None else None
            for state, s, estimator in zip(self.crane_inputs.encoders, specs, self.estimators, strict=True)
        ]
        self._sensed = [each for each in sensed if each is not None]
        self.supervisor = Supervisor(
            profile,
            self.crane_inputs,
            self.crane_bus_monitor,
            self.carrier_bus,
            self.estimators,
            self.startup,
            settings.file_check,
        )
        self.gate = RequestGate(profile, settings.profile_hash, settings.file_check)
        self.crane = Crane(settings, self.crane_inputs, self.estimators, self.gate)
        # A PLC passes on positions that its own cycle has smoothed: the same count again says nothing of the encoder.
        counted = sensed if profile.plc is None else [None] * len(sensed)
        closed_elsewhere = profile.plc is not None and profile.plc.role == "references"
        loop_outputs = spool_signals(self.crane_inputs) if closed_elsewhere else ()
        self.joint_watch = JointWatch(specs, period_s, self.crane, self.estimators, counted, loop_outputs)
        self.valve_watch = ValveWatch(specs, period_s, profile.plc, self.crane, self.crane_inputs, self.estimators)
        self.writer = CraneWriter(database, profile)
        states = self.crane_inputs.messages + (self.carrier_bus.inputs.messages if self.carrier_bus else ())
        self.inputs_in_use = tuple((state.codec.name, state) for state in states)
        """Every received message of both buses, by name."""
        self.evidence = Evidence(
            settings, self.supervisor, self.crane_inputs, self.estimators, self.crane, self.gate, self.vehicle
        )
        self._reporter = StateReporter(
            settings, self.supervisor, self.gate, self.crane_inputs, self.crane, self.estimators, self.evidence
        )
        self.outputs = Outputs()
        self._last_ns = 0

    def elapse(self, now_ns: int) -> int:
        """Return the time since the previous tick [ns], bounded after a pause."""
        elapsed_ns = min(now_ns - self._last_ns, MAX_ELAPSED_PERIODS * self._period_ns)
        self._last_ns = now_ns
        return elapsed_ns

    # -- decode

    def decode(self, inputs: Inputs, now_ns: int) -> None:
        """Decode frames into values.

        After an overflow of the receive queue the frames of this tick are not used; after a recovery of the bus all
        values are unknown and the encoders are set up again.
        """
        received, monitor, bus = self.crane_inputs, self.crane_bus_monitor, self.carrier_bus
        monitor.update(inputs.bus, True, now_ns)
        if monitor.recovered:
            received.forget()
            self.startup.restart()
        received.decode([] if monitor.frames_lost else inputs.frames, now_ns, self._receive_sdo)
        for number in received.nodes.booted:
            self.startup.node_booted(number)
        if bus is not None:
            bus.decode(inputs.machine_frames, inputs.machine_bus, bool(self.outputs.machine_frames), now_ns)

    # -- estimate

    def estimate(self, elapsed_ns: int, now_ns: int) -> None:
        """Estimate joint positions and velocities, the load, and the carrier's pose."""
        for estimator in self.estimators:
            estimator.predict(now_ns)
        for sensed in self._sensed:
            sensed.update()
        roll_rad, pitch_rad = (0.0, 0.0) if self.vehicle is None else self.vehicle.reckoning.tilt_rad
        self.crane.estimate_load(roll_rad, pitch_rad, now_ns)
        if self.vehicle is not None:
            self.vehicle.estimate(elapsed_ns, now_ns)

    # -- reference

    def reference(self, now_ns: int) -> None:
        """Compute the crane's reference of this tick."""
        supervisor, vehicle = self.supervisor, self.vehicle
        self.crane.update_reference(supervisor.mode is _ACTIVE, self._speed_cap, now_ns)
        self.crane.note_places(vehicle is not None and vehicle.is_moving, supervisor.armed, now_ns)

    @property
    def _speed_cap(self) -> float:
        """Allowed share of the speed limits."""
        return HALF_SPEED_SHARE if self.supervisor.half_speed else 1.0

    # -- accept

    def accept(self, inputs: Inputs, now_ns: int) -> None:
        """Accept or refuse every datagram, the operator's first, and handle the reset button."""
        # After a skip the nominal time is less than one period behind the clock, however long the stall was.
        late_ns = min(max(inputs.late_ns, 0), self._period_ns)
        for data in inputs.operator:
            self._accept(data, True, now_ns, late_ns)
        for data in inputs.datagrams:
            self._accept(data, False, now_ns, late_ns)
        if self.supervisor.mode is _ACTIVE and self._refused_too_often(now_ns):
            self.supervisor.react_to(Reason.SETPOINTS_REFUSED, 0, now_ns)
        if self.supervisor.reset_button_pressed():
            self.supervisor.request_reset(now_ns)

    def _accept(self, data: bytes, operator: bool, now_ns: int, late_ns: int) -> None:
        try:
            message = self.gate.accept(data, now_ns, late_ns, operator)
            if isinstance(message, CraneSetpoint):
                self._accept_crane_setpoint(message, now_ns)
            elif isinstance(message, SpoolTest):
                self._accept_spool_test(message, now_ns)
            elif isinstance(message, DriveSetpoint):
                self._accept_drive_setpoint(message, now_ns, late_ns)
            else:
                self._apply_operator_action(message, now_ns)
        except RequestRefused as refused:
            if refused.reason is Reason.DATAGRAM_AUTHENTICATION:
                self.gate.note_stranger()
                return
            self.gate.count_refusal(refused.reason, refused.detail, now_ns)
            # Nobody can tell for whom an unreadable datagram was: it counts for a carrier that drives, too.
            if not operator and _UNREADABLE[0] <= refused.reason <= _UNREADABLE[1]:
                vehicle = self.vehicle
                if vehicle is not None and vehicle.setpoint is not None:
                    vehicle.gate.count_refusal(refused.reason, refused.detail, now_ns)

    def _apply_operator_action(self, action: OperatorAction, now_ns: int) -> None:
        supervisor = self.supervisor
        if action is OperatorAction.STOP:
            supervisor.apply(Event.HOLD, Reason.OPERATOR_STOP, 0, now_ns)
        elif action is OperatorAction.DISARM:
            supervisor.request_disarm(now_ns)
        elif action is OperatorAction.RESET:
            supervisor.request_reset(now_ns)
        elif action is OperatorAction.WATCH:
            supervisor.operator_link.beat(self.gate.watch_stamp_ns)
        elif action is OperatorAction.WATCH_END:
            supervisor.operator_link.end(self.gate.watch_stamp_ns)
        else:
            reason, detail = supervisor.request_arm(now_ns)
            if reason is not _NONE:
                raise RequestRefused(reason, detail)
            self.gate.start_session()
            self.joint_watch.begin_session()
            self.crane.pressure_monitor.reset()
            if self.vehicle is not None:
                self.vehicle.gate.start_session()

    def _refused_too_often(self, now_ns: int) -> bool:
        """Tell whether requests to whatever moves now, crane or carrier, were refused too often."""
        vehicle = self.vehicle
        drive = vehicle is not None and vehicle.setpoint is not None and vehicle.gate.refused_too_often(now_ns)
        return drive or (self.crane.leased and self.gate.refused_too_often(now_ns))

    def _accept_crane_setpoint(self, setpoint: CraneSetpoint, now_ns: int) -> None:
        if self.supervisor.mode not in OPERATING:
            raise RequestRefused(Reason.NOT_ARMED)
        if self.vehicle is not None and self.vehicle.is_moving and not self.crane.keeps_in_place(setpoint):
            raise RequestRefused(Reason.CARRIER_MOVES)
        ended_test = self.crane.accept(setpoint, now_ns)
        self._activate_crane(ended_test, now_ns)
        self.reference(now_ns)

    def _accept_spool_test(self, test: SpoolTest, now_ns: int) -> None:
        if self.supervisor.mode not in OPERATING:
            raise RequestRefused(Reason.NOT_ARMED)
        if self.vehicle is not None and self.vehicle.is_moving:
            raise RequestRefused(Reason.CARRIER_MOVES)
        self.crane.accept_spool_test(test, now_ns)
        self._activate_crane(False, now_ns)

    def _activate_crane(self, ended_test: bool, now_ns: int) -> None:
        """Enter ACTIVE; the laws begin at neutral when they did not drive the crane before."""
        self.supervisor.apply(Event.SETPOINT, Reason.NONE, 0, now_ns)
        began = not self.crane.leased
        self.crane.leased = True
        if began:
            self.gate.clear_refusals()
        if began or ended_test:
            self.crane.reset_laws()

    def _accept_drive_setpoint(self, setpoint: DriveSetpoint, now_ns: int, late_ns: int) -> None:
        """Accept a drive setpoint; the vehicle counts refusals, which appear in its own report."""
        vehicle = self.vehicle
        if vehicle is None:
            raise RequestRefused(Reason.CANNOT_DRIVE)
        try:
            if self.supervisor.mode not in OPERATING:
                raise RequestRefused(Reason.NOT_ARMED)
            began = vehicle.accept(setpoint, self.crane.is_moving(now_ns), now_ns, late_ns)
        except RequestRefused as refused:
            vehicle.gate.count_refusal(refused.reason, refused.detail, now_ns)
            return
        self.supervisor.apply(Event.SETPOINT, Reason.NONE, 0, now_ns)
        if began:
            vehicle.gate.clear_refusals()

    # -- supervise

    def supervise(self, inputs: Inputs, now_ns: int) -> None:
        """Check inputs, leases, a running spool test, the carrier and the joints; update the mode and its evidence."""
        supervisor, period_ns = self.supervisor, self._period_ns
        supervisor.supervise(inputs.late_ns, period_ns, now_ns)
        if supervisor.mode is _ACTIVE:
            self._check_leases(now_ns)
        moment = self.crane.load_moment
        if moment is not None and moment.overloaded and supervisor.mode in OPERATING:
            raises = supervisor.mode is _ACTIVE and self.crane.overloads()
            supervisor.react_to(Reason.OVERLOAD if raises else Reason.OVERLOADED, 0, now_ns)
        burst = self.crane.pressure_monitor.step()
        if burst != NO_FUNCTION:
            supervisor.react_to(Reason.HOSE_BURST, burst, now_ns)
        run = self.crane.spool_run
        if supervisor.mode is _ACTIVE and run.running:
            tested = self.estimators[run.function]
            reason = run.check(tested.position, tested.velocity, self._speed_cap, now_ns)
            if reason is _NONE and self.crane.test_leads_out():
                reason = Reason.TEST_RANGE
            if reason is not _NONE:
                supervisor.react_to(reason, run.function, now_ns)
        if self.vehicle is not None:
            reason, detail = self.vehicle.check(supervisor.armed, now_ns)
            if reason is not _NONE:
                supervisor.react_to(reason, detail, now_ns)
        self.valve_watch.step(supervisor, now_ns)
        self.joint_watch.step(supervisor, self.vehicle is not None and self.vehicle.is_moving, now_ns)
        self.evidence.update(inputs, now_ns)

    def _check_leases(self, now_ns: int) -> None:
        """End a lease ACTIVE that ends after its motion is done; stop the machine for one that ends before."""
        supervisor, crane, vehicle = self.supervisor, self.crane, self.vehicle
        if crane.leased and crane.lease_over(now_ns):
            if not crane.finished(now_ns):
                supervisor.react_to(Reason.LEASE_LOST, 0, now_ns)
                return
            crane.leased = False
        if vehicle is not None and vehicle.setpoint is not None and vehicle.lease_over(now_ns):
            if not vehicle.stands:
                supervisor.react_to(Reason.LEASE_LOST, 0, now_ns)
                return
            vehicle.drop_setpoint()
        if not crane.leased and (vehicle is None or vehicle.setpoint is None):
            supervisor.apply(Event.DONE, Reason.NONE, 0, now_ns)

    # -- control

    def control(self, elapsed_ns: int, now_ns: int) -> None:
        """Run the laws while ACTIVE; fade the last command during a stop's ramp; otherwise command neutral."""
        supervisor = self.supervisor
        active, ramping = supervisor.mode is _ACTIVE, supervisor.ramping
        self.crane.control(active, self._ramp_share(now_ns), ramping, self._speed_cap, now_ns, elapsed_ns)
        vehicle = self.vehicle
        if vehicle is not None:
            vehicle.control(active, ramping and not supervisor.latching, self._speed_cap, now_ns)
            supervisor.coast_ns = int(vehicle.drive.stop_s * 1e9)

    def _ramp_share(self, now_ns: int) -> float:
        """Compute the share of the last command that is left during a stop's ramp."""
        supervisor = self.supervisor
        if not supervisor.ramping or now_ns >= supervisor.ramp_end_ns:
            return 0.0
        left = (supervisor.ramp_end_ns - now_ns) / supervisor.ramp_ns
        return left * left * (3.0 - 2.0 * left)  # smooth at both ends

    # -- encode

    def encode(self, inputs: Inputs, now_ns: int) -> None:
        """Fill the outputs: frames in send order, and the reports that are due."""
        supervisor, outputs, writer, crane = self.supervisor, self.outputs, self.writer, self.crane
        frames = outputs.frames
        frames.clear()
        moving = crane.leased or supervisor.ramping
        writer.commands(crane.spools_pct, crane.grapple.spool_pct, crane.grapple.mode, moving, supervisor.armed, frames)
        rates = crane.governor.lead_velocity if supervisor.mode is _ACTIVE else crane.commands
        writer.references(self.reference_position, rates, moving, frames)
        self._reporter.note_timing(inputs.late_ns, inputs.tick_ns)
        if writer.status_due(now_ns):
            frames.append(
                writer.status(
                    supervisor.mode,
                    supervisor.reason,
                    supervisor.half_speed,
                    self.stale_mask,
                    self._reporter.late_ns,
                    inputs.bus.errors,
                )
            )
        self.startup.step(now_ns, frames)
        outputs.sync = writer.heartbeat_and_sync(now_ns, frames)
        bus = self.carrier_bus
        if bus is not None:
            bus.encode(supervisor.mode, supervisor.reason, supervisor.half_speed, now_ns, outputs.machine_frames)
        outputs.mode, outputs.reason, outputs.detail = supervisor.mode, supervisor.reason, supervisor.detail
        received = self.crane_inputs.count + (bus.inputs.count if bus is not None else 0)
        outputs.report = self._reporter.report(self.stale_mask, inputs.missed_ticks, received, now_ns)
        outputs.vehicle_report = self.vehicle.report(now_ns) if self.vehicle is not None else None

    @property
    def reference_position(self) -> list[float]:
        """Reference position of every joint now [rad, m]."""
        return self.crane.governor.position

    @property
    def stale_mask(self) -> int:
        """Stale inputs of both buses, one bit each."""
        bus = self.carrier_bus
        return self.crane_inputs.stale_mask | (bus.inputs.stale_mask if bus is not None else 0)

    def shutdown_frames(self) -> list[RawFrame]:
        """Build the last frames on crane0 before the process ends: neutral commands without arm key, and a status."""
        frames: list[RawFrame] = []
        grapple = self.crane.grapple
        grapple.release()
        self.writer.commands(self.crane.spools_pct, 0.0, grapple.mode, False, False, frames)
        frames.append(self.writer.status(Mode.BOOT, Reason.CONTROLLER_ENDED, False, self.stale_mask, 0, 0))
        return frames

    def carrier_shutdown_frames(self) -> list[RawFrame]:
        """Build the last frames on mach0."""
        return self.carrier_bus.shutdown_frames() if self.carrier_bus is not None else []


def _unmarked() -> None:
    """Do nothing: nothing measures the stages."""


def step(state: Controller, inputs: Inputs, now_ns: int, mark: Callable[[], None] = _unmarked) -> Outputs:
    """Run one tick at the nominal time ``now_ns``; the outputs are valid until the next call.

    ``mark`` is called after decode, estimate with reference, accept with supervise, control, and encode; the loop
    measures the stages there (`can_dbc.timing.page.STAGES`).
    """
    elapsed_ns = state.elapse(now_ns)
    state.decode(inputs, now_ns)
    mark()
    state.estimate(elapsed_ns, now_ns)
    state.reference(now_ns)
    mark()
    state.accept(inputs, now_ns)
    state.supervise(inputs, now_ns)
    mark()
    state.control(elapsed_ns, now_ns)
    mark()
    state.encode(inputs, now_ns)
    mark()
    return state.outputs
