"""The bridge as one pure object: frames of crane0 and answers of the PLC in, frames and commands for the PLC out.

``step(now_ns, frames)`` plays safety module, encoders, valve node and pressure modules with what the PLC last said;
``command(now_ns)`` is what to send it next.  Every 5 ms and whenever frames have come, ``step`` is to be called.  While
no good answer of the PLC is at most 50 ms old nothing is said on crane0 at all, and the controller stops by the same
time-outs that watch real nodes.  What a PLC does not measure (spools, pump and slew pressures) is marked not available.
"""

from __future__ import annotations

import math
from typing import Final

from can_dbc.canopen import NMT_ID, SDO_TO_SERVER, SYNC_ID, Wire
from can_dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.plc.map import Command, Estop, Feedback, Grapple, Role, State, WordOrder
from controller.config import ConfigError
from controller.outputs import Every, Message
from controller.plc.emulated_nodes import Between, PlayedEncoder, PlayedNode
from controller.plc.handshake import FRESH_NS, Handshake
from controller.plc.valve_gate import ValveGate, fault_bits, state_of
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint

MS: Final = 1_000_000
EXCHANGE_NS: Final = 10 * MS
"""A command goes to the PLC this often (100 Hz)."""
SAFE_NODE, VALVE_NODE, PRESSURE_NODES = 0x01, 0x10, (0x20, 0x21, 0x22)
FORGOTTEN_NS: Final = 250 * MS
"""After a silence of this long the played nodes boot: their heartbeats were missed."""
_NO_AXIS: Final = 15
_ENDS: Final = (0.02, 0.98)
_PLC_RUNS, _PLC_HOLDS = 2, 1


def role_of(profile: Profile) -> Role:
    """The PLC's role on this machine; raises ConfigError for what the bridge cannot serve."""
    if profile.plc is None:
        raise ConfigError(f'{profile.name} has no PLC; add [plc] with role = "references" or "valves" to the profile.')
    if profile.carrier is not None:
        raise ConfigError(f"{profile.name} has a carrier; the PLC bridge serves a crane on a fixed base.")
    return Role.REFERENCES if profile.plc.role == "references" else Role.VALVES


class Bridge:
    """All state of the bridge; ``handshake`` talks to the PLC, ``gate`` listens to controller and guard."""

    def __init__(self, profile: Profile, database: Database, order: WordOrder = WordOrder.HIGH_FIRST) -> None:
        role = role_of(profile)
        self.handshake = Handshake(order)
        self.gate = ValveGate(profile, role, database)
        specs = {j: spec for j in JOINTS if (spec := joint(profile, j).encoder) is not None}
        self._encoders = {j: PlayedEncoder(spec, database.message(spec.message)) for j, spec in specs.items()}
        helpers = [PlayedNode(n, {}, starts=True) for n in (SAFE_NODE, VALVE_NODE, *PRESSURE_NODES)]
        self._nodes: list[PlayedNode] = [*helpers, *self._encoders.values()]
        self._by_number = {node.node: node for node in self._nodes}
        self._positions = {j: Between() for j in self._encoders}
        names = ("EstopStat", "ValveFbA", "ValveFbB", "PressA", "PressB", "PressC", "GrappleStat", "PlcStatus")
        self._messages = {name: Message(database.message(name)) for name in names}
        self._fast, self._estop_due, self._slow = Every(5 * MS), Every(10 * MS), Every(20 * MS)
        self._estop_bits, self._estop_events = -1, 0
        self._counter = 0
        self._heard: Feedback | None = None
        self._spoke_ns = -FORGOTTEN_NS
        self._last = Command()

    def command(self, now_ns: int) -> Command:
        """What the PLC is to be told now."""
        feedback = self.handshake.feedback if self.handshake.fresh(now_ns) else None
        self._last = self.gate.command(now_ns, feedback)
        return self._last

    def step(self, now_ns: int, frames: list[Frame]) -> list[Wire]:
        """Takes the frames since the last call; returns what to send."""
        feedback = self.handshake.feedback
        speaking = feedback is not None and self.handshake.fresh(now_ns)
        if speaking and now_ns - self._spoke_ns > FORGOTTEN_NS:
            self._wake()
        out: list[Wire] = []
        if feedback is not None and feedback is not self._heard:
            self._notice(feedback, now_ns)
        for frame in frames:
            self._receive(frame, now_ns, out if speaking else None)
        if speaking and feedback is not None:
            self._spoke_ns = now_ns
            self._say(feedback, now_ns, out)
        return out

    def _wake(self) -> None:
        for node in self._nodes:
            node.boot()
        for between in self._positions.values():
            between.forget()

    def _notice(self, feedback: Feedback, now_ns: int) -> None:
        """A new answer; positions count only when the PLC has made a cycle since."""
        before, self._heard = self._heard, feedback
        if before is None or before.heartbeat != feedback.heartbeat:
            for j, between in self._positions.items():
                between.sample(feedback.position[j], now_ns, FRESH_NS)

    def _receive(self, frame: Frame, now_ns: int, out: list[Wire] | None) -> None:
        """``out`` is None while we are silent: then only the gate listens."""
        key = frame.key
        if key == SYNC_ID:
            self.gate.sync(now_ns)
            if out is not None and self._heard is not None:
                self._sample(self._heard, now_ns, out)
        elif key == NMT_ID and out is not None:
            for node in self._nodes:
                node.receive_nmt(frame.data)
        elif SDO_TO_SERVER < key <= SDO_TO_SERVER + 0x7F and out is not None:
            addressed = self._by_number.get(key - SDO_TO_SERVER)
            answer = None if addressed is None else addressed.receive_sdo(key, frame.data)
            if answer is not None:
                out.append(answer)
        else:
            self.gate.receive(frame, now_ns)

    def _sample(self, feedback: Feedback, now_ns: int, out: list[Wire]) -> None:
        for j, encoder in self._encoders.items():
            answer = encoder.answer(self._positions[j].at(now_ns), feedback.velocity[j], now_ns)
            if answer is not None:
                out.append(answer)

    def _say(self, feedback: Feedback, now_ns: int, out: list[Wire]) -> None:
        """What the played nodes send by themselves."""
        for node in self._nodes:
            node.tick(now_ns, out)
        running = {number: node.operational for number, node in self._by_number.items()}
        if feedback.estop != self._estop_bits:
            self._estop_events = (self._estop_events + 1) & 0xFF
        changed, self._estop_bits = feedback.estop != self._estop_bits, feedback.estop
        if (self._estop_due.due(now_ns) or changed) and running[SAFE_NODE]:
            out.append(self._estop(feedback))
        fast, slow = self._fast.due(now_ns), self._slow.due(now_ns)
        if running[VALVE_NODE]:
            if fast:
                out += self._valves(feedback, now_ns)
            if slow:
                out += (self._grapple(feedback), self._status(feedback))
        p, wire = feedback.pressure_bar, self._messages
        if fast and running[PRESSURE_NODES[0]]:
            out.append(wire["PressA"].carrying(0, *p[0:4]))
        if fast and running[PRESSURE_NODES[1]]:
            out.append(wire["PressB"].carrying(0, *p[4:6], None, None))
        if slow and running[PRESSURE_NODES[2]]:
            out.append(wire["PressC"].carrying(0, None, None, *p[6:8]))

    def _estop(self, feedback: Feedback) -> Wire:
        bits = feedback.estop
        channels = (int(bool(bits & Estop.CHANNEL_A)), int(bool(bits & Estop.CHANNEL_B)))
        reset, pilot = int(bool(bits & Estop.RESET_PRESSED)), int(bool(bits & Estop.PILOT_ON))
        person = int(bool(bits & Estop.PERSON))
        return self._messages["EstopStat"].carrying(*channels, 0, reset, pilot, person, None, self._estop_events)

    def _valves(self, feedback: Feedback, now_ns: int) -> tuple[Wire, Wire]:
        """The counter of the last command is echoed only while the PLC itself takes ours."""
        if self.handshake.acknowledged(now_ns):
            self._counter = self.gate.counter
        unknown = (None,) * 4
        return (
            self._messages["ValveFbA"].carrying(state_of(feedback, self.gate), *unknown),
            self._messages["ValveFbB"].carrying(
                feedback.fault_axis if feedback.fault_axis < _NO_AXIS else _NO_AXIS,
                None, None, None, self.gate.exit, self._counter, 3,
            ),
        )  # fmt: skip

    def _grapple(self, feedback: Feedback) -> Wire:
        rotator = math.degrees(math.remainder(feedback.position[Joint.ROT], math.tau))
        rot_deg = rotator if Joint.ROT in self._encoders else None
        return self._messages["GrappleStat"].carrying(
            self._grapple_state(feedback.opening), 100.0 * feedback.opening, feedback.pressure_bar[6], feedback.load_kg,
            rot_deg,
        )  # fmt: skip

    def _grapple_state(self, opening: float) -> int:
        """0 unknown, 1 open, 2 opening, 3 closing, 4 closed, 5 holding: by the last command and the opening."""
        closed, opened = opening < _ENDS[0], opening > _ENDS[1]
        match self._last.grapple:
            case Grapple.OPEN:
                return 1 if opened else 2
            case Grapple.CLOSE:
                return 4 if closed else 3
            case Grapple.HOLD:
                return 5
            case _:
                return 1 if opened else 4 if closed else 5

    def _status(self, feedback: Feedback) -> Wire:
        run = _PLC_RUNS if feedback.state is State.EXECUTE else _PLC_HOLDS
        return self._messages["PlcStatus"].carrying(
            run, feedback.heartbeat & 0xFF, feedback.longest_cycle_us, fault_bits(feedback)
        )
