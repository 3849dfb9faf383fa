"""The wire and its plugin beyond the contract: full queues, a daemon that dies and comes back, recovery."""

from __future__ import annotations

import select
import signal
import time
from pathlib import Path

import pytest

from can_dbc.bus import wire_client
from can_dbc.bus.base import Bus, BusState
from can_dbc.bus.factory import open_bus
from can_dbc.bus.wire_client import control
from can_dbc.frame import Frame
from hil.wire.core import WireCore
from hil.wire.faults import Fault, Kind
from hil.wire.launch import wire_daemon
from tests.live.hil.bus_backends import BITRATE, TIMEOUT_S, Backend, counted_receives


@pytest.fixture(params=["in-process", "wire:lone", "timberhand:lone"])
def lone(request: pytest.FixtureRequest, wire_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Backend:
    """A bus on which nobody acknowledges a first sender, so that its queue fills up."""
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    core = WireCore(BITRATE) if request.param == "in-process" else None
    return Backend(request.param, request.param, core)


@pytest.mark.parametrize("at_once", [False, True])
def test_a_full_queue_refuses_and_never_sends_later(lone: Backend, at_once: bool) -> None:
    """Refused frames never reach the bus, also those of a tick with too little room for it."""
    frames = [(0x100 + i, b"") for i in range(14)]
    with lone.open() as a:
        if at_once:
            assert a.send_all(frames) == 10
        else:
            assert [a.send(*frame) for frame in frames] == [True] * 10 + [False] * 4
        assert (a.stats.sent, a.stats.refused) == (10, 4)
        with lone.open() as b:
            lone.send(a, 0x200, b"")
            assert [frame.key for frame in lone.receive(b, 11)] == [*range(0x100, 0x10A), 0x200]


def test_a_flush_cancels_frames_not_yet_on_the_bus(lone: Backend) -> None:
    with lone.open() as a:
        a.send_all([(0x100 + i, b"") for i in range(10)])
        lone.settle()
        a.flush()
        with lone.open() as b:
            lone.send(a, 0x200, b"")
            seen = lone.receive(b, 1)
            while seen[-1].key != 0x200:
                seen += lone.receive(b, 1)
    assert [frame.key for frame in seen] in ([0x200], [0x100, 0x200])  # the first one may have begun


@pytest.mark.parametrize("interface", ["wire", "timberhand"])
def test_a_daemon_that_comes_back_is_found_again(
    interface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the former filters, and without older frames."""
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    backend = Backend(interface, f"{interface}:crane0")
    with wire_daemon({"crane0": BITRATE}) as daemon:
        bus, other = backend.open(filters=[0x101, 0x200]), backend.open()
        backend.send(other, 0x101, b"old")
        backend.send(bus, 0x102, b"old")
        backend.receive(other, 1)
        daemon.kill()
        daemon.wait()
    if interface == "wire":
        assert not bus.send(0x103, b"old")  # so what was received waits behind a link that is down
    else:
        bus.drain([])
    assert bus.stats.state is BusState.DOWN
    assert not bus.reopen() and not bus.reopen()
    refused = bus.stats.refused
    assert bus.drain([]) == 0 and not bus.send(0x104, b"old") and bus.stats.refused == refused + 1
    with wire_daemon({"crane0": BITRATE}), bus, backend.open() as other:
        reopen(bus)
        assert (bus.stats.state, bus.stats.recoveries) == (BusState.ACTIVE, 1)
        backend.send(other, 0x100, b"filtered")
        backend.send(other, 0x200, b"new")
        assert [(frame.key, frame.data) for frame in backend.receive(bus, 1)] == [(0x200, b"new")]
        new = [(0x300 + i, b"new") for i in range(10)]
        assert bus.send_all(new) == 10  # the whole queue is free again
        assert [(frame.key, frame.data) for frame in backend.receive(other, 10)] == new


def test_a_slow_daemon_receives_one_hello(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": BITRATE}) as daemon:
        bus = open_bus("wire:crane0")
        daemon.kill()
        daemon.wait()
    with wire_daemon({"crane0": BITRATE}) as daemon, bus:
        bus.drain([])
        daemon.send_signal(signal.SIGSTOP)
        dialled: list[str] = []
        dial = wire_client._connect_and_send
        monkeypatch.setattr(
            wire_client, "_connect_and_send", lambda name, *rest: dialled.append(name) or dial(name, *rest)
        )
        assert not any(bus.reopen() for _ in range(5))
        daemon.send_signal(signal.SIGCONT)
        reopen(bus)
        assert dialled == ["crane0"]


def reopen(bus: Bus) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not bus.reopen():
        assert time.monotonic() < deadline, "the link did not come back"
        time.sleep(0.001)


@pytest.mark.parametrize("interface", ["wire", "timberhand"])
def test_a_dead_daemon_means_down(interface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": BITRATE}) as daemon, open_bus(f"{interface}:crane0") as bus:
        daemon.kill()
        daemon.wait()
        assert bus.drain([]) == 0
        assert not bus.send(0x100, b"")
        assert bus.stats.state is BusState.DOWN


def test_a_drain_of_the_wire_is_one_call(wire_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    backend = Backend("wire", "wire:fast")
    calls = counted_receives(monkeypatch)
    with backend.open() as a, backend.open() as b:
        for key in range(0x100, 0x108):
            backend.send(a, key, b"")
        calls.clear()
        drains = 0
        frames: list[Frame] = []
        while len(frames) < 8:
            select.select([b], [], [], TIMEOUT_S)
            b.drain(frames)
            drains += 1
        assert len(calls) == drains


@pytest.mark.parametrize("interface", ["wire", "timberhand"])
def test_a_recovery_leaves_no_older_frames(interface: str, wire_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if a single drain finds all of it, including bus-off."""
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    backend = Backend(interface, f"{interface}:fast")
    with backend.open() as bus, backend.open() as other:
        backend.send(other, 0x100, b"old")
        control("fast", {"inject": Fault(Kind.ERROR, key=0x300, mask=0x7FF).to_json()})
        backend.send(bus, 0x300, b"never")
        name = wait_for_state("OFF")
        control("fast", {"heal": True})
        control("fast", {"restart": name})
        backend.send(other, 0x200, b"new")
        assert [(frame.key, frame.data) for frame in backend.receive(bus, 1)] == [(0x200, b"new")]
        assert (bus.stats.state, bus.stats.recoveries) == (BusState.ACTIVE, 1)


def wait_for_state(state: str) -> str:
    """The name of the first participant that gets into it."""
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        for node in control("fast", {"stats": True})["nodes"]:
            if node["state"] == state:
                return str(node["name"])
        assert time.monotonic() < deadline, f"nobody is {state}"
