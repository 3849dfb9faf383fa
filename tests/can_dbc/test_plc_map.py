"""The register map and the cyclic datagrams of a PLC: sizes, round trips, and what they refuse."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.plc import map as plc
from can_dbc.plc.datagram import (
    COMMAND_BYTES,
    MAC_BYTES,
    REPLY_BYTES,
    Header,
    decode_command,
    decode_reply,
    encode_command,
    encode_reply,
)
from can_dbc.plc.map import (
    COMMAND_COUNT,
    N_AXES,
    N_PRESSURES,
    STATUS_COUNT,
    Bounds,
    Command,
    Feedback,
    Grapple,
    MapError,
    Mode,
    Role,
    State,
    WordOrder,
    advances,
    command_registers,
    read_command,
    read_status,
    status_registers,
)
from runtime.errors import InputRefused
from tests.codes import coded

U16 = st.integers(0, 0xFFFF)
MICROS = st.integers(-(1 << 31), (1 << 31) - 1).map(lambda n: n / 1e6)
MILLIS = st.integers(-(1 << 15), (1 << 15) - 1).map(lambda n: n / 1e3)
COMMANDS = st.builds(
    Command,
    mode=st.sampled_from(Mode),
    armed=st.booleans(),
    reference=st.tuples(*[MICROS] * N_AXES),
    rate=st.tuples(*[MILLIS] * N_AXES),
    grapple=st.sampled_from(Grapple),
    grapple_pct=st.integers(0, 100),
    max_speed_pct=st.integers(0, 100),
    reset=st.booleans(),
)
FEEDBACKS = st.builds(
    Feedback,
    heartbeat=U16,
    state=st.sampled_from(State),
    fault=U16,
    fault_axis=U16,
    estop=U16,
    accepted=U16,
    longest_cycle_us=U16,
    position=st.tuples(*[MICROS] * N_AXES),
    velocity=st.tuples(*[MILLIS] * N_AXES),
    pressure_bar=st.tuples(*[st.integers(-(1 << 15), (1 << 15) - 1).map(lambda n: n / 10.0)] * N_PRESSURES),
    opening=st.integers(0, 1000).map(lambda n: n / 1e3),
    load_kg=U16,
    estop_frame=st.binary(min_size=8, max_size=8),
    sampled_us=U16,
    output=st.tuples(*[MILLIS] * N_AXES),
)


@settings(max_examples=50)
@given(COMMANDS, U16, U16, st.sampled_from(WordOrder))
def test_a_command_survives_the_round_trip(command: Command, heartbeat: int, sequence: int, order: WordOrder) -> None:
    registers = command_registers(command, heartbeat, sequence, order)
    assert len(registers) == COMMAND_COUNT and all(0 <= r <= 0xFFFF for r in registers)
    assert registers[:2] == [heartbeat, sequence]
    assert read_command(registers, order) == command


@settings(max_examples=50)
@given(FEEDBACKS, U16, st.sampled_from(WordOrder))
def test_a_status_survives_the_round_trip(feedback: Feedback, watchdog_ms: int, order: WordOrder) -> None:
    registers = status_registers(feedback, watchdog_ms, order)
    assert len(registers) == STATUS_COUNT and all(0 <= r <= 0xFFFF for r in registers)
    assert read_status(registers, order) == (feedback, watchdog_ms)


def test_the_addresses_are_those_of_the_map() -> None:
    """Addresses 0-55 and 100-131 as documented, with a distinct value in each register."""
    feedback = Feedback(
        heartbeat=11,
        state=State.EXECUTE,
        fault=1,
        fault_axis=3,
        estop=7,
        accepted=21,
        longest_cycle_us=31,
        position=(0.065537, -0.000001, 0.0, 0.0, 0.0, 0.0, 0.0),
        velocity=(0.001, -0.001, 0.0, 0.0, 0.0, 0.0, 0.007),
        pressure_bar=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        opening=0.5,
        load_kg=77,
        estop_frame=bytes(range(1, 9)),
        sampled_us=0xABCD,
        output=(1.0, -1.0, 0.001, 0.0, 0.0, 0.25, 0.0),
    )
    status = status_registers(feedback, 300, WordOrder.HIGH_FIRST)
    assert status[:12] == [0x4352, 3, 0x0102, 0x0304, 11, 2, 1, 3, 7, 21, 31, 300]
    assert status[12:16] == [1, 1, 0xFFFF, 0xFFFF]
    assert (status[26], status[27], status[32]) == (1, 0xFFFF, 7)
    assert status[33:48] == [1, 2, 3, 4, 5, 6, 7, 8, 500, 77, 0x0102, 0x0304, 0x0506, 0x0708, 0xABCD]
    assert status[48:] == [1000, 0xFC18, 1, 0, 0, 250, 0, 0]
    low = status_registers(feedback, 300, WordOrder.LOW_FIRST)
    assert (low[2:4], low[12:14]) == ([0x0304, 0x0102], [1, 1])
    command = Command(
        mode=Mode.VALVES,
        armed=True,
        reference=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.000001),
        rate=(0.002,) * N_AXES,
        grapple=Grapple.HOLD,
        grapple_pct=20,
        max_speed_pct=50,
        reset=True,
    )
    block = command_registers(command, 5, 6, WordOrder.HIGH_FIRST)
    assert block[:6] == [5, 6, 2, 0x5AA5, 0x000F, 0x4240]
    assert block[16:] == [0xFFFF, 0xFFFF, 2, 2, 2, 2, 2, 2, 2, 3, 20, 50, 1, 0, 0, 0]


@pytest.mark.parametrize(
    ("order", "registers", "code", "named"),
    [
        (WordOrder.HIGH_FIRST, (0x0304, 0x0102), "plc.word-order", "LOW_FIRST"),
        (WordOrder.LOW_FIRST, (0x0102, 0x0304), "plc.word-order", "HIGH_FIRST"),
        (WordOrder.HIGH_FIRST, (0x0201, 0x0403), "plc.byte-order", "0x02010403"),
    ],
)
def test_the_word_order_test_names_the_problem(
    order: WordOrder, registers: tuple[int, int], code: str, named: str
) -> None:
    status = status_registers(Feedback(), 300, order)
    status[2:4] = registers
    with pytest.raises(MapError, check=coded(code)) as refused:
        read_status(status, order)
    assert named in str(refused.value)


@pytest.mark.parametrize(("register", "value"), [(0, 0x5243), (1, 1), (5, 3), (5, 9)])
def test_a_status_of_another_map_is_refused(register: int, value: int) -> None:
    status = status_registers(Feedback(), 300, WordOrder.HIGH_FIRST)
    status[register] = value
    with pytest.raises(MapError):
        read_status(status, WordOrder.HIGH_FIRST)


@pytest.mark.parametrize(
    "command",
    [
        Command(reference=(math.nan,) + (0.0,) * 6),
        Command(rate=(math.inf,) + (0.0,) * 6),
        Command(reference=(2147.4836481,) + (0.0,) * 6),
        Command(rate=(32.768,) + (0.0,) * 6),
        Command(grapple_pct=101),
        Command(max_speed_pct=-1),
        Command(reference=(0.0,) * 6),
    ],
)
def test_a_value_that_does_not_fit_is_refused_and_never_clamped(command: Command) -> None:
    with pytest.raises(MapError):
        command_registers(command, 0, 1, WordOrder.HIGH_FIRST)


@pytest.mark.parametrize(
    ("register", "value"), [(102, 3), (103, 0x5AA4), (125, 4), (126, 101), (127, 101), (128, 2), (129, 1), (131, 9)]
)
def test_an_undefined_command_is_refused(register: int, value: int) -> None:
    block = command_registers(Command(), 0, 1, WordOrder.HIGH_FIRST)
    block[register - plc.COMMAND_AT] = value
    with pytest.raises(MapError, check=coded("plc.illegal-value")) as refused:
        read_command(block, WordOrder.HIGH_FIRST)
    assert str(register) in str(refused.value)


def test_bounds_name_the_axis() -> None:
    bounds = Bounds.references([(-1.0, 1.0, 0.5)] * 5)
    bounds.check(Command(Mode.REFERENCES, True, (1.05, *(0.0,) * 6), (0.5, *(0.0,) * 6)))
    bounds.check(Command(Mode.NEUTRAL, True, (9.0,) * 7))
    for reference, rate, axis in [
        ((0.0, 1.051, 0, 0, 0, 0, 0), (0.0,) * 7, 1),
        ((0.0,) * 7, (0.0, 0.0, -0.502, 0, 0, 0, 0), 2),
        ((0.0, 0, 0, 0, 0, 0.1, 0), (0.0,) * 7, 5),
    ]:
        with pytest.raises(MapError) as refused:
            bounds.check(Command(Mode.REFERENCES, True, reference, rate))
        assert refused.value.axis == axis
    with pytest.raises(MapError, check=coded("plc.role")):
        bounds.check(Command(Mode.VALVES, True))
    with pytest.raises(MapError):
        Bounds.valves().check(Command(Mode.VALVES, True, (1.01, *(0.0,) * 6)))
    assert Bounds.valves().role is Role.VALVES


@settings(max_examples=50)
@given(st.integers(0, 0xFFFF), st.integers(1, 0x7FFE))
def test_a_sequence_number_advances_and_wraps(last: int, step: int) -> None:
    ahead = (last + step) & 0xFFFF
    assert advances(ahead, last)
    assert not advances(last, ahead) and not advances(last, last)


# -- cyclic datagrams

U32 = st.integers(0, 0xFFFF_FFFF)
HEADERS = st.builds(Header, U32, U32, st.integers(0, (1 << 64) - 1), U32)
AXES = st.tuples(*[MICROS] * N_AXES)
COMMAND = Command(
    Mode.REFERENCES, True, (0.1, -0.2, 0.3, 0.4, -0.5, 0.0, 0.0), (0.01,) * 7, Grapple.CLOSE, 100, 50, True
)
ESTOP = bytes(range(8, 16))
FEEDBACK = Feedback(7, State.EXECUTE, 1, 2, 7, 9, 444, (0.1,) * 7, (-0.2,) * 7, (-1.5,) * 8, 0.25, 120, ESTOP, 54321)
KEY = b"a key of sixteen"


@settings(max_examples=50)
@given(HEADERS, AXES, AXES)
def test_a_command_survives_a_datagram(header: Header, reference: tuple[float, ...], rate: tuple[float, ...]) -> None:
    command = Command(Mode.REFERENCES, True, reference, rate, Grapple.OPEN, 100, 50)
    data = encode_command(header, command)
    assert len(data) == COMMAND_BYTES == 100
    assert decode_command(data) == (header, command)


@settings(max_examples=50)
@given(HEADERS, AXES, AXES, FEEDBACKS)
def test_a_reply_survives_a_datagram(
    header: Header, position: tuple[float, ...], velocity: tuple[float, ...], feedback: Feedback
) -> None:
    told = {"heartbeat": header.sequence & 0xFFFF, "accepted": header.echo & 0xFFFF}
    feedback = replace(feedback, position=position, velocity=velocity, **told)
    data = encode_reply(header, feedback)
    assert len(data) == REPLY_BYTES == 144
    assert decode_reply(data) == (header, feedback)


def test_the_layout_is_that_of_the_table() -> None:
    """Read with plain offsets, little-endian: header 32, seven pairs, end."""
    data = encode_command(Header(77, 5, 1_000_000, 3), COMMAND)
    assert struct.unpack_from("<4sHHIIQIHH", data) == (b"CRN1", 3, 1, 77, 5, 1_000_000, 3, 1, 0x5AA5)
    assert struct.unpack_from("<ii", data, 32) == (100_000, 10_000)
    assert struct.unpack_from("<4H", data, 88) == (2, 100, 50, 1)
    assert struct.unpack_from("<I", data, 96)[0] == zlib.crc32(data[:96])
    reply = encode_reply(Header(77, 7, 8, 9), FEEDBACK)
    assert struct.unpack_from("<4sHHIIQIHH", reply) == (b"CRN1", 3, 2, 77, 7, 8, 9, 2, 0x5AA5)
    assert struct.unpack_from("<8h6H8sH", reply, 88) == (*(-15,) * 8, 7, 1, 2, 444, 250, 120, ESTOP, 54321)


@settings(max_examples=50)
@given(st.data())
def test_one_changed_byte_is_refused(data: st.DataObject) -> None:
    for good, decode in (
        (encode_command(Header(9, 1, 2, 3), COMMAND), decode_command),
        (encode_reply(Header(9, 1, 2, 3), FEEDBACK), decode_reply),
    ):
        at = data.draw(st.integers(0, len(good) - 1))
        flip = data.draw(st.integers(1, 255))
        bad = good[:at] + bytes((good[at] ^ flip,)) + good[at + 1 :]
        with pytest.raises(InputRefused):
            decode(bad)


@settings(max_examples=50)
@given(st.binary(max_size=200))
def test_noise_is_refused(data: bytes) -> None:
    for decode in (decode_command, decode_reply):
        with pytest.raises(InputRefused):
            decode(data)


@pytest.mark.parametrize(("at", "value"), [(28, 3), (30, 0x5AA4), (88, 4), (90, 101), (92, 101), (94, 2)])
def test_an_undefined_command_of_a_datagram_is_refused_by_its_value(at: int, value: int) -> None:
    """The checksum is valid, so the sender meant it: a fault, not a damaged datagram."""
    data = bytearray(encode_command(Header(9, 1, 2, 3), COMMAND))
    struct.pack_into("<H", data, at, value)
    struct.pack_into("<I", data, 96, zlib.crc32(data[:96]))
    with pytest.raises(MapError):
        decode_command(bytes(data))


def test_a_value_that_does_not_fit_is_not_sent() -> None:
    with pytest.raises(MapError):
        encode_command(Header(9, 1, 2, 3), Command(reference=(3000.0,) + (0.0,) * 6))
    with pytest.raises(MapError):
        encode_reply(Header(9, 1, 2, 3), Feedback(opening=1.5))


def test_a_safety_frame_has_eight_bytes() -> None:
    with pytest.raises(MapError, check=coded("plc.estop-frame")):
        encode_reply(Header(9, 1, 2, 3), Feedback(estop_frame=bytes(7)))


@settings(max_examples=20)
@given(st.integers(0, COMMAND_BYTES - 5), st.integers(1, 255))
def test_a_datagram_with_a_key_is_refused_when_its_contents_were_changed(at: int, flip: int) -> None:
    """Whoever changes it can make the checksum right, and not the authentication."""
    good = encode_command(Header(9, 1, 2, 3), COMMAND, KEY)
    assert len(good) == COMMAND_BYTES + MAC_BYTES and decode_command(good, KEY)[1] == COMMAND
    bad = bytearray(good)
    bad[at] ^= flip
    struct.pack_into("<I", bad, len(bad) - 4, zlib.crc32(bad[:-4]))
    with pytest.raises(InputRefused):
        decode_command(bytes(bad), KEY)


def test_a_key_must_be_the_same_on_both_sides() -> None:
    keyed, plain = (encode_reply(Header(9, 1, 2, 3), FEEDBACK, key) for key in (KEY, None))
    assert decode_reply(keyed, KEY) == decode_reply(plain)
    for data, key in ((keyed, None), (plain, KEY)):
        with pytest.raises(InputRefused, check=coded("plc-datagram.length")):
            decode_reply(data, key)
    with pytest.raises(InputRefused, check=coded("plc-datagram.authentication")):
        decode_reply(keyed, b"another key of 16")
