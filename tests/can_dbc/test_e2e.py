"""E2E Profile 2: against the independent ``autosar-e2e``, and the checker's states."""

from __future__ import annotations

import pytest
from e2e import p02
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.protocols.e2e import Checker, Sender, Status, crc8, frame_crc, protect

IDS = bytes(range(0x30, 0x40))
PAYLOAD = bytes.fromhex("00a0123456789abc")
FIXED = settings(max_examples=500, deadline=None, derandomize=True, database=None)


def test_check_value() -> None:
    assert crc8(b"123456789") == 0xDF


@FIXED
@given(st.binary(min_size=2, max_size=64), st.integers(0, 15), st.binary(min_size=16, max_size=16))
def test_equals_autosar_e2e(payload: bytes, counter: int, data_ids: bytes) -> None:
    ours = protect(payload, counter, data_ids)
    theirs = bytearray(payload)
    theirs[1] = theirs[1] & 0xF0 | counter
    p02.e2e_p02_protect(theirs, data_ids, increment_counter=False)
    assert ours == bytes(theirs)
    assert p02.e2e_p02_check(ours, data_ids, length=len(ours))
    assert ours[2:] == payload[2:] and ours[1] >> 4 == payload[1] >> 4


@FIXED
@given(st.binary(min_size=2, max_size=16), st.integers(0, 15), st.integers(0, 16 * 8 - 1))
def test_every_single_bit_error_is_detected(payload: bytes, counter: int, position: int) -> None:
    frame = bytearray(protect(payload, counter, IDS))
    frame[position // 8 % len(frame)] ^= 1 << position % 8
    assert frame_crc(bytes(frame), IDS) != frame[0]


def test_sender_counts() -> None:
    sender = Sender(IDS, counter=14)
    assert [sender.protect(PAYLOAD)[1] & 15 for _ in range(4)] == [14, 15, 0, 1]


O, L, I, R, W, E = (  # noqa: E741
    Status.OK,
    Status.OK_SOME_LOST,
    Status.INITIAL,
    Status.REPEATED,
    Status.WRONG_SEQUENCE,
    Status.ERROR,
)
X = -1
SEQUENCES = [
    # counters received (X: bad CRC), statuses, trusted at the end
    ([0, 1, 2, 3], [I, O, O, O], True),
    ([14, 15, 0, 1], [I, O, O, O], True),
    ([0, 2, 4, 5], [I, L, L, O], True),
    ([15, 1, 3], [I, L, L], True),
    ([5], [I], False),
    ([5, 5, 5], [I, R, R], False),
    ([5, 5, 6], [I, R, O], True),
    ([0, 1, 1, 2], [I, O, R, O], True),
    ([0, 1, 4, 5], [I, O, W, O], True),
    ([0, 1, 4], [I, O, W], False),
    ([0, 1, 0], [I, O, W], False),
    ([0, 1, 4, 8, 9], [I, O, W, W, O], True),
    ([0, 1, X, 3], [I, O, E, L], True),
    ([0, 1, X, X, 3], [I, O, E, E, I], False),
    ([0, 1, X, X, 3, 4], [I, O, E, E, I, O], True),
    ([0, 1, X, X, 4, 5], [I, O, E, E, W, O], True),
    ([X, 0, X, 1, 2], [E, I, E, I, O], True),
    ([0, 1, X, 3, X, 5, X, 7, 8], [I, O, E, L, E, L, E, I, O], True),
    ([X, X, X], [E, E, E], False),
]


@pytest.mark.parametrize(("counters", "statuses", "trusted"), SEQUENCES)
def test_checker(counters: list[int], statuses: list[Status], trusted: bool) -> None:
    checker = Checker(IDS)
    frames = [protect(PAYLOAD, c, IDS) if c != X else bytes(8) for c in counters]
    assert [checker.check(f) for f in frames] == statuses
    assert checker.trusted is trusted


def test_three_bad_frames_within_a_hundred() -> None:
    for gap, trusted in ((40, False), (60, True)):
        checker, sender = Checker(IDS), Sender(IDS)
        for _ in range(3):
            for _ in range(gap):
                assert checker.check(sender.protect(PAYLOAD)) is not Status.ERROR
            sender.protect(PAYLOAD)
            checker.check(bytes(8))
        assert checker.trusted is trusted


def test_masquerade_short_frames_and_reset() -> None:
    checker = Checker(IDS)
    assert checker.check(protect(PAYLOAD, 0, bytes(16))) is Status.ERROR
    assert checker.check(b"\0") is Status.ERROR
    checker.reset()
    assert [checker.check(protect(PAYLOAD, c, IDS)) for c in (3, 4)] == [Status.INITIAL, Status.OK]
    checker.reset()
    assert checker.check(protect(PAYLOAD, 5, IDS)) is Status.INITIAL
    assert [s for s in Status if s.usable] == [Status.OK, Status.OK_SOME_LOST]
