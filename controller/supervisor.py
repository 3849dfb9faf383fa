"""Modes, events and reactions: what the machine may do now, and why not.

The transitions are data (`TRANSITIONS`); everything else only decides which event there is.  Inputs of a
tick: the received values, what the tick measured of itself, accepted setpoints and operator
actions.  Outputs: ``mode``, ``reason`` with ``detail``, and ``half_speed``.  Nothing starts by itself: ARMED
is entered by the operator's ARM alone, a latched FAULT needs RESET and then ARM.  STOP begins with a ramp
(``ramp_ns`` long, and as long as a carrier needs to stand) while the machine moves; in every other mode but ACTIVE
the valves are neutral.  The supervisor never clips: it refuses, slows or stops.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final

from controller.bus_watch import BusWatch
from controller.carrier.bus import MachineBus
from controller.carrier.inputs import MachineReceived
from controller.estimator import JointEstimator
from controller.inputs import Received
from controller.startup import Startup
from machine.faults import FAULTS
from machine.joints import JOINTS
from machine.modes import Mode
from machine.profile import Profile, encoders, joint
from machine.reasons import Reaction, Reason


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

OPERATING: Final = (Mode.ARMED, Mode.ACTIVE)
"""Modes in which the machine may be asked to move."""
_WAITING: Final = (Mode.BOOT, Mode.STANDBY)
RAMP_NS: Final = 60_000_000
"""Ramp of an R1: with the slowest detection before it (20 ms) neutral well within 100 ms of the loss."""
RANGE_MARGIN: Final = 0.05
"""How far past the profile's range [rad, m] a joint may be found before it counts as outside."""
ECHO_TICKS: Final = 4
DEGRADE_NS: Final = 1_000_000_000
LATE_PERIODS: Final = 2
LATE_CYCLES: Final = 3
LATE_WINDOW_NS: Final = 1_000_000_000
STALLED_NS: Final = 50_000_000
_RELEASED, _PRESSED = 1, 0
_YES: Final = 1
_ENABLED: Final = 0xA
_VALVE_PILOT_OFF, _VALVE_FAULT = 3, 4
_ALARM_SIGNALS: Final = {"rotary": "Alarms", "linear": "SystemReg"}


class Supervisor:
    """The mode and its reason; `judge` once per tick, the events as they come."""

    __slots__ = (
        "_alarms",
        "_axes",
        "_degraded_until_ns",
        "_echo",
        "_echo_ticks",
        "_late_stamps",
        "_reset_pressed",
        "_slow_end_ns",
        "_startup",
        "_stop_ramp_ns",
        "_watches",
        "coast_ns",
        "detail",
        "half_speed",
        "latching",
        "late",
        "machine",
        "mode",
        "ramp_end_ns",
        "ramp_ns",
        "reason",
        "received",
        "worst",
        "worst_detail",
    )  # fmt: skip

    def __init__(
        self,
        profile: Profile,
        received: Received,
        crane_watch: BusWatch,
        machine_bus: MachineBus | None,
        estimators: list[JointEstimator],
        startup: Startup,
    ) -> None:
        self.received = received
        self.machine = machine_bus.received if machine_bus is not None else None
        self._watches = (crane_watch,) if machine_bus is None else (crane_watch, machine_bus.watch)
        self._startup = startup
        sensed = [*received.encoders, received.articulation]
        self._alarms = tuple(
            (place, slot, slot.codec.index[_ALARM_SIGNALS[spec.kind]])
            for place, spec in encoders(profile).items()
            if (slot := sensed[place]) is not None
        )
        self._axes = tuple(
            (int(j), estimators[j], spec.lower - RANGE_MARGIN, spec.upper + RANGE_MARGIN)
            for j in JOINTS
            if (spec := joint(profile, j)).encoder is not None
        )
        self._stop_ramp_ns = profile.timeouts.stop_ramp_ms * 1_000_000
        self.mode = Mode.BOOT
        self.reason = Reason.NONE
        self.detail = 0
        self.half_speed = False
        self.ramp_ns = self.ramp_end_ns = self._slow_end_ns = 0
        self.coast_ns = 0
        """How long a carrier that drives would take to stand, if it were to stop now."""
        self.latching = False
        """The STOP that runs is an R1: FAULT follows its ramp."""
        self.worst = Reason.NONE
        self.worst_detail = 0
        self._degraded_until_ns = 0
        self._late_stamps = [-LATE_WINDOW_NS] * LATE_CYCLES
        self.late = 0
        """Ticks that began more than `LATE_PERIODS` late."""
        self._echo: Any = None
        self._echo_ticks = 0
        self._reset_pressed = True

    @property
    def armed(self) -> bool:
        """Whether needed inputs are watched: ARMED, ACTIVE and while a stop's ramp runs."""
        return self.mode in OPERATING or self.ramping

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
            self.ramp_end_ns = self._slow_end_ns = now_ns + self.ramp_ns
            if not self.latching:
                self._slow_end_ns = max(self.ramp_end_ns, now_ns + self.coast_ns)
        return True

    def ask_arm(self, now_ns: int) -> tuple[Reason, int]:
        """The operator's ARM: NONE when the machine is armed now (or was), else why not."""
        if self.mode in OPERATING:
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
            self._startup.reset(lambda node: self.received.nodes.operational(node, now_ns))
            if self.machine is not None and self.machine.address.lost:
                self.machine.address.again()

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
        machine = self.machine
        if any(slot.values is None for slot in received.needed) or (machine is not None and machine.stale_mask):
            return Reason.INPUT_MISSING, 0
        if received.guard.get("Enable") != _ENABLED:
            return Reason.GUARD_NOT_READY, 0
        if received.valve_a.get("State") == _VALVE_FAULT:
            return Reason.VALVE_NODE_NOT_READY, 0
        absent = received.nodes.not_ready(now_ns)
        if absent:
            return Reason.NODE_NOT_OPERATIONAL, absent
        for watch in self._watches:
            if not watch.fit(now_ns):
                return Reason.BUS_UNSTABLE, watch.number
        self.worst, self.worst_detail = Reason.NONE, 0
        self._judge_inputs()
        self._find(*received.nodes.finding(now_ns))
        if machine is not None:
            self._judge_machine(machine)
        reacts = FAULTS[self.worst].reaction >= Reaction.HOLD
        return (self.worst, self.worst_detail) if reacts else (Reason.NONE, 0)

    def judge(self, late_ns: int, period_ns: int, now_ns: int) -> None:
        """Looks at everything once, then applies the worst finding."""
        machine = self.machine
        self.worst, self.worst_detail = Reason.NONE, 0
        for watch in self._watches:
            if watch.reason:
                self._find(watch.reason, watch.number)
        if self.received.foreign:
            self._find(Reason.FOREIGN_CONTROLLER, 0)
        if machine is not None and machine.foreign:
            self._find(Reason.FOREIGN_CONTROLLER, 1)
        self._judge_estop()
        if self.armed:
            if self.received.stale_mask:
                self._judge_stale()
            self._judge_inputs()
            self._find(*self.received.nodes.finding(now_ns))
            self._judge_echo()
            if machine is not None:
                self._judge_machine(machine)
        self._judge_loop(late_ns, period_ns, now_ns)
        self.react(now_ns)
        if self.mode is Mode.BOOT and self._startup.complete:
            self.apply(Event.BOOTED, Reason.NONE, 0, now_ns)
        if self.ramping and now_ns >= (self._slow_end_ns if self.coast_ns else self.ramp_end_ns):
            self.ramp_ns = 0
            if self.latching:
                self.apply(Event.LATCHED, self.reason, self.detail, now_ns)
        if self.mode in _WAITING:
            self.reason, self.detail = self.blocker(now_ns)
            if self.reason is Reason.NONE:
                self.reason = self._note()
        elif self.mode in OPERATING and not self.half_speed:
            self.reason, self.detail = self._note(), 0

    def react(self, now_ns: int) -> None:
        """Applies ``worst``: an event, or half speed for a while."""
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
        if reason and FAULTS[reason].reaction > FAULTS[self.worst].reaction:
            self.worst, self.worst_detail = reason, detail

    def _judge_loop(self, late_ns: int, period_ns: int, now_ns: int) -> None:
        """A cycle beyond two periods slows the machine; three within a second, or one beyond 50 ms, stop it."""
        if late_ns <= LATE_PERIODS * period_ns:
            return
        stamps = self._late_stamps
        stamps[self.late % LATE_CYCLES] = now_ns
        self.late += 1
        stalled = late_ns > STALLED_NS or now_ns - min(stamps) < LATE_WINDOW_NS
        self._find(Reason.LOOP_STALLED if stalled else Reason.LOOP_LATE)

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
        for place, encoder, _ in self._alarms:
            if encoder.values is None:
                self._find(Reason.ENCODER_LOST, place)
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
        for place, encoder, alarm in self._alarms:
            values = encoder.values
            if values is not None and values[alarm]:
                self._find(Reason.ENCODER_ALARM, place)
        for j, estimator, lower, upper in self._axes:
            if estimator.jumped:
                self._find(Reason.ENCODER_JUMP, j)
            if estimator.known and not lower <= estimator.position <= upper:
                self._find(Reason.POSITION_OUTSIDE, j)

    def _judge_machine(self, machine: MachineReceived) -> None:
        """mach0: the carrier stands and is heard, while the crane works."""
        if machine.stale_mask:
            if machine.vehicle.values is None:
                self._find(Reason.CARRIER_LOST)
            if machine.arms_a.values is None or machine.arms_b.values is None:
                self._find(Reason.SWING_ARMS_LOST)
        if machine.address.lost:
            self._find(Reason.ADDRESS_LOST)

    def _note(self) -> Reason:
        """What is worth saying while nothing speaks against working."""
        machine = self.machine
        if machine is None:
            return Reason.NONE
        if machine.position.get("Latitude") is None or machine.heading.get("Heading") is None:
            return Reason.GNSS_LOST
        return Reason.ENGINE_LOST if machine.engine.values is None else Reason.NONE

    def _judge_echo(self) -> None:
        """The valve node repeats the counter of the last command it took; it must move."""
        echo = self.received.valve_b.get("EchoCounter")
        self._echo_ticks = 0 if echo != self._echo else self._echo_ticks + 1
        self._echo = echo
        if self._echo_ticks > ECHO_TICKS:
            self._find(Reason.VALVE_ECHO_STUCK)
