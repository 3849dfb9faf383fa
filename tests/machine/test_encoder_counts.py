"""Encoder counts and joint positions: wrap, sign and exact inverse."""

from __future__ import annotations

from math import pi

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.loading.profile_file import load_profile
from machine.profile import Encoder
from machine.sensing import counts_from_position, position_from_counts

PALMS = load_profile("palms_471")
SLEW = PALMS.joints["slew"].encoder
EXT = PALMS.joints["ext"].encoder
assert SLEW is not None and EXT is not None

rotary = st.builds(
    lambda total, zero, direction: msgspec.structs.replace(
        SLEW,
        total_counts=total,
        unit_per_count=2 * pi / total,
        zero_counts=round(zero * (total - 1)),
        direction=direction,
    ),
    st.integers(2, 2**25),
    st.floats(0.0, 1.0),
    st.sampled_from([-1, 1]),
)


@given(rotary, st.integers(-(2**28), 2**32 - 1))
def test_rotary_counts_survive_the_round_trip_and_full_turns_do_not_matter(encoder: Encoder, counts: int):
    position = position_from_counts(encoder, counts)
    assert abs(position) <= pi + 1e-9
    assert counts_from_position(encoder, position) == counts % encoder.total_counts
    assert position == position_from_counts(encoder, counts % encoder.total_counts)


@given(rotary, st.floats(-3.1, 3.1))
def test_rotary_position_survives_within_half_a_count(encoder: Encoder, position: float):
    counts = counts_from_position(encoder, position)
    assert 0 <= counts < encoder.total_counts
    error = (position_from_counts(encoder, counts) - position + pi) % (2 * pi) - pi
    assert abs(error) <= 0.5001 * encoder.unit_per_count


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([-1, 1]), st.integers(-24000, 24000))
def test_linear_counts_are_signed_and_never_wrap(counts: int, direction: int, zero: int):
    encoder = msgspec.structs.replace(EXT, direction=direction, zero_counts=zero)
    position = position_from_counts(encoder, counts)
    assert position == pytest.approx(direction * (counts - zero) * 5e-6)
    assert counts_from_position(encoder, position) == counts


@pytest.mark.parametrize(
    ("counts", "position"),
    [(8192, 0.0), (8193, 2 * pi / 16384), (8191, -2 * pi / 16384), (0, -pi), (16383, pi - 2 * pi / 16384)],
)
def test_slew_encoder_of_palms(counts: int, position: float):
    assert position_from_counts(SLEW, counts) == pytest.approx(position, abs=1e-12)


def test_the_wrap_lies_opposite_the_zero_and_direction_turns_the_sign():
    low_zero = msgspec.structs.replace(SLEW, zero_counts=100)
    assert position_from_counts(low_zero, 16384 - 100) == pytest.approx(-200 * SLEW.unit_per_count)
    assert position_from_counts(msgspec.structs.replace(SLEW, direction=-1), 8292) < 0.0
