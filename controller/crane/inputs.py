"""Received values of crane0: frames to message states by key, the nodes' own frames, and foreign command frames.

Only the newest values are kept.  Heartbeats, emergency messages and SDO answers are recognized by key; every other
frame is counted as unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    SDO_TO_CLIENT,
    Emergency,
    HeartbeatMonitor,
    NodeState,
    Presence,
    parse_emergency,
)
from controller.bus_io import MessageState, Signal, age_out
from machine.crane_nodes import PRESSURE_NODES, CraneNode
from machine.joints import ARTICULATION, JOINTS
from machine.profile import Profile, encoders
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from machine.status.stale_inputs import CRANE_INPUT_BITS, ENCODER_BIT

# -- Supervision of the CANopen nodes of crane0: heartbeats, restarts and emergency messages, and the worst finding.
#
# Inputs: heartbeats and emergency messages of the machine's nodes.  Output: one finding, a `Reason` with the node's
# number.  It is updated only when a node sent something or a heartbeat timed out, because most ticks bring nothing new.


SAFETY_NODES: Final = (CraneNode.SAFETY_MODULE, CraneNode.VALVES, CraneNode.GUARD)
"""Safety module, valve node, guard: the machine stops at once without their heartbeat."""

HEARTBEAT_TIMEOUT_NS: Final = 250_000_000
_COMMUNICATION_LIMIT_COUNT: Final = 3
_NONE: Final = Reason.NONE
_LOST: Final = Presence.LOST
_OPERATIONAL: Final = NodeState.OPERATIONAL
_COMMUNICATION_WINDOW_NS: Final = 10_000_000_000


class NodeHealth:
    """State of a node besides its heartbeat."""

    __slots__ = ("booted", "boots", "code", "emergency", "warning")

    def __init__(self) -> None:
        self.boots = 0
        self.booted = False
        """A boot-up frame came in this tick."""
        self.emergency = self.warning = False
        self.code = 0
        """The last error code that it sent (CiA 301), 0 before the first."""


class NodeMonitor:
    """Monitors the required nodes: safety nodes, pressure modules and ``encoder_nodes``."""

    __slots__ = (
        "_changed",
        "_communication_count",
        "_communication_ns",
        "_finding",
        "_good_until_ns",
        "_heartbeats",
        "booted",
        "by_number",
    )

    def __init__(self, encoder_nodes: Sequence[int]) -> None:
        self.by_number = {n: NodeHealth() for n in (*SAFETY_NODES, *PRESSURE_NODES, *encoder_nodes)}
        self.booted: list[int] = []
        """Nodes that sent a boot-up frame in this tick."""
        self._heartbeats = HeartbeatMonitor(dict.fromkeys(self.by_number, HEARTBEAT_TIMEOUT_NS), 0, 0)
        self._communication_ns = [-_COMMUNICATION_WINDOW_NS] * _COMMUNICATION_LIMIT_COUNT
        self._communication_count = 0
        self._changed = True
        self._good_until_ns = 0
        self._finding = (Reason.NONE, 0)

    def forget(self) -> None:
        """Forget all heartbeats.  Emergencies stay: a node reports one once and clears it once."""
        self._heartbeats.forget()
        self._changed = True

    def begin_tick(self) -> None:
        """Begin a tick: a boot-up counts in one tick only."""
        if self.booted:
            for number in self.booted:
                self.by_number[number].booted = False
            self.booted.clear()
            self._changed = True

    def receive(self, frame: Frame, now_ns: int) -> bool:
        """Tell whether the frame is a heartbeat or emergency message of a monitored node."""
        _, key, data = frame
        if self._heartbeats.receive(key, data, now_ns):
            self._changed = True
            self._note_boot(key & 0x7F)
            return True
        message = parse_emergency(key, data)
        if message is None or message.node not in self.by_number:
            return False
        self._changed = True
        self._emergency(self.by_number[message.node], message, now_ns)
        return True

    def operational(self, number: int, now_ns: int) -> bool:
        """Tell whether a node is alive and OPERATIONAL."""
        return self._heartbeats.operational(number, now_ns)

    def heartbeat_age_ns(self, number: int, now_ns: int) -> int:
        """Return the time since the last heartbeat of a node; since the clock's zero for a node that sent none."""
        return self._heartbeats.age_ns(number, now_ns)

    def nmt_state(self, number: int) -> int:
        """Return the state of a node in its last heartbeat; -1 without one."""
        return self._heartbeats.states.get(number, -1)

    def not_ready(self, now_ns: int) -> int:
        """Find a required node that is not operational; 0 when all are."""
        for number in self.by_number:
            if number not in PRESSURE_NODES and not self._heartbeats.operational(number, now_ns):
                return number
        return 0

    def worst_finding(self, now_ns: int) -> tuple[Reason, int]:
        """Return the worst finding of all nodes, and the node's number."""
        if self._changed or now_ns > self._good_until_ns:
            self._changed = False
            self._good_until_ns = self._heartbeats.next_loss_ns()
            self._finding = self._worst(now_ns)
        return self._finding

    def _worst(self, now_ns: int) -> tuple[Reason, int]:
        worst, detail = _NONE, 0
        for number, node in self.by_number.items():
            for reason in (self._absence(number, node, now_ns), _own_report(node)):
                if reason and FAULTS[reason].reaction > FAULTS[worst].reaction:
                    worst, detail = reason, number
        return worst, detail

    def _absence(self, number: int, node: NodeHealth, now_ns: int) -> Reason:
        helper = number in PRESSURE_NODES
        if self._heartbeats.presence(number, now_ns) is _LOST:
            if helper:
                return Reason.PRESSURE_NODE_LOST
            return Reason.SAFETY_NODE_LOST if number in SAFETY_NODES else Reason.ENCODER_NODE_LOST
        state = self._heartbeats.states.get(number, _OPERATIONAL)
        restarted = not helper and (node.booted or state != _OPERATIONAL)
        return Reason.NODE_RESTARTED if restarted else _NONE

    def _note_boot(self, number: int) -> None:
        node, boots = self.by_number[number], self._heartbeats.boots[number]
        if boots != node.boots:
            node.boots = boots
            node.emergency = node.warning = False
            if not node.booted:
                node.booted = True
                self.booted.append(number)

    def _emergency(self, node: NodeHealth, message: Emergency, now_ns: int) -> None:
        """Take an emergency as docs/reference/can-bus.md section 9 says: 0000 clears, 81xx counts to three in 10 s,
        5xxx, 6xxx and FFxx stop the machine, the rest warns.
        """
        code = message.code
        node.code = code or node.code
        if code == 0:
            node.emergency = node.warning = False
        elif code >> 8 == 0x81:
            stamps = self._communication_ns
            stamps[self._communication_count % _COMMUNICATION_LIMIT_COUNT] = now_ns
            self._communication_count += 1
            node.emergency |= now_ns - min(stamps) < _COMMUNICATION_WINDOW_NS
        elif code >> 12 in (5, 6) or code >> 8 == 0xFF or message.register & 0x80:
            node.emergency = True
        else:
            node.warning = True


def _own_report(node: NodeHealth) -> Reason:
    """Return what a node reports about itself."""
    if node.emergency:
        return Reason.EMERGENCY_MESSAGE
    return Reason.EMERGENCY_WARNING if node.warning else _NONE


# -- The inputs


LOST_SAMPLES: Final = 3
"""An encoder behind a PLC is lost after this many of the PLC's samples, as one on the bus after as many periods."""
_EXCHANGE_NS: Final = 10_000_000
"""A faster PLC brings no more samples: the bridge asks it for an answer in this period."""
_OWN_MESSAGES: Final = ("Nmt", "Sync", "ValveCmdA", "ValveCmdB", "CtrlStatus", "HeartbeatCtrl")


def sample_timeout_ns(profile: Profile) -> int:
    """Return the time without a new sample after which an encoder behind a PLC is lost.

    0: no PLC, the DBC's time-out counts.
    """
    return 0 if profile.plc is None else LOST_SAMPLES * max(_EXCHANGE_NS, round(profile.plc.sample_ms * 1e6))


class CraneInputs:
    """All inputs from crane0: message states, nodes, and what this tick brought."""

    def __init__(self, database: Database, profile: Profile) -> None:
        self._by_key: dict[int, MessageState] = {}

        def state(name: str, bit: int, timeout_ns: int = 0) -> MessageState:
            codec = database.message(name)
            return self._by_key.setdefault(codec.key, MessageState(codec, bit, timeout_ns=timeout_ns))

        self.estop, self.guard, self.valve_a, self.valve_b, self.plc, *helpful = (
            state(name, bit) for name, bit in CRANE_INPUT_BITS.items()
        )
        self.pressures, self.grapple = helpful[:3], helpful[3]
        self.plc_outputs = None if profile.plc is None else state("PlcOut", CRANE_INPUT_BITS["PlcStatus"])
        """Openings that a PLC commands to the valves, None without one: part of its status, so with the same bit."""
        self.plc_states = [self.plc] if self.plc_outputs is None else [self.plc, self.plc_outputs]
        specs = encoders(profile)
        lost_ns = sample_timeout_ns(profile)
        sensed = {
            joint_number: state(spec.message, ENCODER_BIT + joint_number, lost_ns)
            for joint_number, spec in specs.items()
        }
        self.encoders = [sensed.get(j) for j in JOINTS]
        """By joint; None where the machine has none."""
        self.articulation = sensed.get(ARTICULATION)
        self.imu = None
        """Swing of the grapple, None without the sensor.  It is optional, so it has no bit in the mask."""
        if profile.imu is not None:
            codec = database.message(profile.imu.message)
            self.imu = self._by_key.setdefault(codec.key, MessageState(codec, 0, watched=False))
        self._masked = tuple(s for s in self._by_key.values() if s is not self.imu)
        self.needed = [self.estop, self.guard, self.valve_a, self.valve_b, *self.plc_states, *sensed.values()]
        self.nodes = NodeMonitor([spec.node for spec in specs.values()])
        self._own = frozenset(database.message(name).key for name in _OWN_MESSAGES)
        self.messages = tuple(self._by_key.values())
        self.stale_mask = age_out(self._masked, 0)
        self.foreign = False
        """Another node sent one of the controller's own frames in this tick."""
        self.heard_ns = 0
        """When the newest frame came, whatever it was."""
        self.unknown = self.count = 0

    def filters(self) -> list[int]:
        """List the keys for the bus's filter; the controller's own are among them, to notice a foreign sender."""
        services = (EMCY_BASE, SDO_TO_CLIENT, HEARTBEAT_BASE)
        return [*self._by_key, *self._own, *(base + node for base in services for node in self.nodes.by_number)]

    def forget(self) -> None:
        """Make all values unknown again, as after a time without reception."""
        for state in self.messages:
            state.forget()
        self.nodes.forget()

    def decode(self, frames: list[Frame], now_ns: int, sdo: Callable[[int, bytes], bool]) -> None:
        """Decode the frames of a tick in bus order; ``sdo(key, data)`` is True for an SDO answer that it used."""
        self.foreign = False
        for state in self.messages:
            state.fresh = False
        nodes = self.nodes
        nodes.begin_tick()
        by_key, own = self._by_key, self._own
        for frame in frames:
            key = frame[1]
            message = by_key.get(key)
            if message is not None:
                message.receive(frame, now_ns)
            elif key in own:
                self.foreign = True
            elif not (nodes.receive(frame, now_ns) or sdo(key, frame[2])):
                self.unknown += 1
        self.count += len(frames)
        if frames:
            self.heard_ns = min(frames[-1][0], now_ns)
        self.stale_mask = age_out(self._masked, now_ns)
        if self.imu is not None:
            age_out((self.imu,), now_ns)


def spool_signals(inputs: CraneInputs) -> list[Signal]:
    """List the positions of the spools [%], in ``Joint`` order: measured, or as a PLC reports its outputs to them;
    without a value where neither is known.
    """
    outputs = inputs.plc_outputs
    if outputs is not None:
        return [Signal(outputs, joint.name.capitalize()) for joint in JOINTS]
    names = ("SpoolSlew", "SpoolLift", "SpoolTilt", "SpoolExt")
    return [*(Signal(inputs.valve_a, name) for name in names), Signal(inputs.valve_b, "SpoolRot")]
