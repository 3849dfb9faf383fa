"""Frames to values with an age: decode by key, E2E check, time-out, node states.

Every value starts as unknown.  A frame is refused whole when its length, checksum, counter or a value is
wrong; the old value then only grows older, until it is stale by the time-out that the DBC gives, and it must
qualify anew (two good frames).  A rotary encoder, which has no counter, is alive while its time stamp moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from can_dbc.canopen import Emergency, HeartbeatMonitor, parse_emergency
from can_dbc.codec import Database, FrameRefused, MessageCodec
from can_dbc.e2e import Checker
from can_dbc.frame import Frame
from controller.config import ConfigError
from machine.faults import ENCODER_BIT
from machine.joints import JOINTS
from machine.profile import Profile, joint

PROMISE_NS: Final = 100_000_000
"""Within this time after a needed input is lost every function is at neutral (design section 7)."""
_LONGEST_TIMEOUT_NS: Final = PROMISE_NS - 10_000_000

_BITS: Final = {
    "EstopStat": 0, "GuardStat": 1, "ValveFbA": 8, "ValveFbB": 9, "PlcStatus": 10,
    "PressA": 11, "PressB": 12, "PressC": 13, "GrappleStat": 14,
}  # fmt: skip
"""Bits of the stale mask; for the encoders see ``ENCODER_BIT``."""

_OWN_MESSAGES: Final = ("Nmt", "Sync", "ValveCmdA", "ValveCmdB", "CtrlStatus", "HeartbeatCtrl")
SAFETY_NODES: Final = (0x01, 0x10, 0x7D)
"""Safety module, valve node, guard: without their heartbeat everything stops at once."""
PRESSURE_NODES: Final = (0x20, 0x21, 0x22)

HEARTBEAT_TIMEOUT_NS: Final = 250_000_000
_COMMUNICATION_LIMIT: Final = 3
_COMMUNICATION_WINDOW_NS: Final = 10_000_000_000


class Slot:
    """The newest good frame of one message; ``values`` is None before the first and when it is stale."""

    __slots__ = (
        "_alive", "_checker", "_index", "_last_alive", "_receive", "bit", "fresh", "refused", "stamp_ns",
        "timeout_ns", "values",
    )  # fmt: skip

    def __init__(self, codec: MessageCodec, bit: int) -> None:
        if not codec.timeout_ns:
            raise ConfigError(f"The DBC gives no TimeoutMs for {codec.name}; add the attribute.")
        self._receive = codec.receive
        self._index = codec.index
        self._checker = Checker(codec.data_ids) if codec.data_ids else None
        self._alive = codec.index.get("TimeStamp", -1)
        self._last_alive: Any = None
        self.bit = bit
        self.timeout_ns = min(codec.timeout_ns, _LONGEST_TIMEOUT_NS)
        self.stamp_ns = 0
        self.values: tuple[Any, ...] | None = None
        self.fresh = False
        """A good frame came this tick."""
        self.refused = 0

    def get(self, signal: str) -> Any:
        """A signal's value; None when the message is unknown or stale, or the signal not available."""
        return None if self.values is None else self.values[self._index[signal]]

    def take(self, frame: Frame, now_ns: int) -> None:
        """Judges a frame and takes its values when they are good."""
        checker = self._checker
        if checker is not None and not checker.check(frame.data).usable:
            self.refused += 1
            if not checker.trusted:
                self.values = None
            return
        try:
            values = self._receive(frame.data)
        except FrameRefused:
            self.refused += 1
            return
        if self._alive >= 0:
            last, self._last_alive = self._last_alive, values[self._alive]
            if last == self._last_alive:
                self.refused += 1
                return
        self.values = values
        self.stamp_ns = min(frame.stamp_ns, now_ns)
        self.fresh = True

    def age_out(self, now_ns: int) -> bool:
        """Forgets a value past its time-out; True when nothing fresh is known."""
        if self.values is not None and now_ns - self.stamp_ns > self.timeout_ns:
            self.values, self.fresh = None, False
            if self._checker is not None:
                self._checker.reset()
        return self.values is None


class Node:
    """What is known of a CANopen node besides its heartbeat: boots and emergency messages."""

    __slots__ = ("booted", "boots", "emergency", "warning")

    def __init__(self) -> None:
        self.boots = 0
        self.booted = False
        """A boot-up frame came this tick."""
        self.emergency = self.warning = False


class Received:
    """All inputs from crane0: slots, nodes, and what this tick brought; only newest values are kept."""

    def __init__(self, database: Database, profile: Profile) -> None:
        self._slots: dict[int, Slot] = {}

        def slot(name: str, bit: int) -> Slot:
            codec = database.message(name)
            return self._slots.setdefault(codec.key, Slot(codec, bit))

        self.estop, self.guard, self.valve_a, self.valve_b, self.plc, *helpful = (
            slot(name, bit) for name, bit in _BITS.items()
        )
        self.pressures, self.grapple = helpful[:3], helpful[3]
        specs = [joint(profile, j).encoder for j in JOINTS]
        self.encoders = [None if s is None else slot(s.message, ENCODER_BIT + j) for j, s in enumerate(specs)]
        self.needed = [self.estop, self.guard, self.valve_a, self.valve_b, self.plc]
        self.needed += [e for e in self.encoders if e is not None]
        self.encoder_nodes = tuple(s.node for s in specs if s is not None)
        self.nodes = {n: Node() for n in (*SAFETY_NODES, *PRESSURE_NODES, *self.encoder_nodes)}
        self.heartbeats = HeartbeatMonitor(dict.fromkeys(self.nodes, HEARTBEAT_TIMEOUT_NS), 0, 0)
        self._own = frozenset(database.message(name).key for name in _OWN_MESSAGES)
        self._all = tuple(self._slots.values())
        self._communication_ns = [-_COMMUNICATION_WINDOW_NS] * _COMMUNICATION_LIMIT
        self._communication_count = 0
        self.stale_mask = sum(1 << s.bit for s in self._all)
        self.foreign = False
        """One of our own frames came from elsewhere this tick."""
        self.unknown = self.count = 0

    def read(self, frames: list[Frame], now_ns: int, sdo: Callable[[int, bytes], bool]) -> None:
        """Takes the frames of a tick in bus order; ``sdo(key, data)`` says whether it wanted a frame."""
        self.foreign = False
        for slot in self._all:
            slot.fresh = False
        for frame in frames:
            known = self._slots.get(frame.key)
            if known is not None:
                known.take(frame, now_ns)
            elif frame.key in self._own:
                self.foreign = True
            elif not (self._node_frame(frame, now_ns) or sdo(frame.key, frame.data)):
                self.unknown += 1
        self.count += len(frames)
        for number, node in self.nodes.items():
            boots = self.heartbeats.boots[number]
            node.booted, node.boots = boots != node.boots, boots
            if node.booted:
                node.emergency = node.warning = False
        mask = 0
        for slot in self._all:
            if slot.age_out(now_ns):
                mask |= 1 << slot.bit
        self.stale_mask = mask

    def _node_frame(self, frame: Frame, now_ns: int) -> bool:
        """Whether the frame is a heartbeat or emergency message of a node we know."""
        if self.heartbeats.receive(frame.key, frame.data, now_ns):
            return True
        message = parse_emergency(frame.key, frame.data)
        if message is None or message.node not in self.nodes:
            return False
        self._emergency(self.nodes[message.node], message, now_ns)
        return True

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
