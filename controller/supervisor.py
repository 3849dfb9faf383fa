"""The supervisor: modes, events and reactions.

Inputs of a tick: received values, the loop's own lateness, accepted setpoints and operator actions.  Outputs:
``mode``, ``reason`` with ``detail``, and ``half_speed``.  The transitions are data (`controller.transitions`); the
supervisor only decides which event occurs.  Nothing starts by itself: only the operator's ARM enters ARMED, and a
latched FAULT needs RESET and then ARM.  STOP begins with a ramp while the machine moves (``ramp_ns``, and as long as a
carrier needs to stand), without one after a hand lever was moved; the valves are neutral in every other mode but
ACTIVE.  The supervisor never clips: it refuses, slows or stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from controller.bus_io import BusMonitor, MessageState, Signal
from controller.carrier.bus import CarrierBus, CarrierInputs
from controller.carrier.dead_reckoning import TRUE_REFERENCE
from controller.crane.inputs import CraneInputs
from controller.crane.startup import Startup
from controller.estimation.joint_estimator import JointEstimator
from controller.operator_link import OperatorLink
from controller.transitions import OPERATING, TRANSITIONS, Event
from machine.joints import JOINTS
from machine.profile import Profile, encoders, joint
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason

# A constant of the module is found faster than a member of an enumeration, in every tick.
_NONE: Final = Reason.NONE
_BOOT: Final = Mode.BOOT
_ACTIVE: Final = Mode.ACTIVE
_STOP: Final = Mode.STOP
_WAITING: Final = (Mode.BOOT, Mode.STANDBY)
_FAULT: Final = Mode.FAULT
_MOVES: Final = Reason.MOVES_WHILE_STOPPED
_LEVER: Final = Reason.LEVER_MOVED
NO_JOINT: Final = -1
RAMP_NS: Final = 50_000_000
"""Ramp of an R1: with the slowest detection before it (20 ms, 43 ms for a bus-off on mach0), neutral within 100 ms of
the loss."""
PLC_RAMP_NS: Final = 10_000_000
"""The same before a PLC, which adds its own ramp (40 ms) and its cycle (10 ms)."""
RANGE_MARGIN_UNITS: Final = 0.05
"""How far beyond the profile's range [rad, m] a joint may be before it counts as outside."""
MAX_ECHO_TICKS: Final = 4
MAX_ECHO_NS: Final = 20_000_000
"""The valve node's echo may stay the same for this many ticks and for this long, whatever the rate."""
DEGRADE_NS: Final = 1_000_000_000
LATE_PERIODS: Final = 2
LATE_NS: Final = 10_000_000
"""A tick is late when it is later than both; what a machine can bear does not depend on the rate of its loop."""
LATE_LIMIT_COUNT: Final = 3
LATE_WINDOW_NS: Final = 1_000_000_000
STALLED_NS: Final = 50_000_000
STALL_NS: Final = 5_000_000
"""A tick that begins later than this may itself be why inputs are missing: without its SYNC no encoder samples."""
STALL_MEMORY_NS: Final = 30_000_000
"""For so long after such a tick a loss of several inputs is its work: the time-out of an encoder, and three ticks."""
_RELEASED: Final = 1
_PRESSED: Final = 0
_YES: Final = 1
_ENABLED: Final = 0xA
_VALVE_PILOT_OFF: Final = 3
_VALVE_NOT_GOOD: Final = (4, None)
"""ValveFbA.State: a fault, or the node does not say whether there is one."""
_ALARM_SIGNALS: Final = {"rotary": "Alarms", "linear": "SystemReg"}


class Supervisor:
    """The mode and its reason; `supervise` once per tick, events as they occur."""

    __slots__ = (
        "_alarms",
        "_axes",
        "_bus_monitors",
        "_carrier_nodes",
        "_channel_a",
        "_channel_b",
        "_crane_nodes",
        "_degraded_until_ns",
        "_echo",
        "_echo_counter",
        "_echo_ticks",
        "_enable",
        "_heading",
        "_latch_ramp_ns",
        "_late_stamps",
        "_latitude",
        "_lever",
        "_person",
        "_plc_faults",
        "_reference",
        "_reset_button",
        "_reset_pressed",
        "_slow_end_ns",
        "_stall_end_ns",
        "_startup",
        "_stop_ramp_ns",
        "_valve_state",
        "carrier_inputs",
        "coast_ns",
        "crane_inputs",
        "detail",
        "guard_check",
        "half_speed",
        "latching",
        "late",
        "mode",
        "moving_joint",
        "operator_link",
        "profile_check",
        "ramp_end_ns",
        "ramp_ns",
        "reason",
        "stall_ns",
        "worst",
        "worst_detail",
    )

    def __init__(
        self,
        profile: Profile,
        inputs: CraneInputs,
        crane_monitor: BusMonitor,
        carrier_bus: CarrierBus | None,
        estimators: list[JointEstimator],
        startup: Startup,
        profile_check: int = 0,
    ) -> None:
        """``profile_check``: CRC of the profile's file, which the guard must have too; 0: not compared."""
        self.crane_inputs = inputs
        self.carrier_inputs = carrier_bus.inputs if carrier_bus is not None else None
        self._enable, self._person, self._reset_button, self._channel_a, self._channel_b = (
            Signal(inputs.guard, "Enable"),
            Signal(inputs.estop, "Person"),
            Signal(inputs.estop, "ResetReq"),
            Signal(inputs.estop, "ChannelA"),
            Signal(inputs.estop, "ChannelB"),
        )
        self._lever = Signal(inputs.estop, "Lever")
        self.guard_check, self.profile_check = Signal(inputs.guard, "ProfileCheck"), profile_check
        self._valve_state, self._echo_counter = Signal(inputs.valve_a, "State"), Signal(inputs.valve_b, "EchoCounter")
        self._plc_faults = Signal(inputs.plc, "FaultBits")
        carrier = self.carrier_inputs
        self._latitude = Signal(carrier.position, "Latitude") if carrier is not None else None
        self._heading = Signal(carrier.heading, "Heading") if carrier is not None else None
        self._reference = Signal(carrier.heading, "Reference") if carrier is not None else None
        self._bus_monitors = (crane_monitor,) if carrier_bus is None else (crane_monitor, carrier_bus.monitor)
        self._startup = startup
        self.operator_link = OperatorLink(profile)
        sensed = [*inputs.encoders, inputs.articulation]
        self._alarms = tuple(
            (place, state, state.codec.index[_ALARM_SIGNALS[spec.kind]])
            for place, spec in encoders(profile).items()
            if (state := sensed[place]) is not None
        )
        self._axes = tuple(
            (int(j), estimators[j], spec.lower - RANGE_MARGIN_UNITS, spec.upper + RANGE_MARGIN_UNITS)
            for j in JOINTS
            if (spec := joint(profile, j)).encoder is not None
        )
        self._crane_nodes = (
            (inputs.estop,),
            (inputs.guard,),
            (inputs.valve_a, inputs.valve_b),
            *((state,) for state in sensed if state is not None),
        )
        """The needed inputs, by the node that sends them."""
        self._carrier_nodes = () if carrier is None else ((carrier.vehicle,), (carrier.arms_a, carrier.arms_b))
        self._latch_ramp_ns = RAMP_NS if profile.plc is None else PLC_RAMP_NS
        self._stop_ramp_ns = profile.timeouts.stop_ramp_ms * 1_000_000
        self.mode = Mode.BOOT
        self.reason = Reason.NONE
        self.detail = 0
        self.half_speed = False
        self.ramp_ns = self.ramp_end_ns = self._slow_end_ns = 0
        self.coast_ns = 0
        """How long a driving carrier would take to stand if it stopped now."""
        self.latching = False
        """The present STOP is an R1: FAULT follows its ramp."""
        self.moving_joint = NO_JOINT
        """A joint that moves while nothing is armed, by hand lever it seems (`controller.joint_watch`)."""
        self.worst = Reason.NONE
        self.worst_detail = 0
        self._degraded_until_ns = 0
        self._late_stamps = [-LATE_WINDOW_NS] * LATE_LIMIT_COUNT
        self.late = 0
        """Ticks that began more than `LATE_PERIODS` and `LATE_NS` late."""
        self.stall_ns = 0
        """The lateness to which a loss of several inputs is put down."""
        self._stall_end_ns = 0
        self._echo: Any = None
        self._echo_ticks = 0
        self._reset_pressed = True

    @property
    def armed(self) -> bool:
        """Whether needed inputs are checked: in ARMED, in ACTIVE and during a stop's ramp."""
        return self.mode in OPERATING or self.ramping

    @property
    def ramping(self) -> bool:
        """Whether the machine is still slowing down."""
        return self.mode is _STOP and self.ramp_ns > 0

    @property
    def lever_moved(self) -> bool:
        """Whether a hand lever is out of neutral, or its switch faulty; False on a machine that cannot tell."""
        return bool(self._lever.value())

    @property
    def echo_ticks(self) -> int:
        """How many ticks in a row the valve node's echo has been the same."""
        return self._echo_ticks

    def apply(self, event: Event, reason: Reason, detail: int, now_ns: int) -> bool:
        """Change the mode by the table; True when it changed.  ``reason`` is kept as the cause."""
        before = self.mode
        after = TRANSITIONS.get((before, event), before)
        if after is before or (self.latching and event is Event.RAMP):
            return False
        self.mode, self.reason, self.detail = after, reason, detail
        self.ramp_ns, self.latching = 0, False
        if before is Mode.ACTIVE and after is Mode.STOP:
            self.latching = event is Event.RAMP
            self.ramp_ns = self._latch_ramp_ns if self.latching else self._stop_ramp_ns
            self.ramp_end_ns = self._slow_end_ns = now_ns + (0 if reason is _LEVER else self.ramp_ns)
            if not self.latching:
                self._slow_end_ns = max(self.ramp_end_ns, now_ns + self.coast_ns)
        return True

    def request_arm(self, now_ns: int) -> tuple[Reason, int]:
        """Handle the operator's ARM: NONE when the machine is armed now, else the reason why not."""
        if self.mode in OPERATING:
            return Reason.NONE, 0
        if self.mode is Mode.FAULT:
            return Reason.FAULT_LATCHED, 0
        if self.ramping:
            return Reason.STILL_STOPPING, 0
        blocker = self.arming_blocker(now_ns)
        if blocker[0] is Reason.NONE:
            self._echo_ticks = 0
            self.apply(Event.ARM, Reason.NONE, 0, now_ns)
        return blocker

    def request_reset(self, now_ns: int) -> None:
        """Handle the operator's RESET, by datagram or by the button on the safety module."""
        if not self.ramping:
            self.apply(Event.RESET, Reason.NONE, 0, now_ns)
            self._startup.reset(lambda node: self.crane_inputs.nodes.operational(node, now_ns))
            if self.carrier_inputs is not None and self.carrier_inputs.address.lost:
                self.carrier_inputs.address.restart()

    def request_disarm(self, now_ns: int) -> None:
        """Handle the operator's DISARM."""
        if not self.ramping:
            self.apply(Event.DISARM, Reason.OPERATOR_DISARM, 0, now_ns)

    def arming_blocker(self, now_ns: int) -> tuple[Reason, int]:
        """Find what prevents arming now."""
        received = self.crane_inputs
        if not self._startup.complete:
            return self._startup.problem()
        estop = received.estop
        if estop.values is not None and not self._estop_released():
            return Reason.ESTOP_NOT_RELEASED, 0
        carrier = self.carrier_inputs
        if any(state.values is None for state in received.needed) or (carrier is not None and carrier.stale_mask):
            return Reason.INPUT_MISSING, 0
        if self._enable.value() != _ENABLED:
            return Reason.GUARD_NOT_READY, 0
        if self._valve_state.value() in _VALVE_NOT_GOOD:
            return Reason.VALVE_NODE_NOT_READY, 0
        absent = received.nodes.not_ready(now_ns)
        if absent:
            return Reason.NODE_NOT_OPERATIONAL, absent
        for monitor in self._bus_monitors:
            if not monitor.usable(now_ns):
                return Reason.BUS_UNSTABLE, monitor.number
        if self.moving_joint != NO_JOINT:
            return Reason.JOINT_MOVES, self.moving_joint
        self.worst, self.worst_detail = _NONE, 0
        self._check_values(now_ns)
        self._collect(*received.nodes.worst_finding(now_ns))
        if carrier is not None:
            self._check_carrier(carrier, now_ns)
        reacts = FAULTS[self.worst].reaction >= Reaction.HOLD
        return (self.worst, self.worst_detail) if reacts else (Reason.NONE, 0)

    def supervise(self, late_ns: int, period_ns: int, now_ns: int) -> None:
        """Check everything once, then react to the worst finding."""
        carrier = self.carrier_inputs
        self.worst, self.worst_detail = _NONE, 0
        for monitor in self._bus_monitors:
            if monitor.reason:
                self._collect(monitor.reason, monitor.number)
        if self.crane_inputs.foreign:
            self._collect(Reason.FOREIGN_CONTROLLER, 0)
        if carrier is not None and carrier.foreign:
            self._collect(Reason.FOREIGN_CONTROLLER, 1)
        self._check_estop()
        self._note_stall(late_ns, now_ns)
        if self.armed:
            if self.crane_inputs.stale_mask:
                self._check_stale(now_ns)
            self._check_values(now_ns)
            reason, node = self.crane_inputs.nodes.worst_finding(now_ns)
            self._collect(reason, node)
            self._check_echo(period_ns)
            if carrier is not None:
                self._check_carrier(carrier, now_ns)
        self._check_lateness(late_ns, period_ns, now_ns)
        self._react(now_ns)
        if self.mode is _BOOT and self._startup.complete:
            self.apply(Event.BOOTED, Reason.NONE, 0, now_ns)
        if self.ramping and now_ns >= (self._slow_end_ns if self.coast_ns else self.ramp_end_ns):
            self.ramp_ns = 0
            if self.latching:
                self.apply(Event.LATCHED, self.reason, self.detail, now_ns)
        if self.mode in _WAITING:
            self.reason, self.detail = self.arming_blocker(now_ns)
            if self.reason is _NONE:
                self.reason = self._advisory()
        elif self.mode in OPERATING and not self.half_speed:
            self.reason, self.detail = self._advisory(), 0

    def _react(self, now_ns: int) -> None:
        """React to ``worst``: an event, or half speed for a while."""
        if self.worst:
            fault = FAULTS[self.worst]
            if fault.reaction >= Reaction.HOLD and (self.armed or fault.always):
                event = Event(Event.HOLD + (fault.reaction - Reaction.HOLD))
                self.apply(event, self.worst, self.worst_detail, now_ns)
            elif fault.reaction is Reaction.DEGRADE:
                self._degraded_until_ns = now_ns + DEGRADE_NS
                if self.mode in OPERATING:
                    self.reason, self.detail = self.worst, self.worst_detail
        self.half_speed = now_ns < self._degraded_until_ns

    def react_to(self, reason: Reason, detail: int, now_ns: int) -> None:
        """React at once to a finding from outside (lease, refusals, spool test, motion, carrier)."""
        self.worst, self.worst_detail = reason, detail
        self._react(now_ns)

    def latch_motion(self, moving_joint: int, now_ns: int) -> None:
        """Cut the supply of a machine that moves although it is stopped; in FAULT this becomes the reason unless the
        supply is cut already.
        """
        if self.mode is not _FAULT:
            self.react_to(_MOVES, moving_joint, now_ns)
        elif FAULTS[self.reason].reaction < Reaction.CUT:
            self.reason, self.detail = _MOVES, moving_joint

    def reset_button_pressed(self) -> bool:
        """Tell whether the reset button of the safety module went down in this tick."""
        pressed = self._reset_button.value()
        if pressed is None:
            return False
        before, self._reset_pressed = self._reset_pressed, pressed == _YES
        return self._reset_pressed and not before

    def _collect(self, reason: Reason, detail: int = 0) -> None:
        """Keep a finding as ``worst`` when its reaction is harder than that of the present one."""
        if reason and FAULTS[reason].reaction > FAULTS[self.worst].reaction:
            self.worst, self.worst_detail = reason, detail

    def _check_lateness(self, late_ns: int, period_ns: int, now_ns: int) -> None:
        """Slow the machine for a tick later than two periods and 10 ms; stop it for three within a second, or one
        beyond 50 ms.
        """
        if late_ns <= LATE_PERIODS * period_ns or late_ns <= LATE_NS:
            return
        stamps = self._late_stamps
        stamps[self.late % LATE_LIMIT_COUNT] = now_ns
        self.late += 1
        stalled = late_ns > STALLED_NS or now_ns - min(stamps) < LATE_WINDOW_NS
        self._collect(Reason.LOOP_STALLED if stalled else Reason.LOOP_LATE)

    def _estop_released(self) -> bool:
        return bool(self._channel_a.value() == _RELEASED and self._channel_b.value() == _RELEASED)

    def _check_estop(self) -> None:
        if self.crane_inputs.estop.values is None or self._estop_released():
            return
        channels = (self._channel_a.value(), self._channel_b.value())
        known = all(channel in (_RELEASED, _PRESSED) for channel in channels)
        self._collect(Reason.ESTOP_PRESSED if known else Reason.ESTOP_CHANNELS)

    def _note_stall(self, late_ns: int, now_ns: int) -> None:
        """Remember how late this tick is, for inputs that are lost by it."""
        if late_ns > STALL_NS:
            self.stall_ns = max(late_ns, self.stall_ns) if now_ns < self._stall_end_ns else late_ns
            self._stall_end_ns = now_ns + STALL_MEMORY_NS

    def _lost_together(self, nodes: Sequence[Sequence[MessageState]], heard_ns: int, now_ns: int) -> Reason:
        """Find the common cause of what is lost on one bus: this computer, or what several nodes share; else NONE.

        The first of them to be missed may stand alone for a moment: then nothing else is heard either.
        """
        lost = [state for node in nodes for state in node if state.values is None]
        several = sum(any(state.values is None for state in node) for node in nodes) > 1
        if several and now_ns < self._stall_end_ns:
            return Reason.COMPUTER_STALLED
        several = several or any(2 * (now_ns - heard_ns) > state.timeout_ns for state in lost)
        return Reason.INPUTS_LOST if several else _NONE

    def _check_stale(self, now_ns: int) -> None:
        received = self.crane_inputs
        if not received.plc_outputs:  # behind a PLC all inputs come through it
            common = self._lost_together(self._crane_nodes, received.heard_ns, now_ns)
            if common:
                self._collect(common, 0)
                return
        if received.estop.values is None:
            self._collect(Reason.ESTOP_LOST)
        if received.guard.values is None:
            self._collect(Reason.GUARD_LOST)
        if any(state.values is None for state in received.plc_states):
            self._collect(Reason.PLC_LOST)
        if received.valve_a.values is None or received.valve_b.values is None:
            self._collect(Reason.VALVE_FEEDBACK_LOST)
        for place, encoder, _ in self._alarms:
            if encoder.values is None:
                self._collect(Reason.ENCODER_FROZEN if encoder.repeats else Reason.ENCODER_LOST, place)
        if any(state.values is None for state in received.pressures):
            self._collect(Reason.PRESSURE_LOST)
        if received.grapple.values is None:
            self._collect(Reason.GRAPPLE_STATUS_LOST)

    def _check_values(self, now_ns: int) -> None:
        """Find values that are known and bad; a stale value is not checked here."""
        received = self.crane_inputs
        if received.guard.values is not None:
            if self._enable.value() != _ENABLED:
                self._collect(Reason.GUARD_REFUSES)
            if self.profile_check and self.guard_check.value() not in (self.profile_check, 0):
                self._collect(Reason.PROFILE_DIFFERS)
        if self.lever_moved:
            self._collect(_LEVER)
        if self._person.value():
            self._collect(Reason.PERSON_IN_ZONE)
        if now_ns >= self.operator_link.lost_from_ns:
            self._collect(Reason.OPERATOR_LINK_LOST)
        state, heard = self._valve_state.value(), self.crane_inputs.valve_a.values is not None
        if (heard and state in _VALVE_NOT_GOOD) or (state == _VALVE_PILOT_OFF and self.mode is _ACTIVE):
            self._collect(Reason.VALVE_NODE_FAULT)
        if self._plc_faults.value():
            self._collect(Reason.PLC_FAULT)
        for place, encoder, alarm in self._alarms:
            values = encoder.values
            if values is not None and values[alarm]:
                self._collect(Reason.ENCODER_ALARM, place)
        for j, estimator, lower, upper in self._axes:
            if estimator.jumped:
                self._collect(Reason.ENCODER_JUMP, j)
            if estimator.noisy:
                self._collect(Reason.ENCODER_NOISY, j)
            if estimator.known and not lower <= estimator.position <= upper:
                self._collect(Reason.POSITION_OUTSIDE, j)

    def _check_carrier(self, carrier: CarrierInputs, now_ns: int) -> None:
        """Check that the carrier's own frames arrive, and that the controller owns its address on mach0."""
        if carrier.stale_mask:
            common = self._lost_together(self._carrier_nodes, carrier.heard_ns, now_ns)
            if common:
                self._collect(common, 0 if common is Reason.COMPUTER_STALLED else 1)
            if carrier.vehicle.values is None:
                self._collect(Reason.CARRIER_LOST)
            if carrier.arms_a.values is None or carrier.arms_b.values is None:
                self._collect(Reason.SWING_ARMS_LOST)
        if carrier.address.lost:
            self._collect(Reason.ADDRESS_LOST)

    def _advisory(self) -> Reason:
        """Find a loss to report although the machine may work."""
        carrier, latitude, heading, reference = self.carrier_inputs, self._latitude, self._heading, self._reference
        if carrier is None or latitude is None or heading is None or reference is None:
            return _NONE
        if latitude.value() is None or heading.value() is None or reference.value() != TRUE_REFERENCE:
            return Reason.GNSS_LOST
        return Reason.ENGINE_LOST if carrier.engine.values is None else _NONE

    def _check_echo(self, period_ns: int) -> None:
        """Check that the counter of the last accepted command, which the valve node echoes, changes."""
        echo = self._echo_counter.value()
        self._echo_ticks = 0 if echo != self._echo else self._echo_ticks + 1
        self._echo = echo
        if self._echo_ticks > MAX_ECHO_TICKS and self._echo_ticks * period_ns > MAX_ECHO_NS:
            self._collect(Reason.VALVE_ECHO_STUCK)
