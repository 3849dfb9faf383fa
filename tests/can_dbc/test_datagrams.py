"""The datagrams of crane, vehicle and mission: round trip, every reason to refuse, and arbitrary bytes."""

from __future__ import annotations

import argparse
import dataclasses
import math
import struct
import zlib
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.dbc.codec import load
from can_dbc.messages.crane import (
    MAX_KNOTS,
    N_AXES,
    CraneSetpoint,
    GrappleCommand,
    Knot,
    LinkWatch,
    ModeSwitch,
    OperatorAction,
    OperatorCommand,
    SpoolKnot,
    SpoolTest,
    StateReport,
)
from can_dbc.messages.datagrams import Datagram, decode, encode
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
from can_dbc.messages.udp_address import address_argument, local_address_argument, udp_address
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from runtime.errors import InputRefused
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.codes import coded

KEY = b"a key of the two sides"
BODY_AT = 24  # bytes of the header

u32 = st.integers(0, 2**32 - 1)
u16 = st.integers(0, 2**16 - 1)
u8 = st.integers(0, 255)
stamps = st.integers(0, 2**64 - 1)
microseconds = st.integers(0, 2**32 - 1).map(lambda us: us * 1000)
finite = st.floats(allow_nan=False, allow_infinity=False)
axes = st.tuples(*[finite] * N_AXES)
known_or_nan = st.tuples(*[st.floats(allow_infinity=False)] * N_AXES)


@st.composite
def crane_setpoints(draw: st.DrawFn) -> CraneSetpoint:
    times = draw(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=MAX_KNOTS, unique=True).map(sorted))
    knots = tuple(Knot(us * 1000, draw(axes), draw(axes)) for us in times)
    grapple = draw(st.sampled_from(GrappleCommand))
    return CraneSetpoint(draw(u32), draw(u32), draw(stamps), draw(microseconds), grapple, draw(st.booleans()), knots)


flags = [st.booleans()] * 3
heights = st.tuples(*[finite] * 4)
header = (u32, u32, stamps)
drive_setpoints = st.builds(
    DriveSetpoint, *header, microseconds, st.sampled_from(Steering), *[finite] * 5, heights, *flags
)


@st.composite
def spool_tests(draw: st.DrawFn) -> SpoolTest:
    times = draw(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=MAX_KNOTS, unique=True).map(sorted))
    knots = tuple(SpoolKnot(us * 1000, draw(st.floats(-100.0, 100.0))) for us in times)
    return SpoolTest(draw(u32), draw(u32), draw(stamps), draw(microseconds), draw(st.integers(0, N_AXES - 1)), knots)


operator_commands = st.builds(OperatorCommand, *header, st.sampled_from(OperatorAction), st.integers(0, 0xFFFFFF))
reports = st.builds(
    StateReport,
    *header,
    *(u8, u8, u16, u32, u16, u16, u16),
    *[known_or_nan] * 3,
    *[finite] * 3,
    *[u32] * 4,
    operator_link=st.integers(0, len(LinkWatch) - 1),
    mode_switch=st.integers(0, len(ModeSwitch) - 1),
)
maybe = st.floats(allow_infinity=False)
vehicle_reports = st.builds(
    VehicleReport,
    *header,
    *(u32, u8, u16, u16),
    *(stamps, maybe, maybe, maybe, u8, u8, maybe),
    *(stamps, maybe, maybe),
    *(stamps, maybe, maybe, maybe, maybe),
    st.tuples(*[maybe] * 4),
    u16,
)
datagrams = st.one_of(crane_setpoints(), spool_tests(), drive_setpoints, operator_commands, reports, vehicle_reports)


def a_setpoint(knots: tuple[Knot, ...] | None = None) -> CraneSetpoint:
    knots = knots or tuple(Knot(k * 50_000_000, (0.1, 0.2, -1.0, 0.5, 0.0), (0.0,) * 5) for k in range(9))
    return CraneSetpoint(7, 0xABCD, 123_456_789, 200_000_000, GrappleCommand.HOLD, False, knots)


def a_drive() -> DriveSetpoint:
    heights = (0.35, 0.36, 0.37, 0.38)
    return DriveSetpoint(
        1, 2, 3, 1_000_000, Steering.ARTICULATION, 63.66, 19.9, 0.1, -0.02, 0.6, heights, False, True, True
    )


def a_report(**evidence: Any) -> StateReport:
    known = (1.0,) * 5
    return StateReport(1, 2, 3, 2, 0, 0, 0, 0, 0, 0, known, known, known, 0.0, 0.0, 0.0, 1, 2, 3, 4, **evidence)


A_SPOOL_TEST = SpoolTest(1, 2, 3, 200_000_000, 0, (SpoolKnot(0, 0.0), SpoolKnot(5_000_000, 12.0)))
EVIDENCE: list[dict[str, Any]] = [{}, {"since_ns": 77, "numbers": (20.0, 15.0, 4.0)}]


def sealed(data: bytes) -> bytes:
    """The bytes (without trailer) with a right CRC-32, as an encoder with a defect would send them."""
    return data + struct.pack("<I", zlib.crc32(data))


def fault_of(data: bytes, *key: bytes | None, take: Callable[..., Any] = decode) -> DatagramFault:
    with pytest.raises(DatagramRefused) as refused:
        take(data, *key)
    return refused.value.fault


def same(a: Datagram, b: Datagram) -> bool:
    """Equal fields, NaN equal to NaN."""
    return repr(dataclasses.astuple(a)) == repr(dataclasses.astuple(b))


@given(datagrams, st.sampled_from([None, KEY]))
def test_round_trip_keeps_every_field(message: Datagram, key: bytes | None) -> None:
    back = decode(encode(message, key), key)
    assert type(back) is type(message) and same(back, message)


def test_times_are_truncated_to_a_microsecond() -> None:
    sent = dataclasses.replace(a_setpoint(), lease_ns=200_000_999)
    back = decode(encode(sent))
    assert isinstance(back, CraneSetpoint) and back.lease_ns == 200_000_000


@given(datagrams, st.data())
def test_any_flipped_bit_is_refused(message: Datagram, data: st.DataObject) -> None:
    raw = bytearray(encode(message))
    bit = data.draw(st.integers(0, 8 * len(raw) - 1))
    raw[bit // 8] ^= 1 << bit % 8
    fault_of(bytes(raw))


@given(st.binary(max_size=1500), st.sampled_from([None, KEY]))
def test_noise_is_refused_and_never_raises_anything_else(noise: bytes, key: bytes | None) -> None:
    fault_of(noise, key)


@given(datagrams, st.data())
def test_an_arbitrary_body_in_a_valid_envelope_gives_a_message_or_a_refusal(
    message: Datagram, data: st.DataObject
) -> None:
    body = data.draw(st.binary(max_size=200))
    kind = struct.pack("<H", data.draw(st.integers(0, 7)))
    header = encode(message)[:BODY_AT]
    try:
        decode(sealed(header[:6] + kind + header[8:] + body))
    except DatagramRefused as refused:
        assert refused.fault in (
            DatagramFault.LENGTH,
            DatagramFault.KIND,
            DatagramFault.VALUE,
            DatagramFault.NOT_FINITE,
        )


@given(datagrams, st.data())
def test_a_shortened_or_lengthened_datagram_is_refused(message: Datagram, data: st.DataObject) -> None:
    raw = encode(message)
    cut = data.draw(st.integers(0, len(raw) - 1))
    fault_of(raw[:cut])
    fault_of(raw + b"\0")
    if BODY_AT <= cut < len(raw) - 4:
        assert fault_of(sealed(raw[:cut])) is DatagramFault.LENGTH


WHOLE = encode(a_setpoint())
BARE = WHOLE[:-4]


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"XXXX" + WHOLE[4:], DatagramFault.MAGIC),
        (sealed(BARE[:4] + b"\x02\x00" + BARE[6:]), DatagramFault.VERSION),
        (sealed(BARE[:6] + b"\x63\x00" + BARE[8:]), DatagramFault.KIND),
        (WHOLE[:-1] + bytes([WHOLE[-1] ^ 1]), DatagramFault.CRC),
        (b"", DatagramFault.LENGTH),
        (sealed(WHOLE[:-12]), DatagramFault.LENGTH),
        (sealed(encode(A_SPOOL_TEST)[:-5]), DatagramFault.LENGTH),
        (encode(a_setpoint(), KEY), DatagramFault.LENGTH),
    ],
    ids=["magic", "version", "kind", "crc", "nothing", "cut", "a cut spool test", "authenticated, and no key here"],
)
def test_each_damage_has_its_fault(data: bytes, fault: DatagramFault) -> None:
    assert fault_of(data) is fault


@pytest.mark.parametrize("sent_with", [b"other", None])
def test_authentication(sent_with: bytes | None) -> None:
    assert fault_of(encode(a_setpoint(), sent_with), KEY) is DatagramFault.AUTHENTICATION


def test_a_forged_body_with_a_valid_crc_fails_authentication() -> None:
    raw = bytearray(encode(a_setpoint(), KEY)[:-4])
    raw[BODY_AT + 20] ^= 1
    assert fault_of(sealed(bytes(raw)), KEY) is DatagramFault.AUTHENTICATION


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("in_velocity", [False, True])
def test_not_finite(bad: float, in_velocity: bool) -> None:
    good, poisoned = (0.0,) * 5, (0.0, 0.0, bad, 0.0, 0.0)
    knot = Knot(0, good, poisoned) if in_velocity else Knot(0, poisoned, good)
    assert fault_of(encode(a_setpoint((knot,)))) is DatagramFault.NOT_FINITE


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "name",
    ["latitude_deg", "longitude_deg", "articulation_rad", "articulation_rate_rad_s", "speed_m_s", "heights_m"],
)
def test_a_drive_setpoint_that_is_not_finite_is_refused(name: str, bad: float) -> None:
    value = (0.35, 0.35, 0.35, bad) if name == "heights_m" else bad
    drive = dataclasses.replace(a_drive(), **{name: value})  # type: ignore[arg-type]
    assert fault_of(encode(drive)) is DatagramFault.NOT_FINITE


@pytest.mark.parametrize(
    "times_ms",
    [list(range(MAX_KNOTS + 1)), [50, 50], [100, 50], []],
    ids=["too many knots", "equal times", "falling times", "no knots"],
)
def test_value_knots(times_ms: list[int]) -> None:
    knots = tuple(Knot(ms * 1_000_000, (0.0,) * 5, (0.0,) * 5) for ms in times_ms)
    assert fault_of(encode(dataclasses.replace(a_setpoint(), knots=knots))) is DatagramFault.VALUE


@pytest.mark.parametrize(
    ("message", "at", "value", "fault"),
    [
        pytest.param(a_setpoint(), 4, 9, DatagramFault.VALUE, id="grapple command"),
        pytest.param(a_setpoint(), 5, 2, DatagramFault.VALUE, id="final is 0 or 1"),
        pytest.param(a_setpoint(), 7, 6, DatagramFault.LENGTH, id="another number of axes"),
        pytest.param(OperatorCommand(1, 2, 3, OperatorAction.STOP), 0, 0, DatagramFault.VALUE, id="operator action"),
        pytest.param(a_drive(), 4, 2, DatagramFault.VALUE, id="steering"),
        pytest.param(a_drive(), 5, 8, DatagramFault.VALUE, id="flag 3"),
        pytest.param(a_drive(), 5, 0x80, DatagramFault.VALUE, id="flag 7"),
    ],
)
def test_a_byte_of_the_body_that_means_nothing_is_refused(
    message: Datagram, at: int, value: int, fault: DatagramFault
) -> None:
    raw = bytearray(encode(message)[:-4])
    raw[BODY_AT + at] = value
    assert fault_of(sealed(bytes(raw))) is fault


@pytest.mark.parametrize(
    "text", ["", "5006", "127.0.0.1", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:65536", "nosuch.invalid:6"]
)
def test_an_invalid_address_is_refused(text):
    code = "address.unknown-host" if text.startswith("nosuch") else "address.malformed"
    with pytest.raises(InputRefused, check=coded(code)):
        udp_address(text)
    with pytest.raises(argparse.ArgumentTypeError):
        address_argument(text)


def test_a_socket_on_the_loopback_is_told_no_other_computer():
    """Its first datagram ended the process with "Invalid argument"."""
    assert local_address_argument("127.0.0.1:5006") == ("127.0.0.1", 5006)
    with pytest.raises(argparse.ArgumentTypeError, match=r"192\.0\.2\.7:5006"):
        local_address_argument("192.0.2.7:5006")


def test_an_address_is_resolved_once():
    assert udp_address("localhost:5006") == ("127.0.0.1", 5006)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"knots": (SpoolKnot(0, 100.1),)}, DatagramFault.VALUE),
        ({"knots": (SpoolKnot(0, math.nan),)}, DatagramFault.NOT_FINITE),
        ({"knots": (SpoolKnot(5_000_000, 1.0), SpoolKnot(5_000_000, 2.0))}, DatagramFault.VALUE),
        ({"knots": ()}, DatagramFault.VALUE),
        ({"knots": tuple(SpoolKnot(k * 1000, 0.0) for k in range(MAX_KNOTS + 1))}, DatagramFault.VALUE),
        ({"function": N_AXES}, DatagramFault.VALUE),
    ],
)
def test_an_invalid_spool_test_is_refused(change: dict[str, object], fault: DatagramFault) -> None:
    assert decode(encode(A_SPOOL_TEST)) == A_SPOOL_TEST
    assert fault_of(encode(dataclasses.replace(A_SPOOL_TEST, **change))) is fault  # type: ignore[arg-type]


def test_a_report_carries_the_evidence_of_its_reason_only_while_there_is_one() -> None:
    plain, stopped = (a_report(**evidence) for evidence in EVIDENCE)
    assert decode(encode(plain)) == plain and decode(encode(stopped)) == stopped
    assert len(encode(stopped)) == len(encode(plain)) + 32
    for cut in (1, 8, 30, 31):
        assert fault_of(sealed(encode(stopped)[: -4 - cut])) is DatagramFault.LENGTH


@pytest.mark.parametrize("link", [LinkWatch.WATCHED, LinkWatch.LOST])
@pytest.mark.parametrize("evidence", EVIDENCE)
def test_a_report_tells_of_the_operators_link_only_while_it_is_watched(
    link: LinkWatch, evidence: dict[str, Any]
) -> None:
    told = a_report(**evidence, operator_link=link)
    assert decode(encode(told)) == told and len(encode(told)) == len(encode(a_report(**evidence))) + 1
    for unknown in (0, 3, 255):
        assert fault_of(sealed(encode(told)[:-5] + bytes((unknown,)))) is DatagramFault.LENGTH


@pytest.mark.parametrize("link", list(LinkWatch))
@pytest.mark.parametrize("evidence", EVIDENCE)
def test_a_report_tells_of_the_mode_switch_only_where_there_is_one(link: LinkWatch, evidence: dict[str, Any]) -> None:
    for switch in (ModeSwitch.IDLE, ModeSwitch.AUTO, ModeSwitch.FAULTY):
        told = a_report(**evidence, operator_link=link, mode_switch=switch)
        assert decode(encode(told)) == told and len(encode(told)) == len(encode(a_report(**evidence))) + 2
    for unknown in ((link, 0), (link, 4), (3, 1), (255, 255)):
        assert fault_of(sealed(encode(told)[:-6] + bytes(unknown))) is DatagramFault.LENGTH


def test_the_numbers_of_the_mode_switch_are_those_of_its_signal() -> None:
    (signal,) = (s for s in load("crane").message("EstopStat").signals if s.name == "ModeSwitch")
    assert {n: label.upper() for n, label in signal.choices.items()} == {
        int(switch): switch.name.replace("_", "") for switch in ModeSwitch
    }


# -- missions


def encoded_report(report: MissionReport = MISSION_REPORT, key: bytes | None = None) -> bytes:
    return encode_mission(report, 5, 77, 10**9, key)


def changed(**fields: object) -> bytes:
    """A report with fields that its schema does not know or not allow, and a right checksum."""
    whole = encoded_report()
    body = msgspec.json.encode(msgspec.json.decode(whole[BODY_AT:-4]) | fields)
    return sealed(whole[:BODY_AT] + body)


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
    assert fault_of(changed(**fields), take=decode_mission) is DatagramFault.VALUE


def test_nan_and_infinity_are_refused() -> None:
    lost = msgspec.structs.replace(MISSION_REPORT, driven_m=float("nan"))
    assert fault_of(encoded_report(lost), take=decode_mission) is DatagramFault.VALUE


def test_both_sides_of_a_mission_need_the_same_key() -> None:
    abort = MissionCommand(1, 2, 3, MissionAction.ABORT)
    sealed_by_us, bare = encode_mission_command(abort, KEY), encode_mission_command(abort)
    assert fault_of(sealed_by_us, b"other", take=decode_mission_command) is DatagramFault.AUTHENTICATION
    assert fault_of(bare, KEY, take=decode_mission_command) is DatagramFault.LENGTH
    assert fault_of(encoded_report(), KEY, take=decode_mission) is DatagramFault.AUTHENTICATION


def test_one_kind_is_never_decoded_as_another() -> None:
    """In particular not by the controller."""
    order = encode_mission_command(MissionCommand(1, 2, 3, MissionAction.AUTO))
    press = encode(OperatorCommand(1, 2, 3, OperatorAction.ARM))
    for take, data in (
        (decode, order),
        (decode, encoded_report()),
        (decode_mission_command, press),
        (decode_mission_command, encoded_report()),
        (decode_mission, press),
        (decode_mission, order),
    ):
        assert fault_of(data, take=take) is DatagramFault.KIND


def test_an_unknown_mission_command_is_refused() -> None:
    data = bytearray(encode_mission_command(MissionCommand(1, 2, 3, MissionAction.AUTO))[:-4])
    data[BODY_AT] = 99
    assert fault_of(sealed(bytes(data)), take=decode_mission_command) is DatagramFault.VALUE


def test_a_report_beyond_one_datagram_is_not_sent() -> None:
    long = msgspec.structs.replace(MISSION_REPORT, logs=MISSION_REPORT.logs * 1000)
    with pytest.raises(ValueError, match=str(MAX_BYTES)):
        encoded_report(long)
