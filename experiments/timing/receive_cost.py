"""Benchmark: cost of receiving a frame along every path, measured alternately in one run.

Every path gets the crane0 traffic of one tick outside the clock, then receives and decodes it as the controller
does (E2E check, `MessageCodec.receive`), on the clock of the process's own CPU time.  If the kernel has CAN, the
frames travel over an interface.  If it has none, an AF_UNIX datagram pair carries the same struct can_frame with the
same time stamps, and the code on top is the same: ours (`can_dbc.bus.frame_socket`) as python-can's (its `SocketcanBus`
with that socket in place of its own); ``pythoncan_bus`` is python-can behind the contract of a `Bus`, as every process
has it with ``--bus python-can:socketcan:can0``.  Results are medians over rounds, in microseconds per frame.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import random
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

import can
from can.interfaces.socketcan import SocketcanBus

from can_dbc.bus.base import DRAIN_LIMIT, BusStats
from can_dbc.bus.factory import PYTHON_CAN, kernel_has_can, open_bus
from can_dbc.bus.frame_socket import CAN_FRAME, FrameSocket
from can_dbc.bus.python_can_bus import PythonCanBus
from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.frame import Frame, RawFrame
from can_dbc.protocols.e2e import Checker, Sender
from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused

DRAIN_FRAMES: Final = 14
"""Frames per drain: those that arrive on crane0 during a tick at 200 Hz."""
TICK_NS: Final = 5_000_000
LIMIT_US: Final = 5.0
"""Limit for receive, check and decode of one frame on an ordinary host."""
QUIET_S: Final = 0.1
"""A kernel interface is used only if nothing was received on it for this time."""
_SO_TIMESTAMPNS: Final = 35
Clock = Callable[[], int]
Send = Callable[[list[RawFrame]], None]


def traffic(database: Database) -> Iterator[RawFrame]:
    """Make the frames that the controller receives on crane0, by cycle time: valid values, running E2E counters."""
    rng = random.Random(1)
    received = [c for c in database.messages.values() if c.cycle_time_ns and "CTRL" not in c.senders]
    messages = [(c, _payload(c, rng), Sender(c.data_ids) if c.data_ids else None) for c in received]
    for now_ns in itertools.count(0, TICK_NS):
        for codec, payload, sender in messages:
            if now_ns % codec.cycle_time_ns == 0:
                yield codec.key, sender.protect(payload) if sender else payload


class Reader:
    """Checks and decodes frames by key, as `controller.crane.inputs` does; ``accepted`` counts the good frames."""

    def __init__(self, database: Database) -> None:
        by_key = database.by_key.items()
        self._slots = {key: (Checker(c.data_ids) if c.data_ids else None, c.receive) for key, c in by_key}
        self.accepted = 0

    def read(self, frames: Sequence[Frame]) -> None:
        """Check and decode frames."""
        for _, key, data in frames:
            checker, receive = self._slots[key]
            if checker is None or checker.check(data).usable:
                receive(data)
                self.accepted += 1

    def read_messages(self, messages: Sequence[can.Message]) -> None:
        """Check and decode python-can's messages in the same way."""
        for message in messages:
            checker, receive = self._slots[message.arbitration_id]
            data = bytes(message.data)
            if checker is None or checker.check(data).usable:
                receive(data)
                self.accepted += 1


@dataclass(frozen=True, slots=True)
class Lane:
    """One path: ``send`` queues frames (not timed), ``drain`` receives all of them into a list."""

    name: str
    label: str
    send: Send
    drain: Callable[[list[Any]], object]
    messages: bool = False


def measure(frames: int, rounds: int) -> dict[str, Any]:
    """Measure every available path alternately, in rounds of ``frames`` frames each.

    ``metrics``: ``rx_us`` and ``rx_decode_us`` of the fast path, the same of python-can's, and ``rx_decode_ratio``,
    its cost by ours.  ``lab``: in user-mode Linux, where a system call costs a hundred times as much, only the ratio
    is meaningful.  Raises `CommandFailed` when the bus is in use.
    """
    database = load("crane")
    clock, clock_name = _clock()
    samples: dict[str, list[float]] = {}
    with contextlib.ExitStack() as stack:
        lanes = _lanes(stack)
        time.sleep(QUIET_S)
        for lane in lanes:
            if _discard(lane):
                raise CommandFailed(
                    "receive-cost.bus-in-use",
                    f"{lane.label}: the bus is in use; stop what runs on it, then measure.",
                    ExitCode.BUS,
                )
        supply = {lane.name: traffic(database) for lane in lanes}
        readers = {lane.name: Reader(database) for lane in lanes}
        gc.collect()
        gc.disable()
        stack.callback(gc.enable)
        for _ in range(rounds):
            for lane in lanes:
                rx_ns, decode_ns = _round(lane, supply[lane.name], readers[lane.name], frames, clock)
                samples.setdefault(f"rx_{lane.name}_us", []).append(rx_ns / frames / 1000)
                samples.setdefault(f"rx_decode_{lane.name}_us", []).append((rx_ns + decode_ns) / frames / 1000)
    for name, reader in readers.items():
        if reader.accepted < rounds * frames - 200:  # the first frame of each stream only initializes its counter
            raise InputRefused(
                "experiment.frames-rejected", f"path {name} accepted {reader.accepted} of {rounds * frames} frames"
            )
    metrics = {name.replace("_ours", ""): median(values) for name, values in samples.items()}
    metrics["rx_decode_ratio"] = metrics["rx_decode_pythoncan_us"] / metrics["rx_decode_us"]
    return {
        "frames": frames,
        "rounds": rounds,
        "clock": clock_name,
        "lab": os.environ.get("TIMBERHAND_LAB") == "uml",
        "paths": {lane.name: lane.label for lane in lanes},
        "limit_us": LIMIT_US,
        "metrics": metrics,
    }


def _round(lane: Lane, supply: Iterator[RawFrame], reader: Reader, frames: int, clock: Clock) -> tuple[int, int]:
    """Measure the time [ns] of receiving, and of checking and decoding, for one round."""
    _discard(lane)  # on an interface every socket received the frames of the other paths
    read = reader.read_messages if lane.messages else reader.read
    rx_ns = decode_ns = 0
    for start in range(0, frames, DRAIN_FRAMES):
        frame_count = min(DRAIN_FRAMES, frames - start)
        lane.send(list(itertools.islice(supply, frame_count)))
        received: list[Any] = []
        begin_ns = clock()
        lane.drain(received)
        middle_ns = clock()
        read(received)
        decode_ns += clock() - middle_ns
        rx_ns += middle_ns - begin_ns
        if len(received) != frame_count:
            raise CommandFailed(
                "receive-cost.frames-missing",
                f"{lane.label} gave {len(received)} of {frame_count} frames; is anybody else sending?",
                ExitCode.BUS,
            )
    return rx_ns, decode_ns


def _discard(lane: Lane) -> int:
    """Receive and discard all waiting frames; returns their number."""
    scrap: list[Any] = []
    last = -1
    while len(scrap) > last:
        last = len(scrap)
        lane.drain(scrap)
    return last


def _lanes(stack: contextlib.ExitStack) -> tuple[Lane, ...]:
    """Open every path of this machine: ours, python-can's, python-can as a bus."""
    present = {name for _, name in socket.if_nameindex()} & {"vcan0", "vcan1"} if kernel_has_can() else ()
    return _on_interface(min(present), stack) if present else _on_pairs(stack)


def _on_interface(interface: str, stack: contextlib.ExitStack) -> tuple[Lane, ...]:
    """Open ours and python-can's on a virtual kernel CAN interface."""
    sender = stack.enter_context(open_bus(f"socketcan:{interface}", filters=[]))
    ours = stack.enter_context(open_bus(f"socketcan:{interface}"))
    theirs = stack.enter_context(can.Bus(interface="socketcan", channel=interface))
    bus = stack.enter_context(open_bus(f"{PYTHON_CAN}socketcan:{interface}"))

    def send(frames: list[RawFrame]) -> None:
        if sender.send_all(frames) != len(frames):
            raise CommandFailed(
                "receive-cost.interface-blocked", "The interface takes no frames; see `ip link`.", ExitCode.BUS
            )

    return (
        Lane("ours", f"ours on {interface}", send, ours.drain),
        Lane("pythoncan", f"python-can on {interface}", send, _recv_all(theirs), True),
        Lane("pythoncan_bus", f"--bus {PYTHON_CAN}socketcan:{interface}", send, bus.drain),
    )


class _OnPair(SocketcanBus):
    """python-can's own receive path on a given socket."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.socket, self.channel = sock, "pair"
        self._is_filtered = self._is_shutdown = True


def _on_pairs(stack: contextlib.ExitStack) -> tuple[Lane, ...]:
    """Open ours, python-can's and python-can as a bus, each on an AF_UNIX datagram pair."""

    def pair() -> tuple[socket.socket, Send]:
        near, far = map(stack.enter_context, socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM))

        def send(frames: list[RawFrame]) -> None:
            for key, data in frames:
                far.send(CAN_FRAME.pack(key, len(data), data))

        return near, send

    (ours, to_ours), (theirs, to_theirs), (behind, to_behind) = pair(), pair(), pair()
    link, stats = FrameSocket(ours), BusStats()

    class BusOnPair(PythonCanBus):
        def _open(self) -> can.BusABC:
            return _OnPair(behind)

    def drain(frames: list[Any]) -> None:
        link.receive(frames, DRAIN_LIMIT, stats.note_error)

    return (
        Lane("ours", "ours on an AF_UNIX pair", to_ours, drain),
        Lane("pythoncan", "python-can on an AF_UNIX pair", to_theirs, _recv_all(_OnPair(theirs)), True),
        Lane(
            "pythoncan_bus", "--bus python-can:... on an AF_UNIX pair", to_behind, BusOnPair("socketcan", "pair").drain
        ),
    )


def _recv_all(bus: can.BusABC) -> Callable[[list[Any]], object]:
    def drain(messages: list[Any]) -> None:
        while (message := bus.recv(timeout=0)) is not None:
            messages.append(message)

    return drain


def _payload(codec: MessageCodec, rng: random.Random) -> bytes:
    """Make the payload of the message with every value in range and available."""
    ranges = [(s.physical(s.raw_low), s.physical(s.raw_high)) for s in codec.signals]
    while True:
        payload = codec.encode(*(low + (high - low) * rng.random() for low, high in ranges))
        if None not in codec.receive(payload):
            return payload


def _clock() -> tuple[Clock, str]:
    """Return this thread's CPU time; wall time where the kernel counts CPU time in ticks, as user-mode Linux does."""
    begin_ns = time.thread_time_ns()
    deadline_ns = time.perf_counter_ns() + 1_000_000
    while time.perf_counter_ns() < deadline_ns:
        pass
    if 500_000 < time.thread_time_ns() - begin_ns < 2_000_000:
        return time.thread_time_ns, "CPU time"
    return time.perf_counter_ns, "wall time"
