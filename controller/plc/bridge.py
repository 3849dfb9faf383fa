"""The bridge as one pure object: frames of crane0 and answers of the PLC in, frames and commands for the PLC out.

`Bridge.step` emulates safety module, encoders, valve node and pressure modules with the PLC's last answer; call it
every 5 ms and whenever frames arrive.  `Bridge.command` is the next command for the PLC.  Unless a good answer of the
PLC is at most 50 ms old, nothing is sent on crane0, and the controller stops by the same time-outs that monitor real
nodes.  Values that a PLC does not measure (spools, pump and slew pressures) are marked not available.

Nothing is invented between two answers.  EstopStat is the safety module's own frame, with its checksum and counter, and
is passed on once.  A sample of the encoders is sent once, at the next SYNC, with the PLC's time stamp, and pressures
and the PLC's outputs to its valves once per PLC cycle: where the PLC repeats a sample, controller and guard see none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from typing import Final

from can_dbc.dbc.codec import Database, MessageCodec
from can_dbc.frame import Frame, RawFrame
from can_dbc.plc.map import ESTOP_BYTES, N_JOINTS, Command, Feedback, Grapple, Role, State
from can_dbc.protocols.canopen import (
    HEARTBEAT_MS,
    NMT_ID,
    SDO_TO_SERVER,
    SYNC_ID,
    CanopenSlave,
    NodeState,
    Objects,
    heartbeat_frame,
)
from controller.bus_io import PeriodicTimer, ProtectedMessage
from controller.crane.inputs import sample_timeout_ns
from controller.crane.startup import TPDO1, TPDO1_MAPPINGS
from controller.plc.handshake import Handshake
from controller.plc.valve_gate import ValveGate, fault_bits, state_of
from machine.crane_nodes import PRESSURE_NODES, CraneNode
from machine.joints import JOINTS, Joint
from machine.profile import Encoder, Profile, joint
from machine.sensing import counts_from_position
from runtime.errors import ConfigError

MS: Final = 1_000_000
EXCHANGE_NS: Final = 10 * MS
"""Period of commands to the PLC (100 Hz)."""
REBOOT_AFTER_NS: Final = 250 * MS
"""After this long without frames the emulated nodes boot: their heartbeats were missed."""
_NO_AXIS: Final = 15
_CLOSED_SHARE, _OPEN_SHARE = 0.02, 0.98
_PLC_RUNS, _PLC_HOLDS = 2, 1


def role_of(profile: Profile) -> Role:
    """Return the PLC's role on this machine.

    Raises:
        ConfigError: the machine has no PLC, or has a carrier.
    """
    if profile.plc is None:
        raise ConfigError(
            "config.no-plc",
            f'{profile.name} has no PLC; add [plc] with role = "references" or "valves" to the profile.',
        )
    if profile.carrier is not None:
        raise ConfigError(
            "config.plc-carrier",
            f"{profile.name} has a carrier; the PLC bridge serves a crane on a fixed base only, use another profile.",
        )
    return Role.REFERENCES if profile.plc.role == "references" else Role.VALVES


class Bridge:
    """All state of the bridge; ``handshake`` exchanges with the PLC, ``gate`` receives from controller and guard."""

    def __init__(self, profile: Profile, database: Database, handshake: Handshake | None = None) -> None:
        role = role_of(profile)
        self.handshake = handshake or Handshake()
        self.gate = ValveGate(profile, role, database)
        specs = {j: spec for j in JOINTS if (spec := joint(profile, j).encoder) is not None}
        self._encoders = {j: EmulatedEncoder(spec, database.message(spec.message)) for j, spec in specs.items()}
        numbers = (CraneNode.SAFETY_MODULE, CraneNode.VALVES, *PRESSURE_NODES)
        helpers = [EmulatedNode(n, {}, starts=True) for n in numbers]
        self._nodes: list[EmulatedNode] = [*helpers, *self._encoders.values()]
        self._by_number = {node.node: node for node in self._nodes}
        names = ("ValveFbA", "ValveFbB", "PressA", "PressB", "PressC", "GrappleStat", "PlcStatus", "PlcOut")
        self._messages = {name: ProtectedMessage(database.message(name)) for name in names}
        self._fast, self._slow = PeriodicTimer(5 * MS), PeriodicTimer(20 * MS)
        self._estop_key, self._estop_frame = database.message("EstopStat").key, bytes(ESTOP_BYTES)
        self._new_cycle = self._new_sample = False  # not sent yet
        self._sampled_ns = 0
        self._sample_timeout_ns = sample_timeout_ns(profile)
        self._sessions = 0
        self._counter = 0
        self._feedback: Feedback | None = None
        self._sent_ns = -REBOOT_AFTER_NS
        self._last = Command()

    def command(self, now_ns: int) -> Command:
        """Compute the command for the PLC now."""
        shake = self.handshake
        if shake.sessions != self._sessions:
            self._sessions = shake.sessions
            self.gate.require_disarm()
        feedback = shake.feedback if shake.fresh(now_ns) else None
        self._last = self.gate.command(now_ns, feedback, now_ns - self._sampled_ns <= self._sample_timeout_ns)
        return self._last

    def step(self, now_ns: int, frames: list[Frame]) -> list[RawFrame]:
        """Use the frames since the last call; returns the frames to send."""
        feedback = self.handshake.feedback
        answering = feedback is not None and self.handshake.fresh(now_ns)
        if answering and now_ns - self._sent_ns > REBOOT_AFTER_NS:
            self._boot_nodes()
        out: list[RawFrame] = []
        if feedback is not None and feedback is not self._feedback:
            self._use_feedback(feedback, now_ns)
        for frame in frames:
            self._receive(frame, now_ns, out if answering else None)
        if answering and feedback is not None:
            self._sent_ns = now_ns
            self._send_cyclic(feedback, now_ns, out)
        return out

    def _boot_nodes(self) -> None:
        for node in self._nodes:
            node.boot()

    def _use_feedback(self, feedback: Feedback, now_ns: int) -> None:
        """Use a new answer; what the PLC only repeats does not count again."""
        before, self._feedback = self._feedback, feedback
        self._new_cycle = self._new_cycle or before is None or before.heartbeat != feedback.heartbeat
        if before is None or before.sampled_us != feedback.sampled_us:
            self._new_sample, self._sampled_ns = True, now_ns

    def _receive(self, frame: Frame, now_ns: int, out: list[RawFrame] | None) -> None:
        """Take a frame; ``out`` is None while nothing may be sent: then only the gate uses the frame."""
        key = frame.key
        if key == SYNC_ID:
            self.gate.sync(now_ns)
            if out is not None and self._feedback is not None and self._new_sample:
                self._sample(self._feedback, out)
        elif key == NMT_ID and out is not None:
            for node in self._nodes:
                node.receive_nmt(frame.data)
        elif SDO_TO_SERVER < key <= SDO_TO_SERVER + 0x7F and out is not None:
            addressed = self._by_number.get(key - SDO_TO_SERVER)
            answer = None if addressed is None else addressed.sdo_answer(key, frame.data)
            if answer is not None:
                out.append(answer)
        else:
            self.gate.receive(frame, now_ns)

    def _sample(self, feedback: Feedback, out: list[RawFrame]) -> None:
        self._new_sample = False
        for j, encoder in self._encoders.items():
            answer = encoder.answer(feedback.position[j], feedback.velocity[j], feedback.sampled_us)
            if answer is not None:
                out.append(answer)

    def _send_cyclic(self, feedback: Feedback, now_ns: int, out: list[RawFrame]) -> None:
        """Append the frames that the emulated nodes send by themselves."""
        for node in self._nodes:
            node.step(now_ns, out)
        running = {number: node.operational for number, node in self._by_number.items()}
        if feedback.estop_frame != self._estop_frame:
            self._estop_frame = feedback.estop_frame
            if running[CraneNode.SAFETY_MODULE]:
                out.append((self._estop_key, feedback.estop_frame))
        if self._fast.due(now_ns) and running[CraneNode.VALVES]:
            out += self._valves(feedback, now_ns)
        if not self._new_cycle:
            return
        self._new_cycle = False
        slow = self._slow.due(now_ns)
        p, wire = feedback.pressure_bar, self._messages
        if slow and running[CraneNode.VALVES]:
            out += (self._grapple(feedback), self._status(feedback))
        if running[CraneNode.VALVES]:
            out.append(wire["PlcOut"].frame_with(*(100.0 * u for u in feedback.output[:N_JOINTS])))
        if running[PRESSURE_NODES[0]]:
            out.append(wire["PressA"].frame_with(0, *p[0:4]))
        if running[PRESSURE_NODES[1]]:
            out.append(wire["PressB"].frame_with(0, *p[4:6], None, None))
        if slow and running[PRESSURE_NODES[2]]:
            out.append(wire["PressC"].frame_with(0, None, None, *p[6:8]))

    def _valves(self, feedback: Feedback, now_ns: int) -> tuple[RawFrame, RawFrame]:
        """Echo the counter of the last command only while the PLC accepts commands."""
        if self.handshake.acknowledged(now_ns):
            self._counter = self.gate.counter
        unknown = (None,) * 4
        return (
            self._messages["ValveFbA"].frame_with(state_of(feedback, self.gate), *unknown),
            self._messages["ValveFbB"].frame_with(
                feedback.fault_axis if feedback.fault_axis < _NO_AXIS else _NO_AXIS,
                None,
                None,
                None,
                self.gate.exit,
                self._counter,
                3,
            ),
        )

    def _grapple(self, feedback: Feedback) -> RawFrame:
        rotator = math.degrees(math.remainder(feedback.position[Joint.ROT], math.tau))
        rot_deg = rotator if Joint.ROT in self._encoders else None
        return self._messages["GrappleStat"].frame_with(
            self._grapple_state(feedback.opening),
            100.0 * feedback.opening,
            feedback.pressure_bar[6],
            feedback.load_kg,
            rot_deg,
        )

    def _grapple_state(self, opening: float) -> int:
        """Judge by the last command and the opening: 0 unknown, 1 open, 2 opening, 3 closing, 4 closed, 5 holding."""
        closed, opened = opening < _CLOSED_SHARE, opening > _OPEN_SHARE
        match self._last.grapple:
            case Grapple.OPEN:
                return 1 if opened else 2
            case Grapple.CLOSE:
                return 4 if closed else 3
            case Grapple.HOLD:
                return 5
            case _:
                return 1 if opened else 4 if closed else 5

    def _status(self, feedback: Feedback) -> RawFrame:
        run = _PLC_RUNS if feedback.state is State.EXECUTE else _PLC_HOLDS
        return self._messages["PlcStatus"].frame_with(
            run, feedback.heartbeat & 0xFF, feedback.longest_cycle_us, fault_bits(feedback)
        )


# -- The CANopen nodes that the bridge emulates on crane0: NMT, heartbeat, object dictionary, and an encoder's TPDO1.
#
# Pure.  A node answers only while the PLC behind it does; when the PLC answers again after a silence the node
# boots, so that the controller sets it up again like a device that had lost its supply.

HEARTBEAT_NS: Final = HEARTBEAT_MS * 1_000_000
_NOT_VALID: Final = 0x8000_0000


class EmulatedNode(CanopenSlave):
    """A node with heartbeat and SDO server; with ``starts`` it becomes operational by itself."""

    def __init__(self, node: int, objects: Objects, starts: bool, writable: Set[tuple[int, int]] = frozenset()) -> None:
        super().__init__(node, objects, writable)
        self._initial = dict(self.objects)
        self._starts = starts
        self._heartbeat = PeriodicTimer(HEARTBEAT_NS)

    def boot(self) -> None:
        """Start as after power-on."""
        self.state = NodeState.BOOT_UP
        self.restart()

    def restart(self) -> None:
        """Reset the object dictionary to its initial values."""
        self.objects = dict(self._initial)

    def step(self, now_ns: int, out: list[RawFrame]) -> None:
        """Append the boot-up message or the heartbeat that is due."""
        if self.state is NodeState.BOOT_UP:
            out.append(heartbeat_frame(self.node, NodeState.BOOT_UP))
            self.state = NodeState.OPERATIONAL if self._starts else NodeState.PRE_OPERATIONAL
        elif self._heartbeat.due(now_ns):
            out.append(heartbeat_frame(self.node, self.state))


class EmulatedEncoder(EmulatedNode):
    """A CiA 406 encoder with the PLC's position."""

    def __init__(self, spec: Encoder, codec: MessageCodec) -> None:
        self._spec, self._codec = spec, codec
        cob = TPDO1 + spec.node
        scale: Objects = (
            {(0x6001, 0): spec.total_counts.to_bytes(4, "little")}
            if spec.kind == "rotary"
            else {(0x6005, 1): round(spec.unit_per_count * 1e9).to_bytes(4, "little")}
        )
        communication: Mapping[tuple[int, int], bytes] = {
            (0x1800, 1): (_NOT_VALID | cob).to_bytes(4, "little"),
            (0x1800, 2): b"\x01",
            (0x1A00, 0): b"\x00",
        } | {(0x1A00, i): bytes(4) for i in range(1, 5)}
        super().__init__(
            spec.node,
            {
                (0x1000, 0): spec.device_type.to_bytes(4, "little"),
                (0x6000, 0): bytes(2),
                (0x6003, 0): bytes(4),
                (0x6509, 0): bytes(4),
                (0x6002, 0): spec.total_counts.to_bytes(4, "little"),
            }
            | scale
            | dict(communication),
            starts=False,
            writable=frozenset(communication) | {(0x1017, 0)},
        )
        self._mapping = TPDO1_MAPPINGS[spec.kind]

    def answer(self, position: float, velocity: float, sampled_us: int) -> RawFrame | None:
        """Build the TPDO1 of a sample that the PLC read at ``sampled_us`` by its own clock; None unless it is
        configured as in crane.dbc.
        """
        if not self.operational or not self._mapped():
            return None
        spec = self._spec
        counts = counts_from_position(spec, position)
        if spec.kind == "rotary":
            return self._codec.key, self._codec.encode(counts, sampled_us, 0)
        steps = round(spec.direction * velocity / spec.unit_per_count)
        return self._codec.key, self._codec.encode(counts, min(max(steps, -32768), 32767), 0, 0)

    def _mapped(self) -> bool:
        o, mapping = self.objects, self._mapping
        return (
            int.from_bytes(o[0x1800, 1], "little") == self._codec.key
            and 1 <= o[0x1800, 2][0] <= 240
            and o[0x1A00, 0][0] == len(mapping)
            and all(int.from_bytes(o[0x1A00, i], "little") == word for i, word in enumerate(mapping, 1))
        )
