"""E2E Profile 2: against the independent ``autosar-e2e``, the checker's states, and how late commands are."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from e2e import p02
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.protocols.e2e import Checker, Sender, Status, crc8, frame_crc, protect
from can_dbc.protocols.punctuality import MAX_DELAY_NS, Punctuality

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


NAMES = {"O": "OK", "L": "OK_SOME_LOST", "I": "INITIAL", "R": "REPEATED", "W": "WRONG_SEQUENCE", "E": "ERROR"}
X = -1
SEQUENCES = [
    # counters received (X: bad CRC), statuses, trusted at the end
    ([0, 1, 2, 3], "IOOO", True),
    ([14, 15, 0, 1], "IOOO", True),
    ([0, 2, 4, 5], "ILLO", True),
    ([15, 1, 3], "ILL", True),
    ([5], "I", False),
    ([5, 5, 5], "IRR", False),
    ([5, 5, 6], "IRO", True),
    ([0, 1, 1, 2], "IORO", True),
    ([0, 1, 4, 5], "IOWO", True),
    ([0, 1, 4], "IOW", False),
    ([0, 1, 0], "IOW", False),
    ([0, 1, 4, 8, 9], "IOWWO", True),
    ([0, 1, X, 3], "IOEL", True),
    ([0, 1, X, X, 3], "IOEEI", False),
    ([0, 1, X, X, 3, 4], "IOEEIO", True),
    ([0, 1, X, X, 4, 5], "IOEEWO", True),
    ([X, 0, X, 1, 2], "EIEIO", True),
    ([0, 1, X, 3, X, 5, X, 7, 8], "IOELELEIO", True),
    ([X, X, X], "EEE", False),
]


@pytest.mark.parametrize(("counters", "statuses", "trusted"), SEQUENCES)
def test_checker(counters: list[int], statuses: str, trusted: bool) -> None:
    checker = Checker(IDS)
    frames = [protect(PAYLOAD, c, IDS) if c != X else bytes(8) for c in counters]
    assert [checker.check(f) for f in frames] == [Status[NAMES[letter]] for letter in statuses]
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


# -- commands that come late by their number: growing delays, skipped ticks, clocks that differ, silence

MS = 1_000_000
PERIOD_NS, SILENCE_NS = 5 * MS, 50 * MS


def verdicts(commands: Iterable[tuple[int, int]]) -> list[bool]:
    """Of (number, time of reception) pairs."""
    stream = Punctuality(PERIOD_NS, SILENCE_NS)
    return [stream.late(number & 0x0F, at_ns) for number, at_ns in commands]


def sent_ns(number: int) -> int:
    return 1_000 * MS + number * PERIOD_NS


def test_a_delay_that_grows_beyond_the_bound_is_late() -> None:
    """In order, complete, and never more than 6 ms apart: only the number tells how old they are."""
    found = verdicts((n, sent_ns(n) + min(n * MS, 60 * MS)) for n in range(100))
    assert not any(found[:41]) and all(found[47:]), "a part of it has been forgiven by then"


def test_a_delay_that_comes_at_once_is_late() -> None:
    found = verdicts((n, sent_ns(n) + (45 * MS if n >= 20 else 0)) for n in range(40))
    assert found == [False] * 20 + [True] * 20


def test_jitter_and_lost_commands_within_the_bound_are_not_late() -> None:
    numbers = [n for n in range(400) if n % 7]
    assert not any(verdicts((n, sent_ns(n) + n * 7919 % 30 * MS) for n in numbers))


def test_a_controller_that_skips_ticks_now_and_then_is_not_late() -> None:
    """Three periods every second: the number does not count them."""
    skipped = [(n, sent_ns(n) + n // 197 * 3 * PERIOD_NS) for n in range(4000)]
    assert not any(verdicts(skipped))


def test_a_clock_that_differs_by_a_thousandth_is_never_late() -> None:
    assert not any(verdicts((n, 1_000 * MS + n * PERIOD_NS * 1001 // 1000) for n in range(40_000)))


def test_after_a_silence_the_stream_begins_anew() -> None:
    silent_ns = SILENCE_NS + PERIOD_NS
    assert verdicts([(0, 0), (1, PERIOD_NS), (2, PERIOD_NS + silent_ns), (3, 2 * PERIOD_NS + silent_ns)]) == [False] * 4
    late_ns = PERIOD_NS + MAX_DELAY_NS + 3 * MS
    assert verdicts([(0, 0), (1, late_ns), (2, late_ns + PERIOD_NS)]) == [False, True, True]


def test_a_queue_that_has_drained_is_punctual_again() -> None:
    """Its commands come in a burst, and the last one is on time."""
    punctual = [(n, sent_ns(n)) for n in range(11)]
    burst = [(n, sent_ns(19) + 4 * MS + n * MS // 20) for n in range(11, 20)]
    found = verdicts([*punctual, *burst, (20, sent_ns(20)), (21, sent_ns(21))])
    assert found[11] and not any(found[-3:])
