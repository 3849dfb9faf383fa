"""The wire seen by python-can: messages, filters, timeouts, error frames, Notifier, logger and player."""

from __future__ import annotations

import importlib.metadata
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_dbc.bus.wire_client import control
from can_dbc.bus.wirebus import WireBus
from hil.wire.faults import Fault, Kind
from hil.wire.launch import wire_daemon

TIMEOUT_S = 10.0


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with wire_daemon({"crane0": 1_000_000}) as process:
        yield process


@pytest.fixture
def tool_environment(tmp_path: Path) -> None:
    names = [point.name for point in importlib.metadata.entry_points(group="can.interface")]
    if "timberhand" not in names:
        pytest.skip("the package is not installed, so python-can does not know the interface")


def test_it_is_registered_as_timberhand(tool_environment: None, daemon: object) -> None:
    with can.Bus(interface="timberhand", channel="crane0") as bus:
        assert isinstance(bus, WireBus)
        assert "1000000 bit/s" in bus.channel_info


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"12345678"),
        can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=b""),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, is_remote_frame=True, dlc=5),
    ],
)
def test_messages_pass_unchanged(message: can.Message, daemon: object) -> None:
    with WireBus("crane0") as a, WireBus("crane0") as b:
        before_s = time.time()
        a.send(message)
        received = b.recv(TIMEOUT_S)
        assert received is not None and received.equals(message, None, check_channel=False, check_direction=False)
        assert before_s - 0.1 < received.timestamp < time.time() + 0.1
        assert received.channel == "crane0"


def test_recv_times_out_and_own_messages_come_only_on_request(daemon: object) -> None:
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with WireBus("crane0") as a, WireBus("crane0", receive_own_messages=True) as b:
        a.send(message)
        assert b.recv(TIMEOUT_S) is not None
        b.send(message)
        assert b.recv(TIMEOUT_S) is not None and a.recv(TIMEOUT_S) is not None
        assert a.recv(0) is None and a.recv(0.01) is None


def test_filters_of_python_can_apply(daemon: object) -> None:
    wanted = [{"can_id": 0x120, "can_mask": 0x7F0, "extended": False}]
    with WireBus("crane0") as a, WireBus("crane0", can_filters=wanted) as b:
        for identifier, extended in ((0x130, False), (0x123, True), (0x125, False)):
            a.send(can.Message(arbitration_id=identifier, is_extended_id=extended))
        received = b.recv(TIMEOUT_S)
        assert received is not None and received.arbitration_id == 0x125


def test_send_waits_for_room_until_its_timeout(daemon: object) -> None:
    """No node acknowledges a lone sender, so its queue stays full until a second participant joins."""
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with WireBus("crane0", tx_queue=2) as a:
        a.send(message)
        a.send(message)
        for timeout_s in (0, 0.01):
            with pytest.raises(can.CanOperationError):
                a.send(message, timeout=timeout_s)
        with WireBus("crane0") as b:
            a.send(message, timeout=TIMEOUT_S)
            a.send(message)
            assert all(b.recv(TIMEOUT_S) for _ in range(4))


def test_messages_beyond_classical_can_are_refused(daemon: object) -> None:
    with WireBus("crane0") as bus:
        for message in (can.Message(is_fd=True), can.Message(is_error_frame=True)):
            with pytest.raises(can.CanOperationError):
                bus.send(message, timeout=0)


def test_error_frames_are_messages_and_set_the_state(daemon: object) -> None:
    with WireBus("crane0") as bus:
        assert bus.state is can.BusState.ACTIVE
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))  # nobody acknowledges
        messages = [bus.recv(TIMEOUT_S) for _ in range(16)]
        assert all(message is not None and message.is_error_frame for message in messages)
        assert bus.state is can.BusState.PASSIVE


def test_a_missing_or_dead_daemon_is_an_error_not_a_hang(
    daemon: subprocess.Popen[str],
) -> None:
    with pytest.raises(can.CanInitializationError, match="nowhere"):
        WireBus("nowhere")
    with WireBus("crane0") as bus:
        daemon.kill()
        daemon.wait()
        with pytest.raises(can.CanOperationError):
            bus.recv()
        with pytest.raises(can.CanOperationError):
            bus.send(can.Message())
        assert bus.state is can.BusState.ERROR


def test_a_notifier_receives_a_periodic_task(daemon: object) -> None:
    heard: queue.SimpleQueue[can.Message] = queue.SimpleQueue()
    with WireBus("crane0") as a, WireBus("crane0") as b:
        notifier = can.Notifier(b, [heard.put], timeout=0.1)
        try:
            a.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.002)
            assert [heard.get(timeout=TIMEOUT_S).arbitration_id for _ in range(20)] == [0x80] * 20
        finally:
            a.stop_all_periodic_tasks()
            notifier.stop()


def test_logger_and_player_of_python_can_join(tool_environment: None, daemon: object, tmp_path: Path) -> None:
    """The player sends a log file through the wire; the logger prints every frame of it."""
    sent = [(f"{0x100 + i:03X}", f"{i:016X}") for i in range(50)] + [("1CFF2030", "0102")]
    log = tmp_path / "source.log"
    log.write_text("".join(f"({i * 0.001:.6f}) vcan0 {key}#{data}\n" for i, (key, data) in enumerate(sent)))
    join = ["-i", "timberhand", "-c", "crane0"]
    logger = subprocess.Popen([sys.executable, "-u", "-m", "can.logger", *join], stdout=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 2 * TIMEOUT_S
        while not control("crane0", {"stats": True})["nodes"]:
            assert time.monotonic() < deadline and logger.poll() is None
            time.sleep(0.02)
        command = [sys.executable, "-m", "can.player", *join, str(log)]
        subprocess.run(command, check=True, timeout=30, stdout=subprocess.DEVNULL)
        watchdog = threading.Timer(TIMEOUT_S, logger.kill)
        watchdog.start()
        printed: list[tuple[str, str]] = []
        for line in logger.stdout:
            if found := re.search(r"ID: +(\w+) .* DL: +\d+ +((?:[0-9a-f]{2} )+)", line):
                printed.append((found[1].upper(), found[2].replace(" ", "").upper()))
                if len(printed) == len(sent):
                    break
        watchdog.cancel()
    finally:
        logger.kill()
        logger.communicate()
    assert printed == sent


def test_faults_reach_python_can_programs_too(daemon: object) -> None:
    with WireBus("crane0") as a, WireBus("crane0") as b:
        control("crane0", {"inject": Fault(Kind.REPEAT, count=2).to_json()})
        a.send(can.Message(arbitration_id=5, is_extended_id=False))
        assert [b.recv(TIMEOUT_S).arbitration_id for _ in range(3)] == [5, 5, 5]


def test_the_output_buffer_can_be_emptied(daemon: object) -> None:
    """No node acknowledges a lone sender, so all frames wait."""
    with WireBus("crane0") as a:
        for i in range(10):
            a.send(can.Message(arbitration_id=0x100 + i, is_extended_id=False))
        a.flush_tx_buffer()
        with WireBus("crane0") as b:
            a.send(can.Message(arbitration_id=0x200, is_extended_id=False), timeout=TIMEOUT_S)
            seen = [b.recv(TIMEOUT_S)]
            while seen[-1] is not None and seen[-1].arbitration_id != 0x200:
                seen.append(b.recv(TIMEOUT_S))
            # What a closed participant of another test still had in its queue goes out too, once somebody hears it.
            own = [
                m and m.arbitration_id for m in seen if m is None or m.arbitration_id in (0x200, *range(0x100, 0x10A))
            ]
            assert own in ([0x200], [0x100, 0x200])
