"""Mission commands and mission reports: round trip, and refusal of damaged datagrams."""

from __future__ import annotations

import zlib

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramFault, DatagramRefused
from can_dbc.messages.mission import (
    MAX_BYTES,
    MissionAction,
    MissionCommand,
    MissionReport,
    decode_mission,
    decode_mission_command,
    encode_mission,
    encode_mission_command,
)
from tests.can_dbc.example_mission_report import MISSION_REPORT

KEY = b"secret"


def encoded_report(report: MissionReport = MISSION_REPORT, key: bytes | None = None) -> bytes:
    return encode_mission(report, 5, 77, 10**9, key)


def changed(**fields: object) -> bytes:
    """A report with fields that its schema does not know or not allow, and a right checksum."""
    whole = encoded_report()
    body = msgspec.json.encode(msgspec.json.decode(whole[24:-4]) | fields)
    data = whole[:24] + body
    return data + zlib.crc32(data).to_bytes(4, "little")


def fault_of(take, *arguments) -> DatagramFault:
    with pytest.raises(DatagramRefused) as refused:
        take(*arguments)
    return refused.value.fault


@pytest.mark.parametrize("key", [None, KEY])
def test_a_report_is_decoded_as_it_was_encoded(key) -> None:
    assert decode_mission(encoded_report(key=key), key) == (77, 10**9, MISSION_REPORT)


@given(st.sampled_from(MissionAction), st.integers(0, 2**32 - 1), st.integers(0, 2**63), st.sampled_from([None, KEY]))
def test_a_command_is_decoded(order, sequence, stamp_ns, key) -> None:
    message = MissionCommand(sequence, 77, stamp_ns, order)
    assert decode_mission_command(encode_mission_command(message, key), key) == message


@pytest.mark.parametrize(
    "fields",
    [
        {"schema": 2},
        {"extra": 1},
        {"loaded": -1},
        {"words": "x" * 121},
        {"state": None},
        {"route": [[91.0, 0.0]]},
        {"route": [[0.0]]},
        {"route": [[1.0, 2.0]] * 301},
        {"driven_m": "far"},
        {"fences": [{"corners": [], "keep_out": False, "name": ""}] * 21},
        {"fences": [{"corners": [[1.0, 2.0]] * 200, "keep_out": False, "name": ""}] * 2},
    ],
)
def test_a_report_that_does_not_match_its_schema_is_refused(fields) -> None:
    assert decode_mission(changed())[2] == MISSION_REPORT, "the way to make one is right"
    assert fault_of(decode_mission, changed(**fields)) is DatagramFault.VALUE


def test_nan_and_infinity_are_refused() -> None:
    lost = msgspec.structs.replace(MISSION_REPORT, driven_m=float("nan"))
    assert fault_of(decode_mission, encoded_report(lost)) is DatagramFault.VALUE


def test_both_sides_need_the_same_key() -> None:
    order = encode_mission_command(MissionCommand(1, 2, 3, MissionAction.ABORT), KEY)
    assert fault_of(decode_mission_command, order, b"other") is DatagramFault.AUTHENTICATION
    assert (
        fault_of(decode_mission_command, encode_mission_command(MissionCommand(1, 2, 3, MissionAction.ABORT)), KEY)
        is not None
    )
    assert fault_of(decode_mission, encoded_report(), KEY) is DatagramFault.AUTHENTICATION


def test_one_kind_is_never_decoded_as_another() -> None:
    """In particular not by the controller."""
    order = encode_mission_command(MissionCommand(1, 2, 3, MissionAction.AUTO))
    press = encode(OperatorCommand(1, 2, 3, OperatorAction.ARM))
    for decoder, data in (
        (decode, order),
        (decode, encoded_report()),
        (decode_mission_command, press),
        (decode_mission_command, encoded_report()),
        (decode_mission, press),
        (decode_mission, order),
    ):
        assert fault_of(decoder, data) is DatagramFault.KIND


def test_an_unknown_command_is_refused() -> None:
    data = bytearray(encode_mission_command(MissionCommand(1, 2, 3, MissionAction.AUTO))[:-4])
    data[24] = 99
    assert fault_of(decode_mission_command, bytes(data) + zlib.crc32(data).to_bytes(4, "little")) is DatagramFault.VALUE


def test_a_report_beyond_one_datagram_is_not_sent() -> None:
    long = msgspec.structs.replace(MISSION_REPORT, logs=MISSION_REPORT.logs * 1000)
    with pytest.raises(ValueError, match=str(MAX_BYTES)):
        encoded_report(long)
