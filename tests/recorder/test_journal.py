"""Entries for systemd's journal: their bytes, their fields, and a host without a journal."""

from __future__ import annotations

import socket
import struct
from pathlib import Path

from machine.status.explanation import message_id
from machine.status.reasons import Reason, pack
from recorder import __main__
from recorder.__main__ import write_to_journal
from recorder.stop_recorder import Stop
from tests.codes import numbers_in

STOP = Stop(
    number=4,
    at_ns=5,
    utc_ns=6,
    mode_before="ACTIVE",
    mode="STOP",
    reason=pack(Reason.ENCODER_LOST, 1),
    code="ENCODER_LOST",
    numbers=(20.0, 15.0, 0.0),
    text="The encoder of joint lift ... [ENCODER_LOST]",
)


def fields_in(data: bytes) -> dict[str, str]:
    """The fields of a datagram, read as systemd's journald reads them."""
    found, at = {}, 0
    while at < len(data):
        end = data.index(b"\n", at)
        name, equals, value = data[at:end].partition(b"=")
        at = end + 1
        if not equals:
            (length,) = struct.unpack_from("<Q", data, at)
            value = data[at + 8 : at + 8 + length]
            assert data[at + 8 + length : at + 9 + length] == b"\n"
            at += 9 + length
        found[name.decode()] = value.decode()
    return found


def test_a_value_with_a_line_feed_is_written_with_its_length() -> None:
    fields = {"MESSAGE": "two\nlines = 2", "PRIORITY": "3", "CODE": "a=b"}
    assert fields_in(__main__.encode(fields)) == fields


def test_a_stop_has_its_identity_its_numbers_and_its_file(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        receiver.settimeout(5)
        assert __main__.send(__main__.stop_fields(STOP, Path("/stops/4.mcap")), path)
        got = fields_in(receiver.recv(65536))
    assert got["MESSAGE_ID"] == message_id(Reason.ENCODER_LOST)
    assert got["MESSAGE"] == f"STOP: {STOP.text}" and got["PRIORITY"] == "3"
    assert got["TIMBERHAND_CODE"] == "ENCODER_LOST" and got["TIMBERHAND_PART"] == "joint lift"
    assert numbers_in(got["TIMBERHAND_MEASURED"])[:2] == [20.0, 15.0]
    assert (got["TIMBERHAND_MODE_BEFORE"], got["TIMBERHAND_FILE"]) == ("ACTIVE", "/stops/4.mcap")


def test_without_a_journal_the_text_goes_to_stderr(tmp_path: Path, monkeypatch, capfd) -> None:
    assert not __main__.send({"MESSAGE": "x"}, tmp_path / "none")
    monkeypatch.setattr(__main__.send, "__defaults__", (tmp_path / "none",))
    write_to_journal(STOP, Path("/stops/4.mcap"))
    assert capfd.readouterr().err == f"recorder: STOP: {STOP.text} /stops/4.mcap\n"


def test_a_reason_of_another_release_has_no_identity() -> None:
    import msgspec

    unknown = msgspec.structs.replace(STOP, reason=250, code="REASON_250", text="Unknown reason 250.")
    fields = __main__.stop_fields(unknown, Path("x"))
    assert "MESSAGE_ID" not in fields and fields["PRIORITY"] == "3" and "250" in fields["MESSAGE"]
