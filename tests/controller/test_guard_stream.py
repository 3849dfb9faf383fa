"""The guard's protected streams: trust, gaps, corruption, age and punctuality, at each limit and just beyond it."""

from __future__ import annotations

import pytest

from can_dbc.frame import Frame
from controller.guard.layout import Field, GuardConfigError, Layout
from controller.guard.stream import FrameEffect, Punctuality, SentMessage, WatchedMessage, checksum
from tests.controller.bench import MS

IDS = bytes(range(16))
COUNTED = {"Counter": Field(8, 4, False, 1.0, 0.0, 15.0), "Mode": Field(16, 8, False, 1.0, 0.0, 255.0)}
PROTECTED = Layout(0x200, 4, COUNTED, IDS, 50 * MS)


def protected(counter: int, at_ns: int, mode: int = 0, good: bool = True) -> Frame:
    data = bytes((0, counter & 0xF, mode, 0))
    crc = checksum(data, IDS[counter & 0xF])
    return Frame(at_ns, 0x200, bytes((crc if good else crc ^ 1,)) + data[1:])


def watched(*frames: Frame) -> tuple[WatchedMessage, list[FrameEffect]]:
    message = WatchedMessage(PROTECTED)
    return message, [message.receive(frame, frame.stamp_ns) for frame in frames]


NONE, NEW, GAP, CORRUPT = FrameEffect


def test_a_stream_is_trusted_with_its_second_good_frame() -> None:
    message, effects = watched(protected(0, MS), protected(1, 2 * MS, 7), protected(2, 3 * MS, 8))
    assert effects == [NONE, NEW, NEW] and message.raw("Mode") == 8 and message.steps == 1
    assert message.stamp_ns == 3 * MS


@pytest.mark.parametrize(("counter", "effect"), [(2, NEW), (3, NEW), (4, GAP), (1, NONE), (0, GAP)])
def test_one_frame_may_be_missing(counter: int, effect: FrameEffect) -> None:
    message, effects = watched(*(protected(k, (k + 1) * MS) for k in (0, 1)), protected(counter, 9 * MS))
    assert effects[-1] is effect and message.trusted is (effect is not GAP)


def test_the_counter_goes_on_from_15_to_0() -> None:
    _, effects = watched(protected(14, MS), protected(15, 2 * MS), protected(0, 3 * MS))
    assert effects == [NONE, NEW, NEW]


def test_after_a_gap_the_stream_qualifies_again_and_a_gap_before_is_none() -> None:
    counters = (0, 1, 6, 7, 8)
    _, effects = watched(*(protected(c, (k + 1) * MS) for k, c in enumerate(counters)))
    assert effects == [NONE, NEW, GAP, NEW, NEW]
    _, effects = watched(protected(0, MS), protected(6, 2 * MS), protected(7, 3 * MS))
    assert effects == [NONE, NONE, NEW], "the frame after the gap is the first again"


def test_a_repeated_frame_does_not_make_it_younger() -> None:
    message, effects = watched(protected(0, MS), protected(1, 2 * MS), protected(1, 30 * MS))
    assert effects[-1] is NONE and message.stamp_ns == 2 * MS and message.steps == 0


def test_a_stream_is_old_after_its_time_out_and_must_qualify_again() -> None:
    message, _ = watched(protected(0, MS), protected(1, 2 * MS))
    assert not message.old(52 * MS) and message.trusted
    assert message.old(52 * MS + 1) and not message.trusted and message.counter == -1
    assert message.receive(protected(9, 60 * MS), 60 * MS) is NONE and message.steps == 1
    assert message.receive(protected(10, 61 * MS), 61 * MS) is NEW


def test_a_silence_before_a_frame_is_no_gap() -> None:
    _, effects = watched(protected(0, MS), protected(1, 2 * MS), protected(9, 60 * MS), protected(10, 61 * MS))
    assert effects == [NONE, NEW, NONE, NEW]


def test_a_frame_from_the_future_counts_from_now() -> None:
    message = WatchedMessage(PROTECTED)
    for k in (0, 1):
        message.receive(protected(k, 40 * MS), 10 * MS)
    assert message.stamp_ns == 10 * MS


def corrupted(bad: set[int], count: int) -> list[FrameEffect]:
    """Effects of frames whose counter runs on, those of ``bad`` with a wrong checksum."""
    return watched(*(protected(k, (k + 1) * MS, good=k not in bad) for k in range(count)))[1]


@pytest.mark.parametrize(
    ("bad", "breaks"),
    [
        ({10}, False),
        ({10, 15}, False),
        ({10, 14}, True),
        ({10, 11}, True),
        ({10, 40, 109}, True),
        ({10, 40, 110}, False),
    ],
)
def test_two_bad_frames_in_five_or_three_in_a_hundred_are_corrupt(bad: set[int], breaks: bool) -> None:
    effects = corrupted(bad, 130)
    assert (CORRUPT in effects) is breaks
    assert effects.index(CORRUPT) == max(bad) if breaks else NONE in effects


def test_a_corrupt_stream_must_qualify_again() -> None:
    effects = corrupted({10, 12}, 20)
    assert effects[12:16] == [CORRUPT, NONE, NEW, NEW]
    effects = corrupted({10}, 13)
    assert effects[9:] == [NEW, NONE, NEW, NEW], "one bad frame is only left out"


def test_a_frame_of_another_length_is_corrupt() -> None:
    message, _ = watched(*(protected(k, (k + 1) * MS) for k in range(3)))
    short = Frame(9 * MS, 0x200, protected(3, 0).data[:3])
    assert [message.receive(short, 9 * MS) for _ in range(2)] == [NONE, CORRUPT]


@pytest.mark.parametrize(("ids", "timeout_ns"), [(b"", 50 * MS), (IDS, 0)])
def test_a_message_without_protection_or_time_out_cannot_be_watched(ids: bytes, timeout_ns: int) -> None:
    with pytest.raises(GuardConfigError):
        WatchedMessage(Layout(1, 4, {}, ids, timeout_ns))


def test_a_command_is_late_when_it_comes_40_ms_after_its_turn() -> None:
    def last_of(delay_ns: int) -> bool:
        punctual = Punctuality(10 * MS)
        assert not any(punctual.late(k * 10 * MS, 1, 500 * MS) for k in range(100, 110))
        return punctual.late(1090 * MS + 10 * MS + delay_ns, 1, 500 * MS)

    forgiven_ns = 1 * MS  # of 50 ms without one, 2 %
    assert not last_of(40 * MS + forgiven_ns) and last_of(40 * MS + forgiven_ns + 50_000)


def test_missing_commands_have_their_turns() -> None:
    punctual = Punctuality(10 * MS)
    assert not any(punctual.late(k * 10 * MS, 1, 500 * MS) for k in range(100, 110))
    assert not punctual.late(1190 * MS, 10, 500 * MS)
    assert not punctual.late(1200 * MS, 1, 500 * MS)


def test_a_delay_that_lasts_is_forgiven_and_a_silence_begins_anew() -> None:
    punctual = Punctuality(10 * MS)
    assert not any(punctual.late(k * 10 * MS, 1, 500 * MS) for k in range(100, 110))
    late = [punctual.late(1090 * MS + 60 * MS + k * 10 * MS, 1, 500 * MS) for k in range(1, 400)]
    assert late[0] and not late[-1] and late == sorted(late, reverse=True)
    assert 80 <= sum(late) <= 100, "20 ms too much at 0.2 ms a period, less what the first gap forgave"
    assert not punctual.late(99_000 * MS, 1, 500 * MS)
    assert not punctual.late(99_010 * MS, 1, 500 * MS)


def test_a_silence_is_longer_than_its_limit() -> None:
    for gap_ns, late in ((500 * MS, True), (500 * MS + 1, False)):
        punctual = Punctuality(10 * MS)
        assert not punctual.late(1000 * MS, 1, 500 * MS)
        assert punctual.late(1000 * MS + gap_ns, 1, 500 * MS) is late


def test_a_sent_message_keeps_its_period_and_goes_at_once_after_a_change() -> None:
    message = SentMessage(PROTECTED, 10 * MS)
    sent = [now for now in range(1000, 1041, 5) if message.due(now * MS, False)]
    assert sent == [1000, 1010, 1020, 1030, 1040]
    assert not message.due(1049 * MS, False) and message.due(1050 * MS, False)
    assert message.due(1053 * MS, True) and not message.due(1062 * MS, False) and message.due(1063 * MS, False)
    assert message.due(1079 * MS, False) and not message.due(1082 * MS, False) and message.due(1083 * MS, False)
    assert message.due(1103 * MS, False) and not message.due(1112 * MS, False), "a whole period late: a new beginning"


def test_a_sent_frame_has_counter_checksum_and_only_known_signals() -> None:
    message = SentMessage(PROTECTED, 10 * MS)
    for k in range(18):
        key, data = message.frame({"Mode": k, "Nothing": 9})
        assert (key, data[1:]) == (0x200, bytes((k & 0xF, k, 0))) and data[0] == checksum(data, IDS[k & 0xF])
