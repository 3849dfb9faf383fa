"""The CANopen nodes of crane0: who is alive, who restarted, who complains, and the worst of it.

Inputs: heartbeats and emergency messages of the nodes this machine has.  Output: one finding, a `Reason` with the
node's number.  It is looked for only when a node has spoken or has been silent for too long, for most ticks bring
nothing new.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.canopen import Emergency, HeartbeatMonitor, NodeState, Presence, parse_emergency
from can_dbc.frame import Frame
from machine.faults import FAULTS
from machine.reasons import Reason

SAFETY_NODES: Final = (0x01, 0x10, 0x7D)
"""Safety module, valve node, guard: without their heartbeat everything stops at once."""
PRESSURE_NODES: Final = (0x20, 0x21, 0x22)

HEARTBEAT_TIMEOUT_NS: Final = 250_000_000
_COMMUNICATION_LIMIT: Final = 3
_COMMUNICATION_WINDOW_NS: Final = 10_000_000_000


class Node:
    """What is known of a node besides its heartbeat."""

    __slots__ = ("booted", "boots", "emergency", "warning")

    def __init__(self) -> None:
        self.boots = 0
        self.booted = False
        """A boot-up frame came this tick."""
        self.emergency = self.warning = False


class Nodes:
    """All nodes that must be there: safety nodes, pressure modules and ``encoder_nodes``."""

    __slots__ = (
        "_communication_count", "_communication_ns", "_finding", "_good_until_ns", "_heartbeats", "_news", "booted",
        "by_number",
    )  # fmt: skip

    def __init__(self, encoder_nodes: Sequence[int]) -> None:
        self.by_number = {n: Node() for n in (*SAFETY_NODES, *PRESSURE_NODES, *encoder_nodes)}
        self.booted: list[int] = []
        """Who sent a boot-up frame this tick."""
        self._heartbeats = HeartbeatMonitor(dict.fromkeys(self.by_number, HEARTBEAT_TIMEOUT_NS), 0, 0)
        self._communication_ns = [-_COMMUNICATION_WINDOW_NS] * _COMMUNICATION_LIMIT
        self._communication_count = 0
        self._news = True
        self._good_until_ns = 0
        self._finding = (Reason.NONE, 0)

    def forget(self) -> None:
        """Nobody was heard yet.  What a node complained of stands: it says it once, and takes it back once."""
        self._heartbeats.forget()
        self._news = True

    def begin(self) -> None:
        """A tick begins: a boot is news of one tick."""
        if self.booted:
            for number in self.booted:
                self.by_number[number].booted = False
            self.booted.clear()
            self._news = True

    def receive(self, frame: Frame, now_ns: int) -> bool:
        """Whether the frame is a heartbeat or emergency message of a node we know."""
        _, key, data = frame
        if self._heartbeats.receive(key, data, now_ns):
            self._news = True
            self._note_boot(key & 0x7F)
            return True
        message = parse_emergency(key, data)
        if message is None or message.node not in self.by_number:
            return False
        self._news = True
        self._emergency(self.by_number[message.node], message, now_ns)
        return True

    def operational(self, number: int, now_ns: int) -> bool:
        """Whether a node is alive and says OPERATIONAL."""
        return self._heartbeats.operational(number, now_ns)

    def not_ready(self, now_ns: int) -> int:
        """A needed node that is not operational; 0 when all are."""
        for number in self.by_number:
            if number not in PRESSURE_NODES and not self._heartbeats.operational(number, now_ns):
                return number
        return 0

    def finding(self, now_ns: int) -> tuple[Reason, int]:
        """The worst that is to be said of any node, and its number."""
        if self._news or now_ns > self._good_until_ns:
            self._news = False
            self._good_until_ns = self._heartbeats.next_loss_ns()
            self._finding = self._worst(now_ns)
        return self._finding

    def _worst(self, now_ns: int) -> tuple[Reason, int]:
        worst, detail = Reason.NONE, 0
        for number, node in self.by_number.items():
            for reason in (self._absence(number, node, now_ns), _complaint(node)):
                if FAULTS[reason].reaction > FAULTS[worst].reaction:
                    worst, detail = reason, number
        return worst, detail

    def _absence(self, number: int, node: Node, now_ns: int) -> Reason:
        helper = number in PRESSURE_NODES
        if self._heartbeats.presence(number, now_ns) is Presence.LOST:
            if helper:
                return Reason.PRESSURE_NODE_LOST
            return Reason.SAFETY_NODE_LOST if number in SAFETY_NODES else Reason.ENCODER_NODE_LOST
        state = self._heartbeats.states.get(number, NodeState.OPERATIONAL)
        restarted = not helper and (node.booted or state != NodeState.OPERATIONAL)
        return Reason.NODE_RESTARTED if restarted else Reason.NONE

    def _note_boot(self, number: int) -> None:
        node, boots = self.by_number[number], self._heartbeats.boots[number]
        if boots != node.boots:
            node.boots = boots
            node.emergency = node.warning = False
            if not node.booted:
                node.booted = True
                self.booted.append(number)

    def _emergency(self, node: Node, message: Emergency, now_ns: int) -> None:
        """can_bus.md section 9: 0000 clears, 81xx counts to three in 10 s, 5xxx, 6xxx and FFxx stop, the
        rest warns.
        """
        code = message.code
        if code == 0:
            node.emergency = node.warning = False
        elif code >> 8 == 0x81:
            stamps = self._communication_ns
            stamps[self._communication_count % _COMMUNICATION_LIMIT] = now_ns
            self._communication_count += 1
            node.emergency |= now_ns - min(stamps) < _COMMUNICATION_WINDOW_NS
        elif code >> 12 in (5, 6) or code >> 8 == 0xFF or message.register & 0x80:
            node.emergency = True
        else:
            node.warning = True


def _complaint(node: Node) -> Reason:
    """What a node itself says is wrong."""
    if node.emergency:
        return Reason.EMERGENCY_MESSAGE
    return Reason.EMERGENCY_WARNING if node.warning else Reason.NONE
