"""SocketCAN beyond the contract: links that go down and come back, floods, error frames.

TIMBERHAND_TEST_CAN names the interface (default vcan0).
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator

import pytest

from can_dbc.bus.base import DRAIN_LIMIT, ERR_BUSOFF, ERR_RESTARTED, BusState
from can_dbc.bus.factory import open_bus
from can_dbc.frame import ERROR, Frame
from runtime.errors import LinkError
from tests.codes import coded
from tests.live.hil.bus_backends import Backend, counted_receives, kernel_interface


@pytest.fixture
def link() -> Iterator[str]:
    """A kernel interface that a test may take down and delete."""
    kernel_interface()
    if os.geteuid() != 0:
        pytest.skip("setting a link down needs root")
    add_link("gone0")
    yield "gone0"
    subprocess.run(["ip", "link", "delete", "gone0"], check=False, capture_output=True)


def add_link(name: str) -> None:
    ip("link", "add", "dev", name, "type", "vcan")
    ip("link", "set", name, "up")


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@pytest.mark.parametrize("way", ["down", "delete"])
@pytest.mark.parametrize("found_by", ["drain", "send"])
def test_a_link_that_goes_down_and_comes_back(way: str, found_by: str, link: str) -> None:
    """Down and up again, or deleted and created again, which gives it another index."""
    backend = Backend("socketcan", f"socketcan:{link}")
    with backend.open() as a, backend.open(filters=[0x100, 0x101]) as b:
        backend.send(a, 0x100, b"old")
        if way == "down":
            ip("link", "set", link, "down")
        else:
            ip("link", "delete", link)
        for bus in (a, b):
            found = bus.send(0x100, b"") if found_by == "send" else bus.drain([])
            assert not found and bus.stats.state is BusState.DOWN
            assert not bus.reopen() and bus.drain([]) == 0 and not bus.send(0x100, b"")
        if way == "down":
            ip("link", "set", link, "up")
        else:
            add_link(link)
        assert a.reopen() and b.reopen()
        for bus in (a, b):
            assert (bus.stats.state, bus.stats.recoveries) == (BusState.ACTIVE, 1)
        backend.send(a, 0x102, b"filtered")
        backend.send(a, 0x101, b"new")
        assert [(frame.key, frame.data) for frame in backend.receive(b, 1)] == [(0x101, b"new")]


def test_a_link_that_was_down_for_a_moment_is_detected(link: str) -> None:
    with open_bus(f"socketcan:{link}") as a:
        ip("link", "set", link, "down")
        ip("link", "set", link, "up")
        a.drain([])
        assert a.stats.state is BusState.DOWN
        assert a.reopen() and a.stats.recoveries == 1


def test_a_link_that_is_down_is_not_opened(link: str) -> None:
    ip("link", "set", link, "down")
    with pytest.raises(LinkError, check=coded("bus.interface")):
        open_bus(f"socketcan:{link}")


def test_a_drain_of_a_link_is_one_call(monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"socketcan:{kernel_interface()}"
    calls = counted_receives(monkeypatch)
    with open_bus(address) as a, open_bus(address) as b:
        for count in (0, 1, 14, 63):
            a.send_all([(0x100, b"")] * count)
            calls.clear()
            assert b.drain([]) == count and len(calls) == 1


def test_a_flooded_link_does_not_delay_the_drain() -> None:
    address = f"socketcan:{kernel_interface()}"
    with open_bus(address) as a, open_bus(address) as b:
        for _ in range(40):
            a.send_all([(0x100, b"")] * 64)
        assert b.drain([]) == DRAIN_LIMIT
        b.flush()
        a.send(0x200, b"")
        assert [frame.key for frame in Backend("").receive(b, 1)] == [0x200]


def test_a_recovery_of_a_link_leaves_no_older_frames() -> None:
    address = f"socketcan:{kernel_interface()}"
    with open_bus(address) as a, open_bus(address) as b:
        a.send(0x100, b"old")
        a.send(ERROR | ERR_BUSOFF, bytes(8))
        a.send(ERROR | ERR_RESTARTED, bytes(8))
        a.send(0x200, b"new")
        frames: list[Frame] = []
        assert b.drain(frames) == 1 and frames[0].key == 0x200
        assert (b.stats.state, b.stats.recoveries) == (BusState.ACTIVE, 1)


def test_a_slow_kernel_reader_counts_lost_frames() -> None:
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


def test_error_frames_of_the_kernel_set_the_state() -> None:
    address = f"socketcan:{kernel_interface()}"
    with open_bus(address) as a, open_bus(address) as b:
        frames: list[Frame] = []
        a.send(ERROR | ERR_BUSOFF, bytes(8))
        b.drain(frames)
        assert (frames, b.stats.state, b.stats.error_frames) == ([], BusState.OFF, 1)
        assert not b.send(0x100, b"")
        a.send(ERROR | ERR_RESTARTED, bytes(8))
        b.drain(frames)
        assert (frames, b.stats.state, b.stats.recoveries) == ([], BusState.ACTIVE, 1)
        assert b.send(0x100, b"")
