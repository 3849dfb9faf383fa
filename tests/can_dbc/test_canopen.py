"""CANopen as pure functions, with the ``canopen`` library as the other side where possible."""

from __future__ import annotations

from pathlib import Path

import canopen as library
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.dbc import codec
from can_dbc.protocols import canopen as co

MS = 1_000_000


def test_nmt_sync_heartbeat() -> None:
    assert co.nmt_frame(co.NmtCommand.RESET_NODE, 0x10) == (0, b"\x81\x10")
    assert co.nmt_frame(co.NmtCommand.START) == (0, b"\x01\x00")
    assert co.sync_frame(7) == (0x80, b"\x07")
    assert [co.next_sync(n) for n in (0, 1, 239, 240)] == [1, 2, 240, 1]
    assert co.heartbeat_frame(0x7E, co.NodeState.OPERATIONAL) == (0x77E, b"\x05")
    assert co.parse_heartbeat(0x702, b"\x85") == (2, 5)
    for key, data in ((0x700, b"\x05"), (0x702, b""), (0x702, b"\x05\x00"), (0x680, b"\x05"), (0x780, b"\x05")):
        assert co.parse_heartbeat(key, data) is None


EMERGENCIES = [
    (0x0000, "no error, or error reset"),
    (0x4200, "device temperature"),
    (0x4300, "temperature"),
    (0x5010, "device hardware"),
    (0x8120, "CAN error passive"),
    (0x8100, "communication"),
    (0xFF01, "device specific"),
    (0xA000, "unknown"),
]


@pytest.mark.parametrize(("code", "text"), EMERGENCIES)
def test_emergency(code: int, text: str) -> None:
    emergency = co.Emergency(3, code, 0x81, b"\1\2\3\4\5")
    key, data = co.emergency_frame(emergency)
    assert key == 0x83
    assert co.parse_emergency(key, data) == emergency
    assert emergency.text == text


def test_emergency_is_not_sync() -> None:
    assert co.parse_emergency(0x80, bytes(8)) is None
    assert co.parse_emergency(0x83, bytes(7)) is None
    assert co.parse_emergency(0x100, bytes(8)) is None


def test_heartbeat_monitor_detects_a_node_that_is_dead_at_boot() -> None:
    monitor = co.HeartbeatMonitor({1: 250 * MS, 2: 150 * MS}, boot_timeout_ns=2000 * MS, start_ns=10 * MS)
    assert not monitor.receive(0x703, b"\x05", 20 * MS)
    assert monitor.receive(0x701, b"\x00", 20 * MS)
    assert monitor.presence(2, 2009 * MS) is co.Presence.WAITING
    assert monitor.presence(2, 2010 * MS) is co.Presence.NEVER_SEEN
    assert (monitor.boots[1], monitor.operational(1, 30 * MS)) == (1, False)
    assert monitor.receive(0x701, b"\x05", 100 * MS)
    assert monitor.operational(1, 350 * MS)
    assert monitor.presence(1, 350 * MS) is co.Presence.ALIVE
    assert monitor.presence(1, 350 * MS + 1) is co.Presence.LOST
    assert not monitor.operational(1, 351 * MS)
    assert monitor.missing(3000 * MS) == (1, 2)
    monitor.receive(0x702, b"\x7f", 3000 * MS)
    assert monitor.missing(3000 * MS) == (1,)
    assert monitor.states[2] == co.NodeState.PRE_OPERATIONAL


def test_the_next_loss_is_that_of_the_node_with_the_earliest_timeout() -> None:
    monitor = co.HeartbeatMonitor({1: 250 * MS, 2: 150 * MS}, boot_timeout_ns=0, start_ns=0)
    assert monitor.next_loss_ns() == 0
    monitor.receive(0x701, b"\x05", 10 * MS)
    assert monitor.next_loss_ns() == 260 * MS
    monitor.receive(0x702, b"\x05", 50 * MS)
    loss_ns = monitor.next_loss_ns()
    assert loss_ns == 200 * MS
    assert not monitor.missing(loss_ns) and monitor.missing(loss_ns + 1) == (2,)


def test_a_reset_monitor_has_seen_no_node() -> None:
    monitor = co.HeartbeatMonitor({1: 250 * MS}, boot_timeout_ns=0, start_ns=0)
    monitor.receive(0x701, b"\x00", 10 * MS)
    monitor.receive(0x701, b"\x05", 20 * MS)
    monitor.forget()
    assert monitor.presence(1, 30 * MS) is co.Presence.NEVER_SEEN and not monitor.states
    assert monitor.boots[1] == 1


# -- SDO --------------------------------------------------------------------------------------------------------

RESPONSES = [
    # data, kind, value, abort
    ("4304650001020304", co.SdoKind.UPLOAD, b"\1\2\3\4", 0),
    ("4704650001020304", co.SdoKind.UPLOAD, b"\1\2\3", 0),
    ("4b04650001020304", co.SdoKind.UPLOAD, b"\1\2", 0),
    ("4f04650001020304", co.SdoKind.UPLOAD, b"\1", 0),
    ("4204650001020304", co.SdoKind.UPLOAD, b"\1\2\3\4", 0),
    ("6004650000000000", co.SdoKind.DOWNLOAD, b"", 0),
    ("8004650002000106", co.SdoKind.ABORT, b"", 0x06010002),
    ("4104650009000000", co.SdoKind.SEGMENTED, b"\x09\0\0\0", 0),
]


@pytest.mark.parametrize(("data", "kind", "value", "abort"), RESPONSES)
def test_parse_response(data: str, kind: co.SdoKind, value: bytes, abort: int) -> None:
    assert co.parse_response(0x585, bytes.fromhex(data)) == co.Sdo(kind, 5, 0x6504, 0, value, abort)
    assert co.parse_response(0x580, bytes.fromhex(data)) is None
    assert co.parse_response(0x585, bytes.fromhex(data)[:7]) is None
    assert co.parse_response(0x605, bytes.fromhex(data)) is None


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(st.integers(1, 127), st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(min_size=1, max_size=4))
def test_client_and_server_parse_each_others_frames(node: int, index: int, sub: int, value: bytes) -> None:
    ask = co.parse_request(*co.upload_request(node, index, sub))
    assert ask == co.Sdo(co.SdoKind.UPLOAD, node, index, sub, b"", 0)
    answer = co.parse_response(*co.upload_response(node, index, sub, value))
    assert answer == co.Sdo(co.SdoKind.UPLOAD, node, index, sub, value, 0)
    write = co.parse_request(*co.download_request(node, index, sub, value))
    assert write == co.Sdo(co.SdoKind.DOWNLOAD, node, index, sub, value, 0)
    done = co.parse_response(*co.download_response(node, index, sub))
    assert done == co.Sdo(co.SdoKind.DOWNLOAD, node, index, sub, b"", 0)
    stop = co.parse_request(*co.abort_frame(co.SDO_TO_SERVER, node, index, sub, 0x05040000))
    assert stop and stop.abort == 0x05040000


def test_sdo_values() -> None:
    sdo = co.Sdo(co.SdoKind.UPLOAD, 5, 0x6004, 0, b"\xff\xff", 0)
    assert sdo.unsigned == 65535
    for bad in (b"", b"12345"):
        with pytest.raises(ValueError):
            co.download_request(1, 0x1017, 0, bad)


def test_against_the_library_server() -> None:
    network = library.Network()
    sent: list[tuple[int, bytes]] = []
    network.send_message = lambda key, data, remote=False: sent.append((key, bytes(data)))  # type: ignore[method-assign]
    node = network.create_node(5, str(Path(codec.__file__).parents[1] / "encoder_rotary.eds"))

    def ask(request: tuple[int, bytes]) -> co.Sdo | None:
        sent.clear()
        node.sdo.on_request(request[0], bytearray(request[1]), 0.0)
        return co.parse_response(*sent[0])

    answer = ask(co.upload_request(5, 0x1000, 0))
    assert answer and answer.unsigned == 0x00020196
    answer = ask(co.download_request(5, 0x6200, 0, (50).to_bytes(2, "little")))
    assert answer and answer.kind is co.SdoKind.DOWNLOAD
    assert node.sdo[0x6200].raw == 50
    answer = ask(co.upload_request(5, 0x1234, 0))
    assert answer and answer.abort == 0x06020000
    answer = ask(co.upload_request(5, 0x1018, 9))
    assert answer and answer.abort == 0x06090011
