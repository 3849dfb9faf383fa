"""The state report: 50 times a second the controller's mode, refusals, estimates, timing and evidence, in one datagram.

The evidence of the present reason is what was measured, and the limit, when the machine was slowed or stopped: read
once when the reason changes, so that a good tick costs one comparison.  What its numbers mean, their units and their
text are in `machine.status.evidence`.  Everything here only reads; nothing changes the state of a law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from controller.bus_io import MessageState, PeriodicTimer, Signal, or_nan
from controller.carrier.monitors import BEND_MARGIN_RAD, DISAGREE_RAD
from controller.carrier.vehicle import Vehicle
from controller.config import Settings
from controller.crane.inputs import HEARTBEAT_TIMEOUT_NS, CraneInputs, spool_signals
from controller.crane.motion import Crane
from controller.estimation.joint_estimator import JointEstimator
from controller.requests import RequestGate, SetpointGate
from controller.supervisor import (
    LATE_NS,
    LATE_PERIODS,
    MAX_ECHO_NS,
    RANGE_MARGIN_UNITS,
    STALLED_NS,
    Supervisor,
)
from controller.tick import Inputs
from machine.joints import ARTICULATION, JOINTS
from machine.profile import joint
from machine.status.faults import FAULTS
from machine.status.reasons import Reaction, Reason, pack

REPORT_NS: Final = 20_000_000
_NAN: Final = math.nan
_MS: Final = 1e-6
Numbers = tuple[float, ...]
"""Empty, or three; never compared by identity, because the compiled tick copies tuples."""
_UNKNOWN: Final[Numbers] = (_NAN, _NAN, _NAN)
_RELEASED: Final = 1.0
_OPERATIONAL: Final = 5.0
_RTK_FIXED: Final = 4.0
_ESTOP: Final = (Reason.ESTOP_PRESSED, Reason.ESTOP_CHANNELS)
_HEARTBEATS: Final = (Reason.SAFETY_NODE_LOST, Reason.ENCODER_NODE_LOST, Reason.PRESSURE_NODE_LOST)
_EMERGENCIES: Final = (Reason.EMERGENCY_MESSAGE, Reason.EMERGENCY_WARNING)
_BUS_STATES: Final = (Reason.BUS_OFF, Reason.BUS_DOWN, Reason.BUS_PASSIVE)
_OVERLOADS: Final = (Reason.OVERLOAD, Reason.OVERLOADED)
_LATE: Final = (Reason.LOOP_LATE, Reason.LOOP_STALLED)
_MOTIONS: Final = (
    Reason.JOINT_STUCK,
    Reason.JOINT_RUNAWAY,
    Reason.JOINT_REVERSED,
    Reason.MOVES_WHILE_STOPPED,
    Reason.ENCODER_NOISY,
    Reason.ENCODER_DRIFT,
    Reason.SPEED_WRONG,
)
_SPOOLS: Final = (Reason.SPOOL_OPEN, Reason.SPOOL_SHUT, Reason.SPOOL_WRONG)
_STEERINGS: Final = (Reason.STEERING_STUCK, Reason.STEERING_RUNAWAY)
_SPEEDS: Final = (Reason.CARRIER_RUNAWAY, Reason.CARRIER_STUCK)
_ARMS: Final = (Reason.ARM_OUTSIDE, Reason.ARM_STUCK)


class Evidence:
    """``numbers`` and ``since_ns`` of a reason that slows or stops the machine; empty and 0 with any other."""

    __slots__ = (
        "_alarms",
        "_articulation",
        "_carrier_spec",
        "_channel_a",
        "_channel_b",
        "_crane",
        "_detail",
        "_estimators",
        "_exit_code",
        "_gate",
        "_guard_axis",
        "_inputs",
        "_limits",
        "_messages",
        "_period_ns",
        "_plc_faults",
        "_reason",
        "_spools",
        "_supervisor",
        "_valve_state",
        "_vehicle",
        "_vehicle_fault",
        "_verdict",
        "numbers",
        "since_ns",
    )

    def __init__(
        self,
        settings: Settings,
        supervisor: Supervisor,
        inputs: CraneInputs,
        estimators: Sequence[JointEstimator],
        crane: Crane,
        gate: RequestGate,
        vehicle: Vehicle | None,
    ) -> None:
        self._period_ns = settings.period_ns
        self._supervisor, self._inputs, self._estimators = supervisor, inputs, estimators
        self._crane, self._gate, self._vehicle = crane, gate, vehicle
        self._channel_a, self._channel_b = Signal(inputs.estop, "ChannelA"), Signal(inputs.estop, "ChannelB")
        self._verdict, self._guard_axis = Signal(inputs.guard, "Verdict"), Signal(inputs.guard, "FaultAxis")
        self._valve_state, self._exit_code = Signal(inputs.valve_a, "State"), Signal(inputs.valve_b, "ExitCode")
        self._plc_faults = Signal(inputs.plc, "FaultBits")
        self._spools = spool_signals(inputs)
        sensed = [*inputs.encoders, inputs.articulation]
        self._alarms = [
            None if state is None else Signal(state, "Alarms" if "Alarms" in state.codec.index else "SystemReg")
            for state in sensed
        ]
        specs = [joint(settings.profile, j) for j in JOINTS]
        self._limits = [(spec.lower, spec.upper, spec.speed_limit) for spec in specs]
        self._carrier_spec = settings.profile.carrier
        self._articulation = self._vehicle_fault = self._plc_faults  # unused without a carrier
        self._messages: dict[Reason, list[MessageState]] = {
            Reason.ESTOP_LOST: [inputs.estop],
            Reason.GUARD_LOST: [inputs.guard],
            Reason.PLC_LOST: inputs.plc_states,
            Reason.VALVE_FEEDBACK_LOST: [inputs.valve_a, inputs.valve_b],
            Reason.PRESSURE_LOST: [*inputs.pressures],
            Reason.GRAPPLE_STATUS_LOST: [inputs.grapple],
        }
        if vehicle is not None:
            carrier = vehicle.bus.inputs
            self._articulation = Signal(carrier.vehicle, "Articulation")
            self._vehicle_fault = Signal(carrier.vehicle, "Fault")
            self._messages[Reason.CARRIER_LOST] = [carrier.vehicle]
            self._messages[Reason.SWING_ARMS_LOST] = [carrier.arms_a, carrier.arms_b]
            self._messages[Reason.POSITION_LOST] = [carrier.position]
            self._messages[Reason.HEADING_LOST] = [carrier.heading]
        self._reason, self._detail = Reason.NONE, 0
        self.since_ns = 0
        self.numbers: Numbers = ()

    def update(self, inputs: Inputs, now_ns: int) -> None:
        """Take the evidence when the supervisor's reason changed; call it after `Supervisor.supervise`."""
        supervisor = self._supervisor
        reason, detail = supervisor.reason, supervisor.detail
        if reason is self._reason and detail == self._detail:
            return
        self._reason, self._detail = reason, detail
        if FAULTS[reason].reaction >= Reaction.DEGRADE:
            self.since_ns, self.numbers = now_ns, self._measure(reason, detail, inputs, now_ns) or _UNKNOWN
        else:
            self.since_ns, self.numbers = 0, ()

    def _measure(self, reason: Reason, detail: int, inputs: Inputs, now_ns: int) -> Numbers:
        """Return the measured value, limit, and one more; empty for a reason without numbers."""
        lost = self._lost_message(reason, detail)
        if lost is not None:
            age_ms = (now_ns - lost.stamp_ns) * _MS if lost.stamp_ns else _NAN
            return age_ms, lost.timeout_ns * _MS, float(lost.refused)
        if reason in _LATE:
            return self._lateness(reason, inputs.late_ns)
        if reason is Reason.COMPUTER_STALLED:
            return self._supervisor.stall_ns * _MS, _NAN, self._lost_count(self._inputs.needed)
        if reason is Reason.INPUTS_LOST:
            bus = self._inputs if detail == 0 or self._vehicle is None else self._vehicle.bus.inputs
            return (now_ns - bus.heard_ns) * _MS, _NAN, self._lost_count(bus.needed)
        if reason in _BUS_STATES or reason is Reason.SEND_REFUSED:
            reading = inputs.machine_bus if detail else inputs.bus
            if reason is Reason.SEND_REFUSED:
                return float(reading.refused), _NAN, _NAN
            return float(reading.errors), _NAN, float(reading.recoveries)
        if reason is Reason.LEASE_LOST:
            return self._lease(now_ns)
        if reason is Reason.OPERATOR_LINK_LOST:
            link = self._supervisor.operator_link
            return (now_ns - link.stamp_ns) * _MS, link.limit_ns * _MS, _NAN
        if reason is Reason.SETPOINTS_REFUSED:
            crane, vehicle = self._crane, self._vehicle
            gate = self._gate if crane.leased or vehicle is None else vehicle.gate
            return float(gate.refused), _NAN, float(pack(gate.refusal, gate.detail))
        moment = self._crane.load_moment
        if reason in _OVERLOADS and moment is not None:
            return moment.last_nm, moment.limit_nm, self._crane.load_kg
        if reason is Reason.ENCODER_FROZEN:
            return self._frozen(detail)
        if detail < len(self._estimators):
            numbers = self._joint(reason, detail)
            if numbers:
                return numbers
        numbers = self._node(reason, detail, now_ns)
        if numbers or self._vehicle is None:
            return numbers
        return self._carrier(reason, detail, self._vehicle)

    def _lost_message(self, reason: Reason, detail: int) -> MessageState | None:
        """Find the message without values that is silent for longest, where a reason is the loss of a message."""
        if reason is Reason.ENCODER_LOST:
            return self._inputs.articulation if detail == ARTICULATION else self._inputs.encoders[detail]
        silent: MessageState | None = None
        for state in self._messages.get(reason, ()):
            if state.values is None and (silent is None or state.stamp_ns < silent.stamp_ns):
                silent = state
        return silent

    def _lost_count(self, needed: Sequence[MessageState]) -> float:
        return float(sum(state.values is None for state in needed))

    def _lateness(self, reason: Reason, late_ns: int) -> Numbers:
        limit_ns = max(LATE_PERIODS * self._period_ns, LATE_NS)
        if reason is Reason.LOOP_STALLED and late_ns > STALLED_NS:
            limit_ns = STALLED_NS
        return late_ns * _MS, limit_ns * _MS, float(self._supervisor.late)

    def _lease(self, now_ns: int) -> Numbers:
        crane, vehicle = self._crane, self._vehicle
        if crane.leased and crane.lease_over(now_ns):
            stamp_ns = self._gate.stamp_ns
            return (now_ns - stamp_ns) * _MS, (crane.lease_end_ns - stamp_ns) * _MS, _NAN
        if vehicle is not None and vehicle.setpoint is not None:
            setpoint = vehicle.setpoint
            return (now_ns - setpoint.stamp_ns) * _MS, setpoint.lease_ns * _MS, _NAN
        return ()

    def _frozen(self, detail: int) -> Numbers:
        """Give what the joint of a frozen encoder was told to do: its last sample arrives, but is no evidence."""
        if detail == ARTICULATION:
            state = self._inputs.articulation
            commanded = _NAN if self._vehicle is None else self._vehicle.steering.rate_rad_s
            return commanded, _NAN, _NAN if state is None else float(state.refused)
        state = self._inputs.encoders[detail]
        return self._crane.commands[detail], self._limits[detail][2], _NAN if state is None else float(state.refused)

    def _joint(self, reason: Reason, detail: int) -> Numbers:
        estimator = self._estimators[detail]
        lower, upper, speed_limit = self._limits[detail]
        if reason in _MOTIONS:
            return estimator.velocity, speed_limit, self._crane.commands[detail]
        if reason in _SPOOLS:
            return or_nan(self._spools[detail].value()), _NAN, self._crane.spools_pct[detail]
        if reason is Reason.POSITION_OUTSIDE:
            low = estimator.position < lower
            return estimator.position, lower - RANGE_MARGIN_UNITS if low else upper + RANGE_MARGIN_UNITS, _NAN
        if reason is Reason.ENCODER_JUMP:
            return estimator.position, _NAN, float(estimator.refused)
        if reason is Reason.TEST_RANGE:
            near_lower = estimator.position - lower < upper - estimator.position
            return estimator.position, lower if near_lower else upper, _NAN
        if reason is Reason.TEST_SPEED:
            return estimator.velocity, speed_limit, _NAN
        if reason is Reason.HOSE_BURST:
            cylinder = self._crane.pressure_monitor.cylinders[detail]
            return cylinder.now_bar, _NAN, cylinder.before_bar
        return ()

    def _node(self, reason: Reason, detail: int, now_ns: int) -> Numbers:
        nodes = self._inputs.nodes
        if reason in _ESTOP:
            return _number(self._channel_a), _RELEASED, _number(self._channel_b)
        if reason is Reason.PROFILE_DIFFERS:
            return _number(self._supervisor.guard_check), float(self._supervisor.profile_check), _NAN
        if reason is Reason.GUARD_REFUSES:
            return _number(self._verdict), _NAN, _number(self._guard_axis)
        if reason is Reason.VALVE_ECHO_STUCK:
            unchanged_ns = self._supervisor.echo_ticks * self._period_ns
            return unchanged_ns * _MS, MAX_ECHO_NS * _MS, _number(self._exit_code)
        if reason is Reason.VALVE_NODE_FAULT:
            return _number(self._valve_state), _NAN, _number(self._exit_code)
        if reason is Reason.PLC_FAULT:
            return _number(self._plc_faults), _NAN, _NAN
        if reason in _HEARTBEATS:
            return nodes.heartbeat_age_ns(detail, now_ns) * _MS, HEARTBEAT_TIMEOUT_NS * _MS, _NAN
        if reason is Reason.NODE_RESTARTED:
            return float(nodes.nmt_state(detail)), _OPERATIONAL, float(nodes.by_number[detail].boots)
        if reason in _EMERGENCIES:
            return float(nodes.by_number[detail].code), _NAN, _NAN
        if reason is Reason.ENCODER_ALARM:
            alarm = self._alarms[detail]
            return () if alarm is None else (_number(alarm), _NAN, _NAN)
        return ()

    def _carrier(self, reason: Reason, detail: int, vehicle: Vehicle) -> Numbers:
        reckoning, steering, spec = vehicle.reckoning, vehicle.estimator, self._carrier_spec
        if spec is None:
            return ()
        if reason in _SPEEDS:
            return reckoning.speed_m_s, _NAN, vehicle.drive.speed_m_s
        if reason in _STEERINGS:
            return steering.velocity, _NAN, vehicle.steering.rate_rad_s
        if reason is Reason.TILTED:
            roll, pitch = reckoning.tilt_rad
            return max(abs(roll), abs(pitch)), spec.tilt_limit_rad, _NAN
        if reason is Reason.STEERING_DISAGREES:
            return steering.position, DISAGREE_RAD, _number(self._articulation)
        if reason in _ARMS:
            return reckoning.heights_m[detail], spec.arm_travel_m, vehicle.arms.speeds_m_s[detail]
        if reason is Reason.POSITION_OUTSIDE:  # the articulation
            limit = spec.articulation_limit_rad + BEND_MARGIN_RAD
            return steering.position, limit if steering.position > 0.0 else -limit, _NAN
        if reason is Reason.ENCODER_JUMP:
            return steering.position, _NAN, float(steering.refused)
        if reason is Reason.FIX_LOST:
            return float(reckoning.fix), _NAN, _RTK_FIXED
        if reason is Reason.CARRIER_FAULT:
            return _number(self._vehicle_fault), _NAN, _NAN
        return ()


def _number(signal: Signal) -> float:
    value = signal.value()
    return _NAN if value is None else float(value)


class StateReporter:
    """Builds the reports; ``late_ns`` and ``tick_ns`` are the worst since the last one."""

    __slots__ = (
        "_crane",
        "_due",
        "_estimators",
        "_evidence",
        "_gate",
        "_inputs",
        "_mode_switch",
        "_sequence",
        "_settings",
        "_supervisor",
        "late_ns",
        "tick_ns",
    )

    def __init__(
        self,
        settings: Settings,
        supervisor: Supervisor,
        gate: SetpointGate,
        inputs: CraneInputs,
        crane: Crane,
        estimators: Sequence[JointEstimator],
        evidence: Evidence,
    ) -> None:
        self._settings, self._supervisor, self._gate = settings, supervisor, gate
        self._inputs, self._crane, self._estimators, self._evidence = inputs, crane, estimators, evidence
        self._mode_switch = Signal(inputs.estop, "ModeSwitch")
        self._due, self._sequence = PeriodicTimer(REPORT_NS), 0
        self.late_ns = self.tick_ns = 0

    def note_timing(self, late_ns: int, tick_ns: int) -> None:
        """Remember the worst lateness and duration of a tick until the next report."""
        self.late_ns = max(self.late_ns, late_ns)
        self.tick_ns = max(self.tick_ns, tick_ns)

    def report(self, stale_mask: int, missed_ticks: int, frames: int, now_ns: int) -> bytes | None:
        """Build a state report when one is due, else None; ``frames`` counts the frames received since the start."""
        if not self._due.due(now_ns):
            return None
        supervisor, gate, crane, estimators = self._supervisor, self._gate, self._crane, self._estimators
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        # Six by place, and tuples from lists: CPython 3.11 never takes a tuple of 20 (the names of all fields) or one
        # made from a generator from its free list again, and the heap would grow for half an hour.
        report = StateReport(
            self._sequence,
            self._settings.profile_hash,
            now_ns,
            supervisor.mode,
            crane.grapple.state,
            pack(supervisor.reason, supervisor.detail),
            setpoint_sequence=gate.sequence,
            refusal=pack(gate.refusal, gate.detail),
            refused=gate.refused,
            stale_mask=stale_mask,
            position=tuple([e.position for e in estimators]),
            velocity=tuple([e.velocity for e in estimators]),
            reference=tuple(crane.governor.position),
            opening_pct=crane.opening_pct(),
            clamp_bar=or_nan(self._inputs.grapple.get("ClampPress")),
            load_kg=crane.load_kg,
            tick_ns=self.tick_ns,
            late_ns=self.late_ns,
            missed_ticks=missed_ticks,
            frames_received=frames,
            since_ns=self._evidence.since_ns,
            numbers=self._evidence.numbers,
            operator_link=supervisor.operator_link.state(now_ns),
            mode_switch=self._mode_switch.value() or 0,
        )
        self.late_ns = self.tick_ns = 0
        return encode(report)
