"""Modes, events and reactions: what the machine may do now, and why not.

The transitions are data (`TRANSITIONS`); everything else only decides which event there is.  Inputs of a
tick: the received values, what the tick measured of itself, accepted setpoints and operator
actions.  Outputs: ``mode``, ``reason`` with ``detail``, and ``half_speed``.  Nothing starts by itself: ARMED
is entered by the operator's ARM alone, a latched FAULT needs RESET and then ARM.  STOP begins with a ramp
(``ramp_ns`` long) while the machine moves; in every other mode but ACTIVE the valves are neutral.  The
supervisor never clips: it refuses, slows or stops.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final

from can_dbc.canopen import NodeState, Presence
from controller.estimator import JointEstimator
from controller.inputs import PRESSURE_NODES, SAFETY_NODES, Received
from controller.startup import Startup
from machine.faults import FAULTS, Reaction, Reason
from machine.joints import JOINTS
from machine.modes import Mode
from machine.profile import Profile, joint


class Event(IntEnum):
    """What can happen to a mode."""

    BOOTED = 0
    """All encoders are set up."""
    ARM = 1
    """The operator armed and nothing speaks against it."""
    DISARM = 2
    RESET = 3
    SETPOINT = 4
    """A setpoint was accepted."""
    DONE = 5
    """A final setpoint was reached and its lease is over."""
    HOLD = 6
    """Reaction H, and the operator's stop."""
    RAMP = 7
    """Reaction R1."""
    CUT = 8
    """Reaction R0."""
    LATCHED = 9
    """The ramp of an R1 is over."""


TRANSITIONS: Final[dict[tuple[Mode, Event], Mode]] = {
    (Mode.BOOT, Event.BOOTED): Mode.STANDBY,
    (Mode.BOOT, Event.CUT): Mode.FAULT,
    (Mode.STANDBY, Event.ARM): Mode.ARMED,
    (Mode.STANDBY, Event.HOLD): Mode.STOP,
    (Mode.STANDBY, Event.CUT): Mode.FAULT,
    (Mode.ARMED, Event.DISARM): Mode.STANDBY,
    (Mode.ARMED, Event.SETPOINT): Mode.ACTIVE,
    (Mode.ARMED, Event.HOLD): Mode.STOP,
    (Mode.ARMED, Event.RAMP): Mode.FAULT,
    (Mode.ARMED, Event.CUT): Mode.FAULT,
    (Mode.ACTIVE, Event.DISARM): Mode.STOP,
    (Mode.ACTIVE, Event.DONE): Mode.ARMED,
    (Mode.ACTIVE, Event.HOLD): Mode.STOP,
    (Mode.ACTIVE, Event.RAMP): Mode.STOP,
    (Mode.ACTIVE, Event.CUT): Mode.FAULT,
    (Mode.STOP, Event.ARM): Mode.ARMED,
    (Mode.STOP, Event.DISARM): Mode.STANDBY,
    (Mode.STOP, Event.RESET): Mode.STANDBY,
    (Mode.STOP, Event.RAMP): Mode.FAULT,  # a second fault while stopping: neutral at once
    (Mode.STOP, Event.CUT): Mode.FAULT,
    (Mode.STOP, Event.LATCHED): Mode.FAULT,
    (Mode.FAULT, Event.RESET): Mode.BOOT,
}
"""Mode after an event; a pair that is not here changes nothing."""

RAMP_NS: Final = 60_000_000
"""Ramp of an R1: with the slowest detection before it (20 ms) neutral well within 100 ms of the loss."""
RANGE_MARGIN: Final = 0.05
"""How far past the profile's range [rad, m] a joint may be found before it counts as outside."""
ECHO_TICKS: Final = 4
SEND_REFUSALS: Final = 3
DEGRADE_NS: Final = 1_000_000_000
_RELEASED, _PRESSED = 1, 0
_YES: Final = 1
_ENABLED: Final = 0xA
_VALVE_PILOT_OFF, _VALVE_FAULT = 3, 4
_BUS_PASSIVE, _BUS_OFF, _BUS_DOWN = 2, 3, 4


class Supervisor:
    """The mode and its reason; `judge` once per tick, the events as they come."""

    __slots__ = (
        "_degraded_until_ns", "_echo", "_echo_ticks", "_encoders", "_estimators", "_limits", "_refused",
        "_refusing_ticks", "_reset_pressed", "_startup", "_stop_ramp_ns", "detail", "half_speed", "latching",
        "mode", "ramp_end_ns", "ramp_ns", "reason", "received", "worst", "worst_detail",
    )  # fmt: skip

    def __init__(
        self, profile: Profile, received: Received, estimators: list[JointEstimator], startup: Startup
    ) -> None:
        self.received = received
        self._estimators = estimators
        self._startup = startup
        specs = [joint(profile, j) for j in JOINTS]
        self._limits = tuple((s.lower - RANGE_MARGIN, s.upper + RANGE_MARGIN) for s in specs)
        self._encoders = tuple(s.encoder for s in specs)
        self._stop_ramp_ns = profile.timeouts.stop_ramp_ms * 1_000_000
        self.mode = Mode.BOOT
        self.reason = Reason.NONE
        self.detail = 0
        self.half_speed = False
        self.ramp_ns = self.ramp_end_ns = 0
        self.latching = False
        """The STOP that runs is an R1: FAULT follows its ramp."""
        self.worst = Reason.NONE
        self.worst_detail = 0
        self._degraded_until_ns = 0
        self._echo: Any = None
        self._echo_ticks = self._refusing_ticks = self._refused = 0
        self._reset_pressed = True

    @property
    def armed(self) -> bool:
        """Whether needed inputs are watched: ARMED, ACTIVE and while a stop's ramp runs."""
        return self.mode in (Mode.ARMED, Mode.ACTIVE) or self.ramping

    @property
    def ramping(self) -> bool:
        """Whether the machine is still slowing down."""
        return self.mode is Mode.STOP and self.ramp_ns > 0

    def apply(self, event: Event, reason: Reason, detail: int, now_ns: int) -> bool:
        """Moves by the table; True when the mode changed.  ``reason`` is kept as the cause."""
        before = self.mode
        after = TRANSITIONS.get((before, event), before)
        if after is before or (self.latching and event is Event.RAMP):
            return False
        self.mode, self.reason, self.detail = after, reason, detail
        self.ramp_ns, self.latching = 0, False
        if before is Mode.ACTIVE and after is Mode.STOP:
            self.latching = event is Event.RAMP
            self.ramp_ns = RAMP_NS if self.latching else self._stop_ramp_ns
            self.ramp_end_ns = now_ns + self.ramp_ns
        return True

    def ask_arm(self, now_ns: int) -> tuple[Reason, int]:
        """The operator's ARM: NONE when the machine is armed now (or was), else why not."""
        if self.mode in (Mode.ARMED, Mode.ACTIVE):
            return Reason.NONE, 0
        if self.mode is Mode.FAULT:
            return Reason.FAULT_LATCHED, 0
        if self.ramping:
            return Reason.STILL_STOPPING, 0
        blocker = self.blocker(now_ns)
        if blocker[0] is Reason.NONE:
            self._echo_ticks = 0
            self.apply(Event.ARM, Reason.NONE, 0, now_ns)
        return blocker

    def ask_reset(self, now_ns: int) -> None:
        """The operator's RESET, by datagram or by the button on the safety module."""
        if not self.ramping:
            self.apply(Event.RESET, Reason.NONE, 0, now_ns)
            self._startup.reset(lambda node: self.received.heartbeats.operational(node, now_ns))

    def ask_disarm(self, now_ns: int) -> None:
        """The operator's DISARM."""
        if not self.ramping:
            self.apply(Event.DISARM, Reason.OPERATOR_DISARM, 0, now_ns)

    def blocker(self, now_ns: int) -> tuple[Reason, int]:
        """What speaks against arming now."""
        received = self.received
        if not self._startup.complete:
            return self._startup.problem()
        estop = received.estop
        if estop.values is not None and not self._estop_released():
            return Reason.ESTOP_NOT_RELEASED, 0
        if any(slot.values is None for slot in received.needed):
            return Reason.INPUT_MISSING, 0
        if received.guard.get("Enable") != _ENABLED:
            return Reason.GUARD_NOT_READY, 0
        if received.valve_a.get("State") == _VALVE_FAULT:
            return Reason.VALVE_NODE_NOT_READY, 0
        for number in received.nodes:
            if number not in PRESSURE_NODES and not received.heartbeats.operational(number, now_ns):
                return Reason.NODE_NOT_OPERATIONAL, number
        self.worst, self.worst_detail = Reason.NONE, 0
        self._judge_inputs()
        self._judge_nodes(now_ns)
        reacts = FAULTS[self.worst].reaction >= Reaction.HOLD
        return (self.worst, self.worst_detail) if reacts else (Reason.NONE, 0)

    def judge(self, bus_state: int, refused: int, late_ns: int, period_ns: int, now_ns: int) -> None:
        """Looks at everything once, then applies the worst finding.  ``refused``: frames the bus did not
        take.
        """
        self.worst, self.worst_detail = Reason.NONE, 0
        self._judge_bus(bus_state, refused)
        if self.received.foreign:
            self._find(Reason.FOREIGN_CONTROLLER)
        self._judge_estop()
        if self.armed:
            self._judge_stale()
            self._judge_inputs()
            self._judge_nodes(now_ns)
            self._judge_echo()
        if late_ns > 3 * period_ns:
            self._find(Reason.LOOP_STALLED)
        elif late_ns > period_ns:
            self._find(Reason.LOOP_LATE)
        self.react(now_ns)
        if self.mode is Mode.BOOT and self._startup.complete:
            self.apply(Event.BOOTED, Reason.NONE, 0, now_ns)
        if self.ramping and now_ns >= self.ramp_end_ns:
            self.ramp_ns = 0
            if self.latching:
                self.apply(Event.LATCHED, self.reason, self.detail, now_ns)
        if self.mode in (Mode.BOOT, Mode.STANDBY):
            self.reason, self.detail = self.blocker(now_ns)
        elif self.mode in (Mode.ARMED, Mode.ACTIVE) and not self.half_speed:
            self.reason, self.detail = Reason.NONE, 0

    def react(self, now_ns: int) -> None:
        """Applies ``worst``: an event, or half speed for a while."""
        fault = FAULTS[self.worst]
        if fault.reaction >= Reaction.HOLD and (self.armed or fault.always):
            event = Event(Event.HOLD + (fault.reaction - Reaction.HOLD))
            self.apply(event, self.worst, self.worst_detail, now_ns)
        elif fault.reaction is Reaction.DEGRADE:
            self._degraded_until_ns = now_ns + DEGRADE_NS
            if self.mode in (Mode.ARMED, Mode.ACTIVE):
                self.reason, self.detail = self.worst, self.worst_detail
        self.half_speed = now_ns < self._degraded_until_ns

    def find(self, reason: Reason, detail: int, now_ns: int) -> None:
        """Reports a finding of the tick's later rooms (lease, refusals, motion) and reacts to it."""
        self.worst, self.worst_detail = reason, detail
        self.react(now_ns)

    def reset_edge(self) -> bool:
        """Whether the reset button of the safety module went down in this tick."""
        pressed = self.received.estop.get("ResetReq")
        if pressed is None:
            return False
        before, self._reset_pressed = self._reset_pressed, pressed == _YES
        return self._reset_pressed and not before

    def _find(self, reason: Reason, detail: int = 0) -> None:
        if FAULTS[reason].reaction > FAULTS[self.worst].reaction:
            self.worst, self.worst_detail = reason, detail

    def _judge_bus(self, bus_state: int, refused: int) -> None:
        if bus_state >= _BUS_DOWN:
            self._find(Reason.BUS_DOWN)
        elif bus_state == _BUS_OFF:
            self._find(Reason.BUS_OFF)
        elif bus_state == _BUS_PASSIVE:
            self._find(Reason.BUS_PASSIVE)
        self._refusing_ticks = self._refusing_ticks + 1 if refused > self._refused else 0
        self._refused = refused
        if self._refusing_ticks >= SEND_REFUSALS:
            self._find(Reason.SEND_REFUSED)

    def _estop_released(self) -> bool:
        estop = self.received.estop
        return bool(estop.get("ChannelA") == _RELEASED and estop.get("ChannelB") == _RELEASED)

    def _judge_estop(self) -> None:
        estop = self.received.estop
        if estop.values is None or self._estop_released():
            return
        channels = (estop.get("ChannelA"), estop.get("ChannelB"))
        known = all(channel in (_RELEASED, _PRESSED) for channel in channels)
        self._find(Reason.ESTOP_PRESSED if known else Reason.ESTOP_CHANNELS)

    def _judge_stale(self) -> None:
        received = self.received
        if received.estop.values is None:
            self._find(Reason.ESTOP_LOST)
        if received.guard.values is None:
            self._find(Reason.GUARD_LOST)
        if received.plc.values is None:
            self._find(Reason.PLC_LOST)
        if received.valve_a.values is None or received.valve_b.values is None:
            self._find(Reason.VALVE_FEEDBACK_LOST)
        for j, encoder in enumerate(received.encoders):
            if encoder is not None and encoder.values is None:
                self._find(Reason.ENCODER_LOST, j)
        if any(slot.values is None for slot in received.pressures):
            self._find(Reason.PRESSURE_LOST)
        if received.grapple.values is None:
            self._find(Reason.GRAPPLE_STATUS_LOST)

    def _judge_inputs(self) -> None:
        """Values that are known and bad; a stale one is not judged here."""
        received = self.received
        if received.guard.values is not None and received.guard.get("Enable") != _ENABLED:
            self._find(Reason.GUARD_REFUSES)
        if received.estop.get("Person") == _YES:
            self._find(Reason.PERSON_IN_ZONE)
        state = received.valve_a.get("State")
        if state == _VALVE_FAULT or (state == _VALVE_PILOT_OFF and self.mode is Mode.ACTIVE):
            self._find(Reason.VALVE_NODE_FAULT)
        if received.plc.get("FaultBits"):
            self._find(Reason.PLC_FAULT)
        for j, encoder in enumerate(received.encoders):
            if encoder is None or encoder.values is None:
                continue
            estimator = self._estimators[j]
            if estimator.jumped:
                self._find(Reason.ENCODER_JUMP, j)
            spec = self._encoders[j]
            if spec is not None and encoder.get("Alarms" if spec.kind == "rotary" else "SystemReg"):
                self._find(Reason.ENCODER_ALARM, j)
            lower, upper = self._limits[j]
            if estimator.known and not lower <= estimator.position <= upper:
                self._find(Reason.POSITION_OUTSIDE, j)

    def _judge_nodes(self, now_ns: int) -> None:
        received = self.received
        heartbeats = received.heartbeats
        for number, node in received.nodes.items():
            presence = heartbeats.presence(number, now_ns)
            helper = number in PRESSURE_NODES
            if presence is Presence.LOST:
                if helper:
                    self._find(Reason.PRESSURE_NODE_LOST, number)
                elif number in SAFETY_NODES:
                    self._find(Reason.SAFETY_NODE_LOST, number)
                else:
                    self._find(Reason.ENCODER_NODE_LOST, number)
            elif not helper and (node.booted or self._not_operational(number)):
                self._find(Reason.NODE_RESTARTED, number)
            if node.emergency:
                self._find(Reason.EMERGENCY_MESSAGE, number)
            elif node.warning:
                self._find(Reason.EMERGENCY_WARNING, number)

    def _not_operational(self, number: int) -> bool:
        return self.received.heartbeats.states.get(number, NodeState.OPERATIONAL) != NodeState.OPERATIONAL

    def _judge_echo(self) -> None:
        """The valve node repeats the counter of the last command it took; it must move."""
        echo = self.received.valve_b.get("EchoCounter")
        self._echo_ticks = 0 if echo != self._echo else self._echo_ticks + 1
        self._echo = echo
        if self._echo_ticks > ECHO_TICKS:
            self._find(Reason.VALVE_ECHO_STUCK)
