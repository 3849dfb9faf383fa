"""The guard's own socket: frames, their times, error frames, and a link that goes and comes; on any kernel.

A pair of AF_UNIX sockets carries the same struct can_frame; the options that only a CAN socket knows are noted.  The
real interface is in tests/live/vcan.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from can_dbc.bus.base import BusState
from can_dbc.frame import EXTENDED, REMOTE, Frame
from controller.guard import __main__ as process
from controller.guard import can_socket
from controller.guard.can_socket import MOST_FRAMES, GuardSocket
from runtime.errors import LinkError
from tests.codes import coded

FRAME = struct.Struct("=IB3x8s")
ERROR = 0x2000_0000
UP, RUNNING = 0x1, 0x40
MS = 1_000_000
STAMP = struct.Struct("@qq")
SO_TIMESTAMPNS = 35
KEYS = (0x181, 0x18F0_0400 | EXTENDED, (0x0CFF_2300 | EXTENDED, 0x00FF_FF00))


class Clock:
    """The two clocks of a computer; they move when a test says so."""

    def __init__(self) -> None:
        self.now_ns, self.ahead_ns = 10**12, 17 * 10**17

    def monotonic_ns(self) -> int:
        return self.now_ns

    def time_ns(self) -> int:
        return self.now_ns + self.ahead_ns


class Kernel:
    """Gives out sockets whose far ends the test holds, and notes when a frame came."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.came_ns: list[int] = []
        self.flags, self.refuses = UP | RUNNING, 0
        self.far: socket.socket | None = None
        self.options: dict[tuple[int, int], int | bytes] = {}
        self.links: list[Link] = []
        self.bound: list[str] = []

    @property
    def opened(self) -> int:
        return len(self.links)

    def socket(self, family: int, kind: int, protocol: int) -> Link:
        assert (family, kind, protocol) == (socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.links.append(Link(self, near))
        return self.links[-1]

    def ioctl(self, _link: Link, request: int, asked: bytes) -> bytes:
        assert request == 0x8913
        if self.refuses:
            raise OSError(self.refuses, "No such device")
        return asked[:16] + struct.pack("H14x", self.flags)

    def send(self, key: int, data: bytes = b"", length: int | None = None) -> None:
        assert self.far is not None
        self.far.send(FRAME.pack(key, len(data) if length is None else length, data))
        self.came_ns.append(self.clock.time_ns())

    def error(self, key: int, flags: int = 0) -> None:
        self.send(ERROR | key, bytes((0, flags, 0, 0, 0, 0, 0, 0)))


class Link:
    """One socket of the kernel."""

    def __init__(self, kernel: Kernel, near: socket.socket) -> None:
        self.kernel, self.near = kernel, near
        self.fails, self.stamps = 0, True
        """``stamps``: the kernel tells when a frame came; else only ``told`` is."""
        self.told: list[tuple[int, int, bytes]] = []

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:
        self.kernel.options[level, option] = value
        if level == socket.SOL_SOCKET and option != SO_TIMESTAMPNS:
            self.near.setsockopt(level, option, value)

    def bind(self, address: tuple[str]) -> None:
        self.kernel.bound += address

    def send(self, datagram: bytes) -> int:
        if self.fails:
            raise OSError(self.fails, "no")
        return self.near.send(datagram)

    def recvmsg(self, size: int, control: int) -> tuple:
        if self.fails:
            raise OSError(self.fails, "no")
        datagram, _, flags, address = self.near.recvmsg(size, control)
        came = STAMP.pack(*divmod(self.kernel.came_ns.pop(0), 10**9))
        told = [(socket.SOL_SOCKET, SO_TIMESTAMPNS, came)] if self.stamps else []
        return datagram, [*self.told, *told], flags, address

    def __getattr__(self, name: str):
        return getattr(self.near, name)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    made = Kernel()
    monkeypatch.setattr(can_socket, "socket", SimpleNamespace(**{**vars(socket), "socket": made.socket}))
    monkeypatch.setattr(can_socket, "fcntl", SimpleNamespace(ioctl=made.ioctl))
    monkeypatch.setattr(can_socket, "time", made.clock)
    return made


@pytest.fixture
def bus(kernel: Kernel) -> Iterator[GuardSocket]:
    with GuardSocket("can0", KEYS) as made:
        yield made


def drained(bus: GuardSocket) -> list[Frame]:
    frames: list[Frame] = []
    assert bus.drain(frames) == len(frames)
    return frames


def test_frames_go_both_ways_with_their_length_and_their_time(kernel: Kernel, bus: GuardSocket) -> None:
    kernel.clock.now_ns += MS
    came_ns = kernel.clock.now_ns
    kernel.send(0x181, b"abc")
    kernel.clock.now_ns += 100 * MS
    kernel.send(0x18F0_0400 | EXTENDED, b"12345678")
    assert select.select([bus.fileno()], [], [], 1.0)[0]
    first, second = drained(bus)
    assert first[1:] == (0x181, b"abc") and second[1:] == (0x18F0_0400 | EXTENDED, b"12345678")
    kernel.clock.now_ns += MS
    assert first.stamp_ns == came_ns, "the kernel's time, not that of the look"
    assert second.stamp_ns == came_ns + 100 * MS
    assert bus.send_all([(0x77F, b"\x05"), (0x381, b"")]) == 2 and bus.send(0x1, b"x")
    assert kernel.far is not None
    assert [FRAME.unpack(kernel.far.recv(16))[:2] for _ in range(3)] == [(0x77F, 1), (0x381, 0), (0x1, 1)]
    assert (bus.stats.received, bus.stats.sent, bus.stats.refused, bus.discard()) == (2, 3, 0, 0)


def test_only_the_watched_identifiers_and_all_error_frames_are_asked_for(kernel: Kernel) -> None:
    GuardSocket("can0", KEYS).close()
    kind = EXTENDED | REMOTE
    wanted = [(0x181, 0x1FFF_FFFF | kind), (KEYS[1], 0x1FFF_FFFF | kind), (KEYS[2][0], 0x00FF_FF00 | kind)]
    packed = b"".join(struct.pack("=II", key & (mask | kind), mask) for key, mask in wanted)
    assert kernel.options[socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER] == packed
    assert kernel.options[socket.SOL_CAN_RAW, 2] == 0x1FFF_FFFF
    assert kernel.options[socket.SOL_SOCKET, 35] == 1, "SO_TIMESTAMPNS"
    assert kernel.options[socket.SOL_SOCKET, socket.SO_RCVBUF] == 1 << 20
    assert kernel.bound == ["can0"]


def test_leaving_the_bus_closes_the_socket(kernel: Kernel) -> None:
    with GuardSocket("can0", KEYS) as bus:
        assert bus.fileno() > 0
    assert bus.fileno() == -1 and kernel.links[0].near.fileno() == -1


def test_frames_are_added_to_those_that_are_there_and_only_they_are_counted(kernel: Kernel, bus: GuardSocket) -> None:
    frames = [Frame(1, 0x7, b""), Frame(2, 0x8, b"")]
    kernel.send(0x181, b"a")
    assert bus.drain(frames) == 1 and len(frames) == 3 and bus.stats.received == 1


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_step_of_the_wall_clock_moves_no_time_by_more_than_one_look(
    kernel: Kernel, bus: GuardSocket, step_s: float
) -> None:
    drained(bus)
    looked_ns = kernel.clock.now_ns
    kernel.clock.now_ns += MS
    kernel.send(0x181, b"a")
    kernel.clock.ahead_ns += round(step_s * 1e9)
    kernel.clock.now_ns += MS
    (frame,) = drained(bus)
    assert looked_ns <= frame.stamp_ns <= kernel.clock.now_ns


def test_the_clocks_are_read_again_after_a_pause_between_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monotonic = iter((0, 5_000_000, 6_000_000, 6_000_100))
    walls = iter((1_000_000_000, 1_006_000_050))
    stepped = SimpleNamespace(monotonic_ns=lambda: next(monotonic), time_ns=lambda: next(walls))
    monkeypatch.setattr(can_socket, "time", stepped)
    assert can_socket._clocks() == (6_000_100, 6_000_100 - 1_006_000_050)
    limit = iter((0, 100_000, 200_000, 200_001))
    monkeypatch.setattr(can_socket, "time", SimpleNamespace(monotonic_ns=lambda: next(limit), time_ns=lambda: 7))
    assert can_socket._clocks() == (200_001, 200_001 - 7), "0.1 ms is a pause already"
    always = iter(range(0, 100_000_000, 1_000_000))
    monkeypatch.setattr(can_socket, "time", SimpleNamespace(monotonic_ns=lambda: next(always), time_ns=lambda: 7))
    assert can_socket._clocks() == (5_000_000, 5_000_000 - 7), "a machine that is never quiet gets the last reading"


def test_error_frames_change_the_state_and_never_arrive(kernel: Kernel, bus: GuardSocket) -> None:
    for flags, state in ((0x08, BusState.WARNING), (0x20, BusState.PASSIVE), (0x40, BusState.ACTIVE)):
        kernel.error(0x04, flags)
        assert drained(bus) == [] and bus.stats.state is state
    kernel.send(0x181, b"before")
    kernel.error(0x02, 0x20)
    assert [f.data for f in drained(bus)] == [b"before"], "an error of a single frame takes nothing else"
    assert bus.stats.state is BusState.ACTIVE and bus.stats.error_frames == 4
    kernel.error(0x40)
    kernel.error(0x04, 0x40)
    drained(bus)
    assert bus.stats.state is BusState.OFF, "only a restart ends it"
    assert bus.send_all([(1, b"")]) == 0 and bus.stats.refused == 1
    assert not bus.reopen(), "the kernel restarts the node"
    kernel.send(0x181, b"old")
    kernel.error(0x100)
    kernel.send(0x181, b"new")
    assert [f.data for f in drained(bus)] == [b"new"]
    assert bus.stats.state is BusState.ACTIVE and bus.stats.recoveries == 1 and bus.reopen()


def test_a_flooded_bus_does_not_hold_the_guard_up_and_is_flushed(kernel: Kernel, bus: GuardSocket) -> None:
    assert kernel.far is not None
    kernel.far.setblocking(False)
    count = 0
    waiting: list[Frame] = []
    for _ in range(3):
        with pytest.raises(BlockingIOError):
            while True:
                kernel.send(0x181)
                count += 1
        bus.drain(waiting)
    assert 0 < len(waiting) <= min(count, 3 * MOST_FRAMES)
    bus.flush()
    assert drained(bus) == []


def test_one_look_reads_a_bounded_number_of_frames(
    kernel: Kernel, bus: GuardSocket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_socket, "MOST_FRAMES", 3)
    for k in range(7):
        kernel.send(0x181, bytes((k,)))
    assert [f.data[0] for f in drained(bus)] == [0, 1, 2]
    bus.flush()
    assert drained(bus) == []


def test_other_words_of_the_kernel_about_a_frame_are_no_time(kernel: Kernel, bus: GuardSocket) -> None:
    bus._socket.told = [(socket.SOL_SOCKET, 40, bytes(4)), (socket.SOL_CAN_RAW, 35, bytes(16))]
    kernel.clock.now_ns += MS
    came_ns = kernel.clock.now_ns
    kernel.send(0x181, b"a")
    kernel.clock.now_ns += MS
    (frame,) = drained(bus)
    assert frame.stamp_ns == came_ns


def test_without_a_time_of_the_kernel_a_frame_has_that_of_the_look(kernel: Kernel, bus: GuardSocket) -> None:
    link = kernel.links[0]
    link.stamps, link.told = False, [(socket.SOL_SOCKET, 40, bytes(4)), (socket.SOL_CAN_RAW, 35, bytes(16))]
    kernel.send(0x181, b"a")
    kernel.clock.now_ns += 2 * MS
    (frame,) = drained(bus)
    assert frame.stamp_ns == kernel.clock.now_ns


def test_no_frame_is_older_than_the_last_look_or_the_opening(kernel: Kernel, bus: GuardSocket) -> None:
    def old(link: Link) -> None:
        link.stamps, link.told = False, [(socket.SOL_SOCKET, 35, struct.pack("@qq", 0, 0))]
        kernel.send(0x181, b"a")

    kernel.clock.now_ns += 2 * MS
    looked_ns = kernel.clock.now_ns
    drained(bus)
    old(kernel.links[0])
    kernel.clock.now_ns += 2 * MS
    (frame,) = drained(bus)
    assert frame.stamp_ns == looked_ns
    kernel.links[0].fails = errno.ENETDOWN
    drained(bus)
    kernel.clock.now_ns += 2 * MS
    opened_ns = kernel.clock.now_ns
    assert bus.reopen()
    old(kernel.links[1])
    kernel.clock.now_ns += 2 * MS
    (frame,) = drained(bus)
    assert frame.stamp_ns == opened_ns


def test_a_lost_link_may_be_closed(kernel: Kernel) -> None:
    bus = GuardSocket("can0", KEYS)
    bus._socket.fails = errno.ENODEV
    assert drained(bus) == []
    bus.close()
    bus.close()
    assert bus.stats.state is BusState.DOWN and kernel.opened == 1


@pytest.mark.parametrize("side", ["receive", "send"])
def test_a_lost_link_is_opened_again_when_it_is_back(kernel: Kernel, bus: GuardSocket, side: str) -> None:
    bus._socket.fails = errno.ENETDOWN
    assert drained(bus) == [] if side == "receive" else bus.send_all([(1, b""), (2, b"")]) == 0
    assert (bus.stats.state, bus.fileno()) == (BusState.DOWN, -1)
    assert drained(bus) == [] and not bus.send(1, b"")
    kernel.flags = UP
    assert bus.reopen() is False, "up, but nothing is plugged in"
    assert [link.near.fileno() for link in kernel.links] == [-1, -1], "what cannot be used is closed"
    kernel.flags = UP | RUNNING
    assert bus.reopen() and bus.stats.recoveries == 1 and kernel.opened == 3
    kernel.send(0x181, b"again")
    assert [f.data for f in drained(bus)] == [b"again"]


def test_a_full_queue_refuses_and_keeps_the_link(kernel: Kernel, bus: GuardSocket) -> None:
    bus._socket.fails = errno.ENOBUFS
    assert bus.send_all([(1, b""), (2, b"")]) == 0
    assert (bus.stats.refused, bus.stats.state) == (2, BusState.ACTIVE)


def test_an_interface_that_is_down_or_missing_is_told(kernel: Kernel) -> None:
    kernel.flags = 0
    with pytest.raises(LinkError, match="can0", check=coded("bus.interface")):
        GuardSocket("can0", KEYS)
    kernel.refuses = errno.ENODEV
    with pytest.raises(LinkError, match=os.strerror(errno.ENODEV), check=coded("bus.interface")):
        GuardSocket("can0", KEYS)
    kernel.refuses, kernel.flags = 0, UP
    GuardSocket("can0", KEYS).close()


def test_the_guard_opens_its_own_socket_on_a_kernels_interface_only(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "open_bus", lambda address, filters: (address, filters))
    assert process.open_link("wire:crane0", [1]) == ("wire:crane0", [1])
    assert process.open_link("socketcan:", [1]) == ("socketcan:", [1])
    opened = process.open_link("socketcan:can0", [1])
    assert isinstance(opened, GuardSocket) and opened.name == "can0" and kernel.opened == 1
    also = process.open_link("python-can:socketcan:can0", [1])
    assert isinstance(also, GuardSocket) and also.name == "can0", "guard and controller must not share a fault"
    assert process.open_link("python-can:kvaser:0", [1]) == ("python-can:kvaser:0", [1])
