"""RGB-D frames on a stream: complete or refused."""

import random
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.messages.rgbd import (
    HEADER_BYTES,
    REQUEST_HEADER,
    RgbdMessage,
    decode,
    decode_header,
    encode,
    encode_refusal,
    encode_request,
    request_name_bytes,
)
from runtime.errors import InputRefused
from tests.codes import coded


def frame(width: int = 5, height: int = 3, seed: int = 0) -> RgbdMessage:
    rng = random.Random(seed)
    pixels = width * height
    return RgbdMessage(
        "front", 123, width, height, 40.0, 41.0, 2.0, 1.0, rng.randbytes(3 * pixels), rng.randbytes(2 * pixels)
    )


@given(st.integers(1, 40), st.integers(1, 30), st.integers(0, 100))
def test_a_frame_arrives_as_it_was_sent(width: int, height: int, seed: int) -> None:
    sent = frame(width, height, seed)
    data = encode(sent)
    assert decode(data) == sent and len(data) == HEADER_BYTES + decode_header(data[:HEADER_BYTES]).remaining_bytes


@given(st.data())
def test_any_flipped_bit_refuses_the_frame(data: st.DataObject) -> None:
    whole = bytearray(encode(frame()))
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(InputRefused):
        decode(bytes(whole))


@given(st.integers(0, 200), st.integers(1, 20))
def test_a_cut_or_lengthened_frame_is_refused(kept: int, more: int) -> None:
    whole = encode(frame())
    for broken in (whole[: min(kept, len(whole) - 1)], whole + bytes(more)):
        with pytest.raises(InputRefused):
            decode(broken)


@given(st.binary(min_size=HEADER_BYTES, max_size=HEADER_BYTES + 40))
def test_noise_is_not_a_frame(noise: bytes) -> None:
    with pytest.raises(InputRefused):
        decode(noise)


def test_a_refusal_has_its_reason() -> None:
    with pytest.raises(InputRefused, match=r"^the lens is covered$", check=coded("rgbd.refused")):
        decode(encode_refusal("front", "the lens is covered"))


def test_a_request_carries_the_cameras_name() -> None:
    asked = encode_request("front")
    assert asked[REQUEST_HEADER.size :] == b"front" and request_name_bytes(asked[: REQUEST_HEADER.size]) == 5
    with pytest.raises(InputRefused, check=coded("rgbd.no-request")):
        request_name_bytes(bytes(REQUEST_HEADER.size))


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"rgb": b""}, "rgbd.incomplete"),
        ({"width_px": 0}, "rgbd.size"),
        ({"fx_px": float("nan")}, "rgbd.not-finite"),
        ({"camera": ""}, "rgbd.camera-name"),
    ],
)
def test_an_inconsistent_frame_is_not_sent(wrong: dict[str, Any], code: str) -> None:
    with pytest.raises(InputRefused, check=coded(code)):
        encode(replace(frame(), **wrong))
