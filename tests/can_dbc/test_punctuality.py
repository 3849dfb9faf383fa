"""Commands that come late by their number: growing delays, skipped ticks, clocks that differ, silence."""

from __future__ import annotations

from collections.abc import Iterable

from can_dbc.protocols.punctuality import MAX_DELAY_NS, Punctuality

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
