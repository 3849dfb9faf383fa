"""Exact length of a classical CAN frame on the bus, stuff bits included (ISO 11898-1, 10.4 and 10.5).

The bits from start of frame to the last CRC bit are stuffed: after five equal bits a complementary one is
inserted, which itself counts towards the next five.  Both the CRC-15 and the stuffing are run eight bits at a
time from tables; the header of a key and length is computed once and cached.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from can_dbc.frame import EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK

CRC_POLYNOMIAL: Final = 0x4599
_START: Final = 5  # states 0..3: a run of one to four dominant bits; 5..8: of recessive bits (the idle bus)


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return table


def _stuff(state: int, bits: int, count: int) -> tuple[int, int]:
    """Process `count` bits of `bits`, most significant first; return (state, stuff bits inserted)."""
    inserted = 0
    for shift in range(count - 1, -1, -1):
        level = 5 * (bits >> shift & 1)
        run = state - level + 1 if 0 <= state - level < 4 else 0
        state = level + run
        if run == 4:
            inserted += 1
            state = 5 - level
    return state, inserted


def _stuff_table(count: int) -> list[list[tuple[int, int]]]:
    return [[_stuff(state, bits, count) for bits in range(1 << count)] for state in range(10)]


_CRC: Final = _crc_table()
_STUFF8: Final = _stuff_table(8)
_STUFF7: Final = _stuff_table(7)


@lru_cache(maxsize=4096)
def _header(key: int, length: int) -> tuple[int, int, int, int]:
    """CRC, stuffing state, stuff bits and bit count after start of frame, arbitration and control field."""
    remote = 1 if key & REMOTE else 0
    if key & EXTENDED:
        identifier = key & EXTENDED_MASK
        bits = (identifier >> 18) << 27 | 0b11 << 25 | (identifier & 0x3FFFF) << 7 | remote << 6 | length
        count = 39
    else:
        bits = (key & STANDARD_MASK) << 7 | remote << 6 | length
        count = 19
    crc = 0
    for shift in range(32, -8, -8):  # leading zeros leave the CRC at zero
        crc = (crc << 8) & 0x7FFF ^ _CRC[(crc >> 7) ^ (bits >> shift & 0xFF)]
    state, inserted = _stuff(_START, bits, count)
    return crc, state, inserted, count


def frame_bits(key: int, data: bytes) -> int:
    """Bits from start of frame to the last CRC bit with its stuff bits; 10 more end the frame (CRC
    delimiter, acknowledge slot and delimiter, end of frame) and 3 separate it from the next."""
    crc, state, inserted, count = _header(key, len(data))
    if not key & REMOTE:
        for byte in data:
            crc = (crc << 8) & 0x7FFF ^ _CRC[(crc >> 7) ^ byte]
            state, more = _STUFF8[state][byte]
            inserted += more
        count += 8 * len(data)
    state, more = _STUFF8[state][crc >> 7]
    return count + 15 + inserted + more + _STUFF7[state][crc & 0x7F][1]


def priority(key: int) -> int:
    """The arbitration field as a number: the lowest wins the bus.  A standard frame wins over an extended
    one with the same leading 11 bits, and a data frame over its remote frame."""
    remote = 1 if key & REMOTE else 0
    if key & EXTENDED:
        identifier = key & EXTENDED_MASK
        return (identifier >> 18) << 21 | 0b11 << 19 | (identifier & 0x3FFFF) << 1 | remote
    return (key & STANDARD_MASK) << 21 | remote << 20
