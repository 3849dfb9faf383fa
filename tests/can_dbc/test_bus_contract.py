"""One contract, every backend: what a loop may rely on whatever bus it was given.

TIMBERHAND_TEST_CAN names the SocketCAN interface (default vcan0).
"""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from can_dbc.bus import ERR_BUSOFF, ERR_RESTARTED, Bus, BusState, kernel_has_can, open_bus
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame
from hil.wire.core import WireCore
from hil.wire.inprocess import InProcessBus
from hil.wire.launch import wire_daemon

PATIENCE_S = 5.0
BITRATE = 1_000_000

Open = Callable[..., Bus]


class Backend:
    """A way to open participants on one bus, and to let time pass."""

    def __init__(self, name: str, address: str = "", core: WireCore | None = None) -> None:
        self.name = name
        self.address = address
        self.core = core
        self.opened: list[Bus] = []

    def open(self, **options: object) -> Bus:
        bus: Bus
        if self.core is not None:
            bus = InProcessBus(self.core, f"p{len(self.opened)}", **options)  # type: ignore[arg-type]
        else:
            bus = open_bus(self.address, **options)  # type: ignore[arg-type]
        self.opened.append(bus)
        return bus

    def settle(self) -> None:
        if self.core is not None:
            self.core.advance(self.core.now_ns + 1_000_000)
        else:
            time.sleep(0.0005)

    def receive(self, bus: Bus, count: int) -> list[Frame]:
        """Drains until `count` frames are there; fails when they do not come."""
        frames: list[Frame] = []
        deadline = time.monotonic() + PATIENCE_S
        while len(frames) < count:
            assert time.monotonic() < deadline, f"{len(frames)} of {count} frames arrived"
            self.settle()
            bus.drain(frames)
        return frames

    def send(self, bus: Bus, key: int, data: bytes) -> None:
        """Sends, waiting for room in the queue."""
        deadline = time.monotonic() + PATIENCE_S
        while not bus.send(key, data):
            assert time.monotonic() < deadline, "no room in the transmit queue"
            self.settle()


@pytest.fixture(scope="module")
def wire_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    directory = tmp_path_factory.mktemp("wire")
    with wire_daemon({"fast": BITRATE, "lone": BITRATE}, directory):
        yield directory


@pytest.fixture(params=["in-process", "wire", "socketcan", "virtual", "plugin"])
def backend(request: pytest.FixtureRequest, wire_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Backend]:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    name = request.param
    if name == "in-process":
        backend = Backend(name, core=WireCore(BITRATE))
    elif name == "socketcan":
        backend = Backend(name, f"socketcan:{kernel_interface()}")
    else:
        channel = request.node.name if name == "virtual" else "fast"
        backend = Backend(name, f"{'timberhand' if name == 'plugin' else name}:{channel}")
    yield backend
    for bus in backend.opened:
        bus.close()


def kernel_interface() -> str:
    interface = os.environ.get("TIMBERHAND_TEST_CAN", "vcan0")
    if not kernel_has_can():
        pytest.skip("no AF_CAN in this kernel")
    if interface not in {name for _, name in socket.if_nameindex()}:
        pytest.skip(f"no interface {interface}")
    return interface


def test_frames_arrive_in_order_with_payload_and_stamp(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    before_ns = time.monotonic_ns()
    sent = [(0x100 + i, bytes(range(i % 9))) for i in range(40)]
    for key, data in sent:
        backend.send(a, key, data)
    frames = backend.receive(b, len(sent))
    assert [(frame.key, frame.data) for frame in frames] == sent
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(stamps)
    if backend.core is None:
        assert before_ns - 1_000_000 <= stamps[0] and stamps[-1] <= time.monotonic_ns()
    assert a.stats.sent == b.stats.received == len(sent)
    assert a.stats.state is b.stats.state is BusState.ACTIVE


def test_extended_standard_and_remote_frames_are_told_apart(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    sent = [
        (0x123, b"s"),
        (0x123 | EXTENDED, b"x"),
        (0x1FFF_FFFF | EXTENDED, b""),
        (0x123 | REMOTE, bytes(3)),
    ]
    for key, data in sent:
        backend.send(a, key, data)
    assert [(frame.key, frame.data) for frame in backend.receive(b, 4)] == sent


def test_own_frames_do_not_come_back(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    backend.send(a, 0x100, b"own")
    backend.receive(b, 1)
    backend.send(b, 0x200, b"other")
    assert [frame.key for frame in backend.receive(a, 1)] == [0x200]


def test_own_frames_come_back_when_asked_for(backend: Backend) -> None:
    a = backend.open(receive_own=True)
    backend.open()
    backend.send(a, 0x100, b"own")
    assert [(frame.key, frame.data) for frame in backend.receive(a, 1)] == [(0x100, b"own")]


def test_filters_take_exact_keys(backend: Backend) -> None:
    a, b = backend.open(), backend.open(filters=[0x100, 0x200 | EXTENDED])
    for key in (0x101, 0x100 | EXTENDED, 0x100 | REMOTE, 0x200, 0x200 | EXTENDED, 0x100):
        backend.send(a, key, b"")
    assert [frame.key for frame in backend.receive(b, 2)] == [0x200 | EXTENDED, 0x100]


def test_an_empty_filter_receives_nothing(backend: Backend) -> None:
    a, b, c = backend.open(), backend.open(filters=[]), backend.open()
    backend.send(a, 0x100, b"")
    backend.receive(c, 1)
    assert b.drain([]) == 0


def test_a_silent_bus_drains_at_once(backend: Backend) -> None:
    bus = backend.open()
    frames: list[Frame] = []
    assert bus.drain(frames) == 0 and frames == []
    assert bus.stats.received == 0


def test_more_than_eight_bytes_are_refused(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    assert not a.send(0x100, bytes(9))
    assert a.stats.refused == 1
    backend.send(a, 0x101, b"")
    assert [frame.key for frame in backend.receive(b, 1)] == [0x101]


def test_frames_sent_just_before_closing_still_arrive(backend: Backend) -> None:
    b = backend.open()
    with backend.open() as a:
        for i in range(5):
            backend.send(a, 0x100 + i, b"bye")
    assert [frame.key for frame in backend.receive(b, 5)] == [0x100 + i for i in range(5)]


def test_a_closed_bus_refuses(backend: Backend) -> None:
    with backend.open() as bus:
        pass
    bus.close()
    assert bus.stats.state is BusState.DOWN
    assert not bus.send(0x100, b"")
    assert bus.drain([]) == 0


@pytest.mark.parametrize("address", ["in-process", "wire:lone", "timberhand:lone"])
def test_a_full_queue_refuses_and_never_sends_later(
    address: str, wire_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody acknowledges a lone sender, so its queue fills up; what was refused never reaches the bus."""
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    backend = Backend(address, address, WireCore(BITRATE) if address == "in-process" else None)
    with backend.open() as a:
        assert [a.send(0x100 + i, b"") for i in range(14)] == [True] * 10 + [False] * 4
        assert (a.stats.sent, a.stats.refused) == (10, 4)
        with backend.open() as b:
            backend.send(a, 0x200, b"")
            assert [frame.key for frame in backend.receive(b, 11)] == [*range(0x100, 0x10A), 0x200]


@pytest.mark.parametrize("interface", ["wire", "timberhand"])
def test_a_dead_daemon_means_down(interface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": BITRATE}) as daemon, open_bus(f"{interface}:crane0") as bus:
        daemon.kill()
        daemon.wait()
        assert bus.drain([]) == 0
        assert not bus.send(0x100, b"")
        assert bus.stats.state is BusState.DOWN


def test_a_link_that_goes_down_and_comes_back() -> None:
    interface = kernel_interface()
    if os.geteuid() != 0:
        pytest.skip("setting a link down needs root")
    with open_bus(f"socketcan:{interface}") as a, open_bus(f"socketcan:{interface}") as b:
        backend = Backend("socketcan")
        try:
            subprocess.run(["ip", "link", "set", interface, "down"], check=True)
            assert not a.send(0x100, b"")
            assert b.drain([]) == 0
            assert a.stats.state is b.stats.state is BusState.DOWN
        finally:
            subprocess.run(["ip", "link", "set", interface, "up"], check=True)
        a.drain([])
        backend.send(a, 0x101, b"")
        assert [frame.key for frame in backend.receive(b, 1)] == [0x101]
        assert a.stats.state is b.stats.state is BusState.ACTIVE


def test_a_slow_kernel_reader_counts_what_it_lost() -> None:
    address = f"socketcan:{kernel_interface()}"
    with open_bus(address) as a, open_bus(address) as b:
        for i in range(20_000):
            a.send(0x100, i.to_bytes(8, "big"))
        frames: list[Frame] = []
        while b.drain(frames):
            pass
        a.send(0x200, b"")  # the counter travels with the next frame
        b.drain(frames)
        assert b.stats.dropped > 0
        assert b.stats.dropped + len(frames) == a.stats.sent


def test_error_frames_of_the_kernel_become_state() -> None:
    address = f"socketcan:{kernel_interface()}"
    with open_bus(address) as a, open_bus(address) as b:
        frames: list[Frame] = []
        a.send(ERROR | ERR_BUSOFF, bytes(8))
        b.drain(frames)
        assert (frames, b.stats.state, b.stats.error_frames) == ([], BusState.OFF, 1)
        assert not b.send(0x100, b"")
        a.send(ERROR | ERR_RESTARTED, bytes(8))
        b.drain(frames)
        assert (frames, b.stats.state) == ([], BusState.ACTIVE)
        assert b.send(0x100, b"")
