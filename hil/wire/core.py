"""One CAN bus in time, without a clock or a socket: arbitration, bit times, error counters, bus-off.

Time is an integer number of ns that only `WireCore.advance` moves.  A frame starts as soon as the bus is idle and a
frame is pending; the arbitration field decides between the pending frames.  Frames submitted at the present time all
take part in the arbitration at that time, in whatever order they were submitted.  Receivers get a frame at its last
bit.

Model (ISO 11898-1): each participant sends its queue in order, like a SocketCAN queue.  A frame without an
acknowledgement or with a failed CRC is destroyed by an error frame and sent again; the transmit error counter rises by
8, the receive counter by 1, and each good frame lowers them by 1.  96 is the warning limit, 128 is error passive (8
bits of pause after an own frame; a missing acknowledgement no longer counts).  Above 255 the node is bus-off, loses its
queue, and restarts `restart_ns` later (0: never).  Error frames reach the receive queue of the node concerned in
SocketCAN's format.  Simplifications: error frames have their minimum length (14 bits); frames with equal arbitration
fields go out one after the other instead of colliding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache, partial
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Final

from can_dbc.bus.base import (
    BITRATES,
    CRANE_BITRATE,
    ERR_ACK,
    ERR_BUSERROR,
    ERR_PROT,
    ERR_RESTARTED,
    MACHINE_BITRATE,
    BusState,
    FilterItem,
    filter_of,
)
from can_dbc.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK, Frame
from hil.wire.faults import Damage, Fault, Kind
from hil.wire.node import Flight, Node, Pending, Segment
from runtime.errors import InputRefused

END_BITS: Final = 10  # CRC delimiter, acknowledge slot and delimiter, end of frame
SPACE_BITS: Final = 3
ERROR_BITS: Final = 2 + 14  # up to the acknowledge slot, then error flag and delimiter
SUSPEND_BITS: Final = 8
RESTART_BITS: Final = 128 * 11  # recessive bits a node counts before it takes part again


class WireCore:
    """One bus (module docstring).  `bitrate` in bit/s must divide 10**9."""

    def __init__(self, bitrate: int, name: str = "wire", restart_ns: int = 100_000_000) -> None:
        if bitrate <= 0 or 1_000_000_000 % bitrate:
            raise InputRefused(
                "wire.bitrate", f"A bit of wire {name} at {bitrate} bit/s is not a whole number of ns long."
            )
        self.name = name
        self.bitrate = bitrate
        self.bit_ns = 1_000_000_000 // bitrate
        self.restart_ns = restart_ns
        self.now_ns = 0
        self.busy_ns = 0
        """Bus time used by frames, error frames and interframe space; the bus load of an interval is the
        growth of this divided by the growth of `now_ns`."""
        self.errors = 0
        """Frames destroyed by an error frame."""
        self.nodes: list[Node] = []
        self._main = Segment()
        self._segments = [self._main]
        self._damage = Damage()
        self._cuts: list[Fault] = []
        self._events: list[tuple[int, int, Callable[[], None], bool]] = []
        self._order = count()
        self._finished: list[tuple[Node, Frame]] = []

    # -- participants

    def attach(
        self,
        name: str,
        *,
        filters: Iterable[FilterItem] | None = None,
        receive_own: bool = False,
        queue_limit: int = 10,
        rx_limit: int = 1024,
    ) -> Node:
        """Add a participant at the present time; `filters` as in `can_dbc.bus.factory.open_bus`."""
        node = Node(name, filter_of(filters), receive_own, queue_limit, rx_limit)
        self.nodes.append(node)
        self._place(node)
        return node

    def detach(self, node: Node) -> None:
        """Remove a participant; its pending frames and the frame it is sending are lost."""
        self.nodes.remove(node)
        node.queue.clear()
        self._leave(node)

    def retire(self, node: Node) -> None:
        """Remove a participant once its pending frames are sent, or at once when nobody acknowledges them; it
        receives nothing more."""
        node.wanted, node.rx_limit, node.retiring = (), 0, True
        if not node.queue or node.tec > 127:
            self.detach(node)

    def submit(self, node: Node, key: int, data: bytes) -> bool:
        """Queue a frame at the present time; False when the queue is full, the node is bus-off, or the frame is
        invalid (more than 8 bytes, an error key)."""
        if len(node.queue) >= node.queue_limit or node.state is BusState.OFF or key & ERROR or len(data) > 8:
            node.refused += 1
            return False
        node.queue.append(Pending(self.now_ns, priority(key), key, data))
        return True

    def restart(self, node: Node) -> None:
        """Restart a node that is bus-off, as ``ip link set can0 type can restart`` does."""
        if node.state is BusState.OFF and node in self.nodes:
            node.tec = node.rec = 0
            node.state = BusState.ACTIVE
            self._place(node)
            node.hold_ns = self.now_ns + RESTART_BITS * self.bit_ns
            self._report(node, self.now_ns, ERR_RESTARTED)

    def inject(self, fault: Fault) -> None:
        """Inject a fault; it acts within its time window, from now on at the earliest."""
        if fault.kind is Kind.CUT:
            self._at(fault.start_ns, lambda: self._cut(fault), of_fault=True)
            self._at(fault.end_ns, lambda: self._repair(fault), of_fault=True)
        elif fault.kind is Kind.BABBLE:
            self._at(fault.start_ns, lambda: self._babble(fault), of_fault=True)
        else:
            self._damage.add(fault)

    def heal(self) -> None:
        """Remove every fault, future ones included."""
        self._damage.clear()
        self._events = [event for event in self._events if not event[3]]
        heapify(self._events)
        for fault in self._cuts[:]:
            self._repair(fault)
        for node in [node for node in self.nodes if node.refill_ns is not None]:
            self.detach(node)

    # -- time

    def advance(self, to_ns: int) -> list[tuple[Node, Frame]]:
        """Advance to `to_ns`; return (sender, frame) of every completed frame, in order.

        Frames may start before `to_ns`, not at it.

        Raises:
            InputRefused: `to_ns` lies in the past.
        """
        if to_ns < self.now_ns:
            raise InputRefused(
                "wire.time-reversed", f"Wire {self.name} is at {self.now_ns} ns and cannot go back to {to_ns} ns."
            )
        while True:
            for segment in self._segments[:]:
                self._run(segment, to_ns)
            if not self._events or self._events[0][0] > to_ns:
                break
            at_ns, _, action, _ = heappop(self._events)
            self.now_ns = max(self.now_ns, at_ns)
            action()
        self.now_ns = to_ns
        finished, self._finished = self._finished, []
        return finished

    def next_ns(self) -> int | None:
        """Return the time of the next event if nobody submits anything; None for never."""
        times = [event[0] for event in self._events[:1]]
        for segment in self._segments:
            if segment.flight:
                times.append(segment.flight.end_ns)
            elif len(segment.nodes) != 1 or segment.nodes[0].tec < 128:  # else it retries for ever
                times.extend(node.ready_ns(segment) + 1 for node in segment.nodes if node.queue)
        return min(times, default=None)

    def _at(self, at_ns: int, action: Callable[[], None], of_fault: bool = False) -> None:
        heappush(self._events, (max(at_ns, self.now_ns), next(self._order), action, of_fault))

    # -- the bus

    def _run(self, segment: Segment, to_ns: int) -> None:
        """Run one segment up to `to_ns` or to the next event, which it may have scheduled itself."""
        events = self._events
        while True:
            limit_ns = events[0][0] if events and events[0][0] < to_ns else to_ns
            flight = segment.flight
            if flight is not None:
                if flight.end_ns > limit_ns:
                    return
                segment.flight = None
                self._finish(segment, flight)
                continue
            start_ns = limit_ns
            winner = None
            for node in segment.nodes:
                if node.queue:
                    ready_ns = node.ready_ns(segment)
                    if ready_ns < start_ns or (
                        ready_ns == start_ns and winner and node.queue[0].priority < winner.queue[0].priority
                    ):
                        start_ns, winner = ready_ns, node
            if winner is None:
                return
            self._start(segment, winner, start_ns, limit_ns)

    def _start(self, segment: Segment, sender: Node, start_ns: int, limit_ns: int) -> None:
        frame = sender.queue[0]
        alone = len(segment.nodes) == 1
        fate = None
        if self._damage:
            fate = self._damage.fate(start_ns, sender.name, frame.key, frame.data)
        destroyed = alone or (fate is not None and fate.error)
        bits = frame_bits(frame.key, frame.data) + (ERROR_BITS if destroyed else END_BITS)
        if alone and sender.tec > 127:
            # Every retry is the same: compute all that fit in one step.
            period_ns = (bits + SPACE_BITS + SUSPEND_BITS) * self.bit_ns
            retries = max(1, (limit_ns - start_ns) // period_ns)
            self.errors += retries
            sender.hold_ns = start_ns + retries * period_ns
            if segment is self._main:
                self.busy_ns += retries * (bits + SPACE_BITS) * self.bit_ns
            return
        end_ns = start_ns + bits * self.bit_ns
        segment.free_ns = end_ns + SPACE_BITS * self.bit_ns
        if segment is self._main:
            self.busy_ns += segment.free_ns - start_ns
        segment.flight = Flight(end_ns, sender, frame, alone, fate)

    def _finish(self, segment: Segment, flight: Flight) -> None:
        end_ns, sender, frame, alone, fate = flight
        if alone or (fate is not None and fate.error):
            self._destroy(segment, flight)
        else:
            sender.queue.popleft()
            sender.done += 1
            if sender.refill_ns is not None:
                sender.queue.append(frame._replace(ready_ns=end_ns + sender.refill_ns))
            for node in segment.nodes:
                if node is sender:
                    if node.tec:
                        node.tec -= 1
                        self._report(node, end_ns)
                elif node.rec:
                    node.rec = min(node.rec - 1, 127)
                    self._report(node, end_ns)
            if fate is None:
                self._deliver(segment, sender, Frame(end_ns, frame.key, frame.data))
            else:
                for offset_ns in fate.offsets_ns:
                    late = Frame(end_ns + offset_ns, frame.key, fate.data)
                    self._at(late.stamp_ns, partial(self._deliver, segment, sender, late))
        if sender.tec > 127:
            sender.hold_ns = segment.free_ns + SUSPEND_BITS * self.bit_ns
        if sender.retiring and (not sender.queue or sender.tec > 127):
            self.detach(sender)

    def _deliver(self, segment: Segment, sender: Node, frame: Frame) -> None:
        self._finished.append((sender, frame))
        key = frame.key
        for node in segment.nodes:
            if (node is sender and not node.receive_own) or (node.wanted is not None and key not in node.wanted):
                continue
            node.receive(frame)

    # -- errors

    def _destroy(self, segment: Segment, flight: Flight) -> None:
        """Let every node of the segment detect the error; the frame stays at the head of its queue."""
        self.errors += 1
        for node in tuple(segment.nodes):
            if node is flight.sender:
                node.tec += 8
                kind = ERR_ACK if flight.alone else 0
                self._report(node, flight.end_ns, kind | ERR_PROT | ERR_BUSERROR, transmitter=True)
            else:
                node.rec = min(node.rec + 1, 255)
                self._report(node, flight.end_ns, ERR_PROT | ERR_BUSERROR)

    def _report(self, node: Node, at_ns: int, classes: int = 0, transmitter: bool = False) -> None:
        """Update the state from the counters, and report the error and a change of state to the node."""
        state = node.confinement()
        changed = state is not node.state
        node.state = state
        if changed and state is BusState.OFF:
            self._switch_off(node, at_ns)
        if changed or classes:
            node.receive(node.error_frame(at_ns, classes, changed, transmitter))

    def _switch_off(self, node: Node, at_ns: int) -> None:
        node.done += len(node.queue)
        node.queue.clear()
        self._leave(node)
        if self.restart_ns:
            self._at(at_ns + self.restart_ns, lambda: self.restart(node))

    # -- cable

    def _place(self, node: Node) -> None:
        """Connect a node to the segment that it belongs to now."""
        if node.state is BusState.OFF:
            return
        cut = any(fault.node in (None, node.name) for fault in self._cuts)
        current_segment = node.segment
        if current_segment is None or cut is (current_segment is self._main):
            self._leave(node)
            node.hold_ns = max(node.hold_ns, self.now_ns)  # waiting frames start now, not in the past
            node.segment = Segment() if cut else self._main
            node.segment.nodes.append(node)
            if cut:
                self._segments.append(node.segment)

    def _leave(self, node: Node) -> None:
        """Disconnect a node from its segment; a frame that it is sending is aborted."""
        segment, node.segment = node.segment, None
        if segment is None:
            return
        segment.nodes.remove(node)
        if segment.flight is not None and segment.flight.sender is node:
            segment.flight = None
        if segment is not self._main:
            self._segments.remove(segment)

    def _cut(self, fault: Fault) -> None:
        self._cuts.append(fault)
        for node in self.nodes:
            self._place(node)

    def _repair(self, fault: Fault) -> None:
        if fault in self._cuts:
            self._cuts.remove(fault)
            for node in self.nodes:
                self._place(node)

    def _babble(self, fault: Fault) -> None:
        node = self.attach(fault.node or "babble", queue_limit=1, rx_limit=0)
        node.refill_ns = fault.shift_ns
        self.submit(node, fault.key, fault.data)
        self._at(fault.end_ns, lambda: self.detach(node), of_fault=True)


# -- Exact length of a classical CAN frame on the bus, stuff bits included (ISO 11898-1, 10.4 and 10.5).
#
# The bits from start of frame to the last CRC bit are stuffed: after five equal bits a complementary one is
# inserted, which itself counts towards the next five.  Both the CRC-15 and the stuffing are run eight bits at a
# time from tables; the header of a key and length is computed once and cached.

CRC_POLYNOMIAL: Final = 0x4599
_START: Final = 5  # states 0..3: a run of one to four dominant bits; 5..8: of recessive bits (the idle bus)


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return table


def _stuff(state: int, bits: int, count: int) -> tuple[int, int]:
    """Process `count` bits of `bits`, most significant first; return (state, stuff bits inserted)."""
    inserted = 0
    for shift in range(count - 1, -1, -1):
        level = 5 * (bits >> shift & 1)
        run = state - level + 1 if 0 <= state - level < 4 else 0
        state = level + run
        if run == 4:
            inserted += 1
            state = 5 - level
    return state, inserted


def _stuff_table(count: int) -> list[list[tuple[int, int]]]:
    return [[_stuff(state, bits, count) for bits in range(1 << count)] for state in range(10)]


_CRC: Final = _crc_table()
_STUFF8: Final = _stuff_table(8)
_STUFF7: Final = _stuff_table(7)


@lru_cache(maxsize=4096)
def _header(key: int, length: int) -> tuple[int, int, int, int]:
    """Compute CRC, stuffing state, stuff bits and bit count after start of frame, arbitration and control field."""
    remote = 1 if key & REMOTE else 0
    if key & EXTENDED:
        identifier = key & EXTENDED_MASK
        bits = (identifier >> 18) << 27 | 0b11 << 25 | (identifier & 0x3FFFF) << 7 | remote << 6 | length
        count = 39
    else:
        bits = (key & STANDARD_MASK) << 7 | remote << 6 | length
        count = 19
    crc = 0
    for shift in range(32, -8, -8):  # leading zeros leave the CRC at zero
        crc = (crc << 8) & 0x7FFF ^ _CRC[(crc >> 7) ^ (bits >> shift & 0xFF)]
    state, inserted = _stuff(_START, bits, count)
    return crc, state, inserted, count


def frame_bits(key: int, data: bytes) -> int:
    """Count the bits from start of frame to the last CRC bit with its stuff bits; 10 more end the frame (CRC
    delimiter, acknowledge slot and delimiter, end of frame) and 3 separate it from the next."""
    crc, state, inserted, count = _header(key, len(data))
    if not key & REMOTE:
        for byte in data:
            crc = (crc << 8) & 0x7FFF ^ _CRC[(crc >> 7) ^ byte]
            state, more = _STUFF8[state][byte]
            inserted += more
        count += 8 * len(data)
    state, more = _STUFF8[state][crc >> 7]
    return count + 15 + inserted + more + _STUFF7[state][crc & 0x7F][1]


def priority(key: int) -> int:
    """Return the arbitration field as a number: the lowest wins the bus.  A standard frame wins over an extended
    one with the same leading 11 bits, and a data frame over its remote frame."""
    remote = 1 if key & REMOTE else 0
    if key & EXTENDED:
        identifier = key & EXTENDED_MASK
        return (identifier >> 18) << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | remote
    return (key & STANDARD_MASK) << 21 | remote << 20


# -- The bit rates of the machine's two buses, as the wire runs them (`can_dbc.bus.base`).

__all__ = ["BITRATES", "CRANE_BITRATE", "MACHINE_BITRATE"]
