"""Frame lengths against a slow bit-by-bit computation, and arbitration order."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from can_dbc.frame import EXTENDED, REMOTE
from hil.wire.core import frame_bits, priority

STANDARD = st.integers(0, 0x7FF)
KEYS = STANDARD | st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EXTENDED)
PAYLOADS = st.binary(max_size=8) | st.sampled_from([b"\0", b"\xff"]).flatmap(
    lambda byte: st.integers(0, 8).map(lambda n: byte * n)
)


def bits_of(value: int, count: int) -> str:
    return format(value, f"0{count}b") if count else ""


def arbitration_field(key: int) -> str:
    """Identifier, RTR or SRR, IDE and what follows up to RTR, as on the bus."""
    remote = "1" if key & REMOTE else "0"
    if key & EXTENDED:
        identifier = bits_of(key & 0x1FFF_FFFF, 29)
        return identifier[:11] + "11" + identifier[11:] + remote
    return bits_of(key & 0x7FF, 11) + remote + "0"


def slow_length(key: int, data: bytes) -> int:
    reserved = "00" if key & EXTENDED else "0"
    payload = "" if key & REMOTE else "".join(bits_of(byte, 8) for byte in data)
    bits = "0" + arbitration_field(key) + reserved + bits_of(len(data), 4) + payload
    crc = 0
    for bit in bits:  # the algorithm as the standard prints it
        crc_next = int(bit) ^ (crc >> 14)
        crc = (crc << 1) & 0x7FFF
        if crc_next:
            crc ^= 0x4599
    stuffed = ""
    for bit in bits + bits_of(crc, 15):
        stuffed += bit
        if stuffed[-5:] in ("00000", "11111"):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed)


@given(KEYS, PAYLOADS, st.sampled_from([0, REMOTE]))
def test_length_equals_the_bit_by_bit_computation(key: int, data: bytes, remote: int) -> None:
    assert frame_bits(key | remote, data) == slow_length(key | remote, data)


@given(KEYS, PAYLOADS)
def test_length_is_within_the_bounds_of_davis_and_others(key: int, data: bytes) -> None:
    bare = (54 if key & EXTENDED else 34) + 8 * len(data)
    assert bare <= frame_bits(key, data) <= bare + (bare - 1) // 4


def test_all_zeros_are_stuffed_after_every_fifth_bit() -> None:
    """The CRC of zeros is zero, so identifier 0 with no data is a run of 34 dominant bits."""
    assert frame_bits(0, b"") == 34 + 34 // 5


@given(KEYS, KEYS)
def test_priority_has_the_order_of_the_arbitration_bits(left: int, right: int) -> None:
    """The first differing bit decides, dominant (0) wins: the order of the strings."""
    one, other = arbitration_field(left).ljust(32, "0"), arbitration_field(right).ljust(32, "0")
    assert (priority(left) < priority(right)) == (one < other)


@given(STANDARD, st.integers(0, 0x3FFFF))
def test_a_standard_frame_wins_over_an_extended_one_of_the_same_base(base: int, low: int) -> None:
    assert priority(base | REMOTE) < priority(base << 18 | low | EXTENDED)
    assert priority(base) < priority(base | REMOTE)
