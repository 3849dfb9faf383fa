"""The datagrams of crane and vehicle: round trip, every reason to refuse, and arbitrary bytes."""

from __future__ import annotations

import argparse
import dataclasses
import math
import struct
import zlib
from typing import Any

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
from can_dbc.messages.udp_address import address_argument, udp_address
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from runtime.errors import InputRefused
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


heights = st.tuples(*[finite] * 4)
drive_setpoints = st.builds(
    DriveSetpoint,
    u32,
    u32,
    stamps,
    microseconds,
    st.sampled_from(Steering),
    finite,
    finite,
    finite,
    finite,
    finite,
    heights,
    st.booleans(),
    st.booleans(),
    st.booleans(),
)


@st.composite
def spool_tests(draw: st.DrawFn) -> SpoolTest:
    times = draw(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=MAX_KNOTS, unique=True).map(sorted))
    knots = tuple(SpoolKnot(us * 1000, draw(st.floats(-100.0, 100.0))) for us in times)
    return SpoolTest(draw(u32), draw(u32), draw(stamps), draw(microseconds), draw(st.integers(0, N_AXES - 1)), knots)


operator_commands = st.builds(
    OperatorCommand, u32, u32, stamps, st.sampled_from(OperatorAction), st.integers(0, 0xFFFFFF)
)
reports = st.builds(
    StateReport,
    u32,
    u32,
    stamps,
    u8,
    u8,
    u16,
    u32,
    u16,
    u16,
    u16,
    known_or_nan,
    known_or_nan,
    known_or_nan,
    finite,
    finite,
    finite,
    u32,
    u32,
    u32,
    u32,
    operator_link=st.integers(0, len(LinkWatch) - 1),
    mode_switch=st.integers(0, len(ModeSwitch) - 1),
)
maybe = st.floats(allow_infinity=False)
vehicle_reports = st.builds(
    VehicleReport,
    u32,
    u32,
    stamps,
    u32,
    u8,
    u16,
    u16,
    stamps,
    maybe,
    maybe,
    maybe,
    u8,
    u8,
    maybe,
    stamps,
    maybe,
    maybe,
    stamps,
    maybe,
    maybe,
    maybe,
    maybe,
    st.tuples(*[maybe] * 4),
    u16,
)
datagrams = st.one_of(crane_setpoints(), spool_tests(), drive_setpoints, operator_commands, reports, vehicle_reports)


def a_setpoint(knots: tuple[Knot, ...] | None = None) -> CraneSetpoint:
    knots = knots or tuple(Knot(k * 50_000_000, (0.1, 0.2, -1.0, 0.5, 0.0), (0.0,) * 5) for k in range(9))
    return CraneSetpoint(7, 0xABCD, 123_456_789, 200_000_000, GrappleCommand.HOLD, False, knots)


def sealed(data: bytes) -> bytes:
    """The bytes (without trailer) with a right CRC-32, as an encoder with a defect would send them."""
    return data + struct.pack("<I", zlib.crc32(data))


def fault_of(data: bytes, key: bytes | None = None) -> DatagramFault:
    with pytest.raises(DatagramRefused) as refused:
        decode(data, key)
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


def test_magic() -> None:
    assert fault_of(b"XXXX" + encode(a_setpoint())[4:]) is DatagramFault.MAGIC


def test_version() -> None:
    raw = encode(a_setpoint())[:-4]
    assert fault_of(sealed(raw[:4] + b"\x02\x00" + raw[6:])) is DatagramFault.VERSION


def test_kind() -> None:
    raw = encode(a_setpoint())[:-4]
    assert fault_of(sealed(raw[:6] + b"\x63\x00" + raw[8:])) is DatagramFault.KIND


def test_crc() -> None:
    raw = encode(a_setpoint())
    assert fault_of(raw[:-1] + bytes([raw[-1] ^ 1])) is DatagramFault.CRC


def test_length() -> None:
    assert fault_of(b"") is DatagramFault.LENGTH
    assert fault_of(sealed(encode(a_setpoint())[:-12])) is DatagramFault.LENGTH


@pytest.mark.parametrize(("sent_with", "read_with"), [(b"other", KEY), (None, KEY)])
def test_authentication(sent_with: bytes | None, read_with: bytes) -> None:
    assert fault_of(encode(a_setpoint(), sent_with), read_with) is DatagramFault.AUTHENTICATION


def test_a_forged_body_with_a_valid_crc_fails_authentication() -> None:
    raw = bytearray(encode(a_setpoint(), KEY)[:-4])
    raw[BODY_AT + 20] ^= 1
    assert fault_of(sealed(bytes(raw)), KEY) is DatagramFault.AUTHENTICATION


def test_a_receiver_without_a_key_refuses_an_authenticated_setpoint() -> None:
    assert fault_of(encode(a_setpoint(), KEY)) is DatagramFault.LENGTH


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("in_velocity", [False, True])
def test_not_finite(bad: float, in_velocity: bool) -> None:
    good, poisoned = (0.0,) * 5, (0.0, 0.0, bad, 0.0, 0.0)
    knot = Knot(0, good, poisoned) if in_velocity else Knot(0, poisoned, good)
    assert fault_of(encode(a_setpoint((knot,)))) is DatagramFault.NOT_FINITE


def a_drive() -> DriveSetpoint:
    heights = (0.35, 0.36, 0.37, 0.38)
    return DriveSetpoint(
        1, 2, 3, 1_000_000, Steering.ARTICULATION, 63.66, 19.9, 0.1, -0.02, 0.6, heights, False, True, True
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "name",
    ["latitude_deg", "longitude_deg", "articulation_rad", "articulation_rate_rad_s", "speed_m_s", "heights_m"],
)
def test_a_drive_setpoint_that_is_not_finite_is_refused(name: str, bad: float) -> None:
    value = (0.35, 0.35, 0.35, bad) if name == "heights_m" else bad
    drive = dataclasses.replace(a_drive(), **{name: value})  # type: ignore[arg-type]
    assert fault_of(encode(drive)) is DatagramFault.NOT_FINITE


@pytest.mark.parametrize(("at", "value"), [(4, 2), (5, 8), (5, 0x80)], ids=["steering", "flag 3", "flag 7"])
def test_value_of_a_drive_setpoint(at: int, value: int) -> None:
    raw = bytearray(encode(a_drive())[:-4])
    raw[BODY_AT + at] = value
    assert fault_of(sealed(bytes(raw))) is DatagramFault.VALUE


def test_a_vehicle_report_may_hold_unknown_values() -> None:
    nan = math.nan
    unknown = (nan,) * 4
    report = VehicleReport(
        1, 2, 3, 4, 1, 0, 0, 0, nan, nan, nan, 0, 0, nan, 0, nan, nan, 0, nan, nan, nan, nan, unknown, 0xFF
    )
    back = decode(encode(report))
    assert isinstance(back, VehicleReport) and math.isnan(back.heights_m[3]) and back.stale_mask == 0xFF


def test_a_report_may_hold_unknown_values() -> None:
    unknown = (math.nan,) * 5
    report = StateReport(1, 2, 3, 2, 0, 0, 0, 0, 0, 0, unknown, unknown, unknown, math.nan, 0.0, 0.0, 1, 2, 3, 4)
    back = decode(encode(report))
    assert isinstance(back, StateReport) and math.isnan(back.opening_pct) and math.isnan(back.position[0])


@pytest.mark.parametrize(
    "knots",
    [
        tuple(Knot(k * 1_000_000, (0.0,) * 5, (0.0,) * 5) for k in range(MAX_KNOTS + 1)),
        (Knot(50_000_000, (0.0,) * 5, (0.0,) * 5), Knot(50_000_000, (0.0,) * 5, (0.0,) * 5)),
        (Knot(100_000_000, (0.0,) * 5, (0.0,) * 5), Knot(50_000_000, (0.0,) * 5, (0.0,) * 5)),
    ],
    ids=["too many knots", "equal times", "falling times"],
)
def test_value_knots(knots: tuple[Knot, ...]) -> None:
    assert fault_of(encode(a_setpoint(knots))) is DatagramFault.VALUE


def test_value_no_knots() -> None:
    assert fault_of(encode(dataclasses.replace(a_setpoint(), knots=()))) is DatagramFault.VALUE


def test_value_enumerations() -> None:
    raw = bytearray(encode(a_setpoint())[:-4])
    raw[BODY_AT + 4] = 9  # grapple command
    assert fault_of(sealed(bytes(raw))) is DatagramFault.VALUE
    raw = bytearray(encode(a_setpoint())[:-4])
    raw[BODY_AT + 5] = 2  # final is 0 or 1
    assert fault_of(sealed(bytes(raw))) is DatagramFault.VALUE
    operator = bytearray(encode(OperatorCommand(1, 2, 3, OperatorAction.STOP))[:-4])
    operator[BODY_AT] = 0
    assert fault_of(sealed(bytes(operator))) is DatagramFault.VALUE


def test_another_number_of_axes_is_refused() -> None:
    raw = bytearray(encode(a_setpoint())[:-4])
    raw[BODY_AT + 7] = 6
    assert fault_of(sealed(bytes(raw))) is DatagramFault.LENGTH


def test_a_refusal_has_its_reason() -> None:
    with pytest.raises(DatagramRefused, check=lambda e: e.fault is DatagramFault.NOT_FINITE):
        decode(encode(a_setpoint((Knot(0, (math.nan,) * 5, (0.0,) * 5),))))


@pytest.mark.parametrize(
    "text", ["", "5006", "127.0.0.1", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:65536", "nosuch.invalid:6"]
)
def test_an_invalid_address_is_refused(text):
    code = "address.unknown-host" if text.startswith("nosuch") else "address.malformed"
    with pytest.raises(InputRefused, check=coded(code)):
        udp_address(text)
    with pytest.raises(argparse.ArgumentTypeError):
        address_argument(text)


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
    good = SpoolTest(1, 2, 3, 200_000_000, 0, (SpoolKnot(0, 0.0), SpoolKnot(5_000_000, 12.0)))
    assert decode(encode(good)) == good
    assert fault_of(encode(dataclasses.replace(good, **change))) is fault  # type: ignore[arg-type]


def test_a_spool_test_of_a_wrong_length_is_refused() -> None:
    raw = encode(SpoolTest(1, 2, 3, 200_000_000, 0, (SpoolKnot(0, 0.0), SpoolKnot(5_000_000, 12.0))))
    assert fault_of(sealed(raw[:-5])) is DatagramFault.LENGTH


def test_a_report_carries_the_evidence_of_its_reason_only_while_there_is_one() -> None:
    known = (1.0,) * 5
    plain = StateReport(1, 2, 3, 2, 0, 0, 0, 0, 0, 0, known, known, known, 0.0, 0.0, 0.0, 1, 2, 3, 4)
    stopped = dataclasses.replace(plain, since_ns=77, numbers=(20.0, 15.0, 4.0))
    assert decode(encode(plain)) == plain and decode(encode(stopped)) == stopped
    assert len(encode(stopped)) == len(encode(plain)) + 32
    body = encode(stopped)[:-4]
    for cut in (1, 8, 30, 31):
        data = body[:-cut]
        with pytest.raises(DatagramRefused) as refused:
            decode(data + struct.pack("<I", zlib.crc32(data)))
        assert refused.value.fault is DatagramFault.LENGTH


@pytest.mark.parametrize("link", [LinkWatch.WATCHED, LinkWatch.LOST])
@pytest.mark.parametrize("evidence", [{}, {"since_ns": 77, "numbers": (20.0, 15.0, 4.0)}])
def test_a_report_tells_of_the_operators_link_only_while_it_is_watched(
    link: LinkWatch, evidence: dict[str, Any]
) -> None:
    known = (1.0,) * 5
    plain = StateReport(1, 2, 3, 2, 0, 0, 0, 0, 0, 0, known, known, known, 0.0, 0.0, 0.0, 1, 2, 3, 4, **evidence)
    told = dataclasses.replace(plain, operator_link=link)
    assert decode(encode(told)) == told and len(encode(told)) == len(encode(plain)) + 1
    for unknown in (0, 3, 255):
        data = encode(told)[:-5] + bytes((unknown,))
        with pytest.raises(DatagramRefused) as refused:
            decode(data + struct.pack("<I", zlib.crc32(data)))
        assert refused.value.fault is DatagramFault.LENGTH


@pytest.mark.parametrize("link", list(LinkWatch))
@pytest.mark.parametrize("evidence", [{}, {"since_ns": 77, "numbers": (20.0, 15.0, 4.0)}])
def test_a_report_tells_of_the_mode_switch_only_where_there_is_one(link: LinkWatch, evidence: dict[str, Any]) -> None:
    known = (1.0,) * 5
    plain = StateReport(1, 2, 3, 2, 0, 0, 0, 0, 0, 0, known, known, known, 0.0, 0.0, 0.0, 1, 2, 3, 4, **evidence)
    for switch in (ModeSwitch.IDLE, ModeSwitch.AUTO, ModeSwitch.FAULTY):
        told = dataclasses.replace(plain, operator_link=link, mode_switch=switch)
        assert decode(encode(told)) == told and len(encode(told)) == len(encode(plain)) + 2
    for unknown in ((link, 0), (link, 4), (3, 1), (255, 255)):
        data = encode(told)[:-6] + bytes(unknown)
        with pytest.raises(DatagramRefused) as refused:
            decode(data + struct.pack("<I", zlib.crc32(data)))
        assert refused.value.fault is DatagramFault.LENGTH


def test_the_numbers_of_the_mode_switch_are_those_of_its_signal() -> None:
    (signal,) = (s for s in load("crane").message("EstopStat").signals if s.name == "ModeSwitch")
    assert {n: label.upper() for n, label in signal.choices.items()} == {
        int(switch): switch.name.replace("_", "") for switch in ModeSwitch
    }
