"""The wire as a process: start, stop, pace, control, and a cable between two kernel interfaces."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from can_dbc.bus.base import BusState
from can_dbc.bus.factory import kernel_has_can, open_bus
from can_dbc.bus.wire_client import CONTROL, control, wire_directory
from can_dbc.bus.wire_records import RECORD
from can_dbc.frame import ERROR, EXTENDED, Frame
from hil.wire.core import frame_bits
from hil.wire.faults import Fault, Kind
from hil.wire.launch import wire_daemon
from runtime.errors import LinkError
from tests.codes import coded

TIMEOUT_S = 5.0


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": 1_000_000, "mach0": 250_000}) as process:
        yield process


def receive(bus: object, count: int) -> list[Frame]:
    frames: list[Frame] = []
    deadline = time.monotonic() + TIMEOUT_S
    while len(frames) < count:
        assert select.select([bus], [], [], deadline - time.monotonic())[0], f"{len(frames)} of {count}"
        bus.drain(frames)
    return frames


def run_daemon(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil.wire.daemon", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=30)


def test_frames_are_spaced_by_the_bit_rate(daemon: subprocess.Popen[str]) -> None:
    with open_bus("wire:mach0", tx_queue=50) as a, open_bus("wire:mach0") as b, open_bus("wire:crane0") as c:
        key, data = 0x0CFF2030 | EXTENDED, bytes(range(8))
        for _ in range(40):
            assert a.send(key, data)
        stamps = [frame.stamp_ns for frame in receive(b, 40)]
        gap_ns = (frame_bits(key, data) + 13) * 4000
        gaps = [right - left for left, right in pairwise(stamps)]
        assert min(gaps) == gap_ns  # back to back, never closer
        assert stamps[-1] <= time.monotonic_ns()
        assert c.drain([]) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(number: signal.Signals, daemon: subprocess.Popen[str], tmp_path: Path) -> None:
    assert (tmp_path / "crane0").stat().st_mode & 0o777 == 0o660
    daemon.send_signal(number)
    assert daemon.wait(TIMEOUT_S) == 0
    assert list(tmp_path.iterdir()) == []


def test_a_running_bus_is_not_taken_over(daemon: subprocess.Popen[str], tmp_path: Path) -> None:
    result = run_daemon("--bus", "crane0:1000000", "--dir", str(tmp_path))
    assert result.returncode == 4
    with open_bus("wire:crane0"):
        pass


def test_the_file_of_a_dead_daemon_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": 1_000_000}) as first:
        first.kill()
        first.wait()
        assert (tmp_path / "crane0").is_socket()
        with wire_daemon({"crane0": 1_000_000}), open_bus("wire:crane0"):
            pass


def test_no_other_file_is_ever_removed(tmp_path: Path) -> None:
    (tmp_path / "crane0").write_text("precious")
    assert run_daemon("--bus", "crane0:1000000", "--dir", str(tmp_path)).returncode == 4
    assert (tmp_path / "crane0").read_text() == "precious"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--bus", "crane0"],
        ["--bus", "crane0:300000007"],
        ["--bus", "a/b:1000000"],
        ["--bus", "crane0:1000000", "--join", "mach0=vcan0"],
        ["--bus", "crane0:1000000", "--join", "vcan0"],
    ],
)
def test_malformed_arguments_are_a_usage_error(arguments: list[str], tmp_path: Path) -> None:
    assert run_daemon("--dir", str(tmp_path), *arguments).returncode == 2
    assert list(tmp_path.iterdir()) == []


def test_a_launch_that_fails_reports_the_reason(daemon: subprocess.Popen[str]) -> None:
    with pytest.raises(LinkError, match=r"\[wire.cannot-listen\]"), wire_daemon({"crane0": 1_000_000}):
        pass


def test_a_directory_with_a_path_too_long_for_a_socket_is_refused(tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 110)
    with pytest.raises(LinkError, match=r"\[wire.path-too-long\]"), wire_daemon({"a": 1_000_000}, deep):
        pass


def test_faults_act_and_heal_by_control_messages(daemon: subprocess.Popen[str]) -> None:
    with open_bus("wire:crane0", participant="left") as a, open_bus("wire:crane0") as b:
        control("crane0", {"inject": Fault(Kind.DROP, key=0x100, mask=0x7FF).to_json()})
        a.send(0x100, b"lost")
        a.send(0x101, b"seen")
        assert [frame.key for frame in receive(b, 1)] == [0x101]
        control("crane0", {"heal": True})
        a.send(0x100, b"seen")
        assert [frame.key for frame in receive(b, 1)] == [0x100]

        control("crane0", {"inject": Fault(Kind.ERROR, node="left").to_json()})
        a.send(0x100, b"never")
        deadline = time.monotonic() + TIMEOUT_S
        while a.stats.state is not BusState.OFF:
            assert time.monotonic() < deadline
            select.select([a], [], [], 1.0)
            a.drain([])
        control("crane0", {"heal": True})
        control("crane0", {"restart": "left"})
        while a.stats.state is not BusState.ACTIVE:
            assert time.monotonic() < deadline
            select.select([a], [], [], 1.0)
            a.drain([])
        assert a.send(0x102, b"")
        assert [frame.key for frame in receive(b, 1)] == [0x102]

        figures = control("crane0", {"stats": True})
        left = next(node for node in figures["nodes"] if node["name"] == "left")
        assert (left["state"], figures["errors"], figures["bitrate"]) == ("ACTIVE", 32, 1_000_000)
        assert figures["busy_ns"] > 0 and len(figures["nodes"]) == 2


@pytest.mark.parametrize("request_", [{}, {"inject": {"kind": "melt"}}, {"inject": 3}, {"hello": {}}, ["heal"]])
def test_a_malformed_request_is_refused_without_side_effects(
    request_: dict[str, object], daemon: subprocess.Popen[str]
) -> None:
    with pytest.raises(LinkError, check=coded("wire.refused")):
        control("crane0", request_)
    assert control("crane0", {"stats": True})["nodes"] == []


@pytest.mark.parametrize("packet", [b"x", bytes(32)])
def test_a_client_that_breaks_the_protocol_is_dropped(
    packet: bytes, daemon: subprocess.Popen[str], tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.settimeout(TIMEOUT_S)
        sock.connect(str(tmp_path / "crane0"))
        sock.send(packet)
        assert sock.recv(100) == b""
    assert control("crane0", {"stats": True})["nodes"] == []


def test_a_client_that_sends_half_a_record_is_dropped(daemon: subprocess.Popen[str], tmp_path: Path) -> None:
    hello = {"hello": {"name": "half", "filters": None, "receive_own": False, "tx_queue": 10}}
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.settimeout(TIMEOUT_S)
        sock.connect(str(tmp_path / "crane0"))
        sock.send(RECORD.pack(0, 0, b"", 0, CONTROL, 0, 0) + json.dumps(hello).encode())
        sock.recv(1000)
        sock.send(bytes(RECORD.size + 1))
        assert sock.recv(100) == b""
    assert control("crane0", {"stats": True})["nodes"] == []


def test_the_last_frames_of_a_client_that_never_read_are_sent(daemon: subprocess.Popen[str], tmp_path: Path) -> None:
    hello = {"hello": {"name": "mute", "filters": None, "receive_own": False, "tx_queue": 10}}
    with open_bus("wire:crane0") as bus:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
            sock.connect(str(tmp_path / "crane0"))
            sock.send(RECORD.pack(0, 0, b"", 0, CONTROL, 0, 0) + json.dumps(hello).encode())
            sock.recv(1000)
            bus.send(0x100, b"")
            assert select.select([sock], [], [], TIMEOUT_S)[0]
            sock.send(RECORD.pack(0x200, 3, b"bye", 0, 0, 0, 0))
        assert [(frame.key, frame.data) for frame in receive(bus, 1)] == [(0x200, b"bye")]


def test_a_frame_refused_by_the_bus_frees_its_place_in_the_queue(daemon: subprocess.Popen[str]) -> None:
    with open_bus("wire:crane0", tx_queue=1) as a, open_bus("wire:crane0") as b:
        assert a.send(ERROR, b"")
        deadline = time.monotonic() + TIMEOUT_S
        while not a.send(0x100, b""):
            assert time.monotonic() < deadline
        assert [frame.key for frame in receive(b, 1)] == [0x100]


def test_a_client_that_only_sends_keeps_a_bounded_backlog(
    daemon: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("can_dbc.bus.wire_client._MAX_BACKLOG_FRAMES", 8)
    with open_bus("wire:crane0", tx_queue=1) as a, open_bus("wire:crane0", tx_queue=40) as b:
        assert all(b.send(i, b"") for i in range(30))
        assert a.send(0x100, b"")
        assert [frame.key for frame in receive(b, 1)] == [0x100]  # so a has been told of the others
        a.send(0x101, b"")
        a.send(0x102, b"")
        frames: list[Frame] = []
        a.drain(frames)
        assert (a.stats.dropped, [frame.key for frame in frames]) == (22, list(range(22, 30)))


def test_a_frame_after_a_silence_is_stamped_when_it_was_sent(daemon: subprocess.Popen[str]) -> None:
    with open_bus("wire:crane0") as a, open_bus("wire:crane0") as b:
        select.select([a], [], [], 0.02)
        before_ns = time.monotonic_ns()
        a.send(0x100, b"")
        assert receive(b, 1)[0].stamp_ns > before_ns


def test_a_client_that_never_reads_loses_frames_alone(daemon: subprocess.Popen[str]) -> None:
    """Its socket and queue fill; one that reads each burst before the next is sent loses nothing, however late."""
    with (
        open_bus("wire:crane0") as slow,
        open_bus("wire:crane0") as quick,
        open_bus("wire:crane0", tx_queue=100) as sender,
    ):
        deadline = time.monotonic() + 60
        while not control("crane0", {"stats": True})["nodes"][0]["dropped"]:
            assert time.monotonic() < deadline
            for number in range(100):
                assert sender.send(number, b"")
            assert [frame.key for frame in receive(quick, 100)] == list(range(100))
            sender.drain([])
        assert quick.stats.dropped == 0
        while not slow.stats.dropped:
            assert select.select([slow], [], [], TIMEOUT_S)[0]
            slow.drain([])


def test_a_lone_sender_retries_until_another_node_joins(daemon: subprocess.Popen[str]) -> None:
    with open_bus("wire:crane0") as bus:
        bus.send(0x100, b"")
        deadline = time.monotonic() + TIMEOUT_S
        while bus.stats.state is not BusState.PASSIVE:
            assert time.monotonic() < deadline
            select.select([bus], [], [], 1.0)
            bus.drain([])
        errors = control("crane0", {"stats": True})["errors"]
        select.select([bus], [], [], 0.05)
        assert control("crane0", {"stats": True})["errors"] > errors
        with open_bus("wire:crane0") as other:
            assert [frame.key for frame in receive(other, 1)] == [0x100]


def test_the_directory_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TIMBERHAND_WIRE_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert wire_directory() == tmp_path / "timberhand"
    with wire_daemon({"crane0": 1_000_000}), open_bus("wire:crane0"):
        assert wire_directory().stat().st_mode & 0o777 == 0o700
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert wire_directory().name == f"timberhand-{os.getuid()}"


def test_a_cable_between_two_interfaces_can_be_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kernel_has_can():
        pytest.skip("no AF_CAN in this kernel")
    if not {"vcan0", "vcan1"} <= {name for _, name in socket.if_nameindex()}:
        pytest.skip("no interfaces vcan0 and vcan1")
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    joined = {"vcan0": "crane0", "vcan1": "crane0"}
    with (
        wire_daemon({"crane0": 1_000_000}, joined=joined),
        open_bus("socketcan:vcan0") as a,
        open_bus("socketcan:vcan1") as b,
    ):
        control("crane0", {"inject": Fault(Kind.DROP, key=0x100, mask=0x7FF).to_json()})
        assert a.send(0x100, b"lost") and a.send(0x101, b"there")
        assert [(frame.key, frame.data) for frame in receive(b, 1)] == [(0x101, b"there")]
        assert b.send(0x200 | EXTENDED, b"back")
        assert [(frame.key, frame.data) for frame in receive(a, 1)] == [(0x200 | EXTENDED, b"back")]
