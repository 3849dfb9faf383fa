"""The cyclic datagrams: sizes, round trips, and refusal of damaged ones."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
from can_dbc.plc.map import Command, Feedback, Grapple, MapError, Mode, State
from runtime.errors import InputRefused
from tests.codes import coded

U32 = st.integers(0, 0xFFFF_FFFF)
HEADERS = st.builds(Header, U32, U32, st.integers(0, (1 << 64) - 1), U32)
MICROS = st.tuples(*[st.integers(-(1 << 31), (1 << 31) - 1).map(lambda n: n / 1e6)] * 7)
COMMAND = Command(
    Mode.REFERENCES, True, (0.1, -0.2, 0.3, 0.4, -0.5, 0.0, 0.0), (0.01,) * 7, Grapple.CLOSE, 100, 50, True
)
ESTOP = bytes(range(8, 16))
FEEDBACK = Feedback(7, State.EXECUTE, 1, 2, 7, 9, 444, (0.1,) * 7, (-0.2,) * 7, (-1.5,) * 8, 0.25, 120, ESTOP, 54321)
KEY = b"a key of sixteen"


@settings(max_examples=50)
@given(HEADERS, MICROS, MICROS)
def test_a_command_survives_the_round_trip(
    header: Header, reference: tuple[float, ...], rate: tuple[float, ...]
) -> None:
    command = Command(Mode.REFERENCES, True, reference, rate, Grapple.OPEN, 100, 50)
    data = encode_command(header, command)
    assert len(data) == COMMAND_BYTES == 100
    assert decode_command(data) == (header, command)


@settings(max_examples=50)
@given(HEADERS, MICROS, MICROS)
def test_a_reply_survives_the_round_trip(
    header: Header, position: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    feedback = Feedback(
        header.sequence & 0xFFFF,
        State.HOLD,
        1,
        2,
        7,
        header.echo & 0xFFFF,
        10_000,
        position,
        velocity,
        (12.5,) * 8,
        1.0,
        9,
        ESTOP,
        header.echo & 0xFFFF,
        (0.5, -0.5, 0.001, 1.0, -1.0, 0.0, 0.0),
    )
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
def test_an_undefined_command_is_refused_by_its_value(at: int, value: int) -> None:
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
