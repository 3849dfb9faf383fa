"""The state of one participant of the wire, and the cable segments that connect participants."""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from typing import Final, NamedTuple

from can_dbc.bus.base import (
    CRTL_ACTIVE,
    CRTL_PASSIVE,
    CRTL_WARNING,
    ERR_ACK,
    ERR_BUSOFF,
    ERR_CNT,
    ERR_CRTL,
    ERR_PROT,
    BusState,
)
from can_dbc.frame import ERROR, Frame
from hil.wire.faults import Fate

# Bytes 1 to 3 of an error frame (linux/can/error.h).
_CRTL_RECEIVER: Final = 0x14
_CRTL_TRANSMITTER: Final = 0x28
_PROT_TX: Final = 0x80
_LOC_ACK: Final = 0x19
_LOC_CRC: Final = 0x08


class Pending(NamedTuple):
    """A frame in a transmit queue; it takes part in arbitration from `ready_ns`."""

    ready_ns: int
    priority: int
    key: int
    data: bytes


class Flight(NamedTuple):
    """The frame on the bus, or its error frame, up to its last bit."""

    end_ns: int
    sender: Node
    frame: Pending
    alone: bool
    fate: Fate | None


class Node:
    """One participant: its queues, counters and error state; only the core changes it."""

    __slots__ = (
        "done",
        "dropped",
        "hold_ns",
        "name",
        "queue",
        "queue_limit",
        "rec",
        "receive_own",
        "refill_ns",
        "refused",
        "retiring",
        "rx",
        "rx_limit",
        "segment",
        "state",
        "tec",
        "wanted",
    )

    def __init__(
        self, name: str, wanted: Container[int] | None, receive_own: bool, queue_limit: int, rx_limit: int
    ) -> None:
        self.name = name
        self.wanted = wanted
        self.receive_own = receive_own
        self.queue: deque[Pending] = deque()
        self.queue_limit = queue_limit
        self.rx: list[Frame] = []
        self.rx_limit = rx_limit
        self.hold_ns = 0  # no frame starts before this time
        self.refill_ns: int | None = None  # of a babbling node: pause before it sends the same frame again
        self.retiring = False
        self.tec = self.rec = 0
        self.state = BusState.ACTIVE
        self.segment: Segment | None = None
        self.done = self.dropped = self.refused = 0

    def take(self) -> list[Frame]:
        """Empty the receive queue."""
        taken, self.rx = self.rx, []
        return taken

    def discard(self) -> None:
        """Empty the transmit queue, except for the frame on the bus."""
        flight = self.segment.flight if self.segment else None
        in_flight_count = 1 if flight is not None and flight.sender is self else 0
        self.done += len(self.queue) - in_flight_count
        while len(self.queue) > in_flight_count:
            self.queue.pop()

    def receive(self, frame: Frame) -> None:
        """Put a frame into the receive queue, or count it as dropped."""
        if len(self.rx) < self.rx_limit:
            self.rx.append(frame)
        else:
            self.dropped += 1

    def ready_ns(self, segment: Segment) -> int:
        """Return the earliest time at which the head of the transmit queue may start."""
        return max(self.queue[0].ready_ns, self.hold_ns, segment.free_ns)

    def confinement(self) -> BusState:
        """Return the fault confinement state for the present error counters (ISO 11898-1)."""
        if self.tec > 255:
            return BusState.OFF
        worst = max(self.tec, self.rec)
        return BusState.PASSIVE if worst > 127 else BusState.WARNING if worst > 95 else BusState.ACTIVE

    def error_frame(self, at_ns: int, classes: int, changed: bool, transmitter: bool) -> Frame:
        """Make SocketCAN's error frame for an error of these classes and, if `changed`, for the new state."""
        flags = 0
        if changed and self.state is BusState.OFF:
            classes |= ERR_BUSOFF
        elif changed:
            classes |= ERR_CRTL
            side = _CRTL_TRANSMITTER if self.tec >= self.rec else _CRTL_RECEIVER
            flags = (CRTL_ACTIVE, CRTL_WARNING & side, CRTL_PASSIVE & side)[self.state]
        error_location = 0
        if classes & ERR_PROT:
            error_location = _LOC_ACK if classes & ERR_ACK else _LOC_CRC
        direction = _PROT_TX if transmitter else 0
        data = bytes((0, flags, direction, error_location, 0, 0, min(self.tec, 255), self.rec))
        return Frame(at_ns, ERROR | ERR_CNT | classes, data)


class Segment:
    """A cable segment and its nodes: the whole bus, or one node behind an open cable."""

    __slots__ = ("flight", "free_ns", "nodes")

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.free_ns = 0
        self.flight: Flight | None = None
