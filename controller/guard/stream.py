"""Protected messages on a bus, received and sent, by the guard's own code: checksum, counter, age, punctuality."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from can_dbc.frame import Frame, RawFrame
from controller.guard.layout import GuardConfigError, Layout
from controller.guard.verdicts import Verdict

_MIN_GOOD_COUNT, _MAX_COUNTER_STEP = 2, 2
_SHORT_WINDOW, _MAX_BAD_IN_SHORT = (1 << 5) - 1, 1
_LONG_WINDOW, _MAX_BAD_IN_LONG = (1 << 100) - 1, 2
"""Frames with a wrong checksum that are tolerated among the last 5 and among the last 100."""
MAX_DELAY_NS: Final = 40_000_000
"""A command is refused when it comes this much later than its counter and the period say."""
DELAY_FORGIVEN_PER_S: Final = 0.02
"""How fast a lasting delay is forgiven: clocks differ, and a controller may skip a tick."""


def _crc_table() -> bytes:
    table = bytearray(256)
    for i in range(256):
        crc = i
        for _ in range(8):
            crc = (crc << 1 & 0xFF) ^ (0x2F if crc & 0x80 else 0)
        table[i] = crc
    return bytes(table)


_CRC: Final = _crc_table()


def checksum(data: bytes, data_id: int) -> int:
    """Compute the CRC-8H2F of a frame from byte 1 on and its Data ID (AUTOSAR E2E Profile 2)."""
    crc = 0xFF
    for i in range(1, len(data)):
        crc = _CRC[crc ^ data[i]]
    return _CRC[crc ^ data_id] ^ 0xFF


class FrameEffect(IntEnum):
    """Effect of a received frame on its stream; the greater ones break trust."""

    NONE = 0
    NEW_WORD = 1
    GAP = 2
    CORRUPT = 3


class WatchedMessage:
    """One protected message: its newest good word, its time, and whether its stream is trusted.

    ``gap`` and ``corrupt`` are the rules that a break in its stream violates, GOOD where its age alone counts.
    """

    __slots__ = ("_bad", "_good", "breaks", "counter", "layout", "stamp_ns", "steps", "trusted", "word")

    def __init__(self, layout: Layout, gap: Verdict = Verdict.GOOD, corrupt: Verdict = Verdict.GOOD) -> None:
        if not layout.data_ids or not layout.timeout_ns:
            raise GuardConfigError("guard.message-unprotected", "A DBC lacks a message's Data IDs or its time-out.")
        self.layout = layout
        self.breaks = (gap, corrupt)
        self.word = self.stamp_ns = self.steps = 0
        self.counter = -1
        self.trusted = False
        self._good = self._bad = 0  # good frames in a row; bad ones among the last hundred, as bits

    def receive(self, frame: Frame, now_ns: int) -> FrameEffect:
        """Check a frame, and keep its word when the stream is trusted."""
        data, layout = frame.data, self.layout
        self.old(frame.stamp_ns)  # after a silence the stream begins anew: that is no corruption
        if len(data) != layout.length or checksum(data, layout.data_ids[data[1] & 0xF]) != data[0]:
            bad = self._bad = (self._bad << 1 | 1) & _LONG_WINDOW
            self._good = 0
            if (bad & _SHORT_WINDOW).bit_count() <= _MAX_BAD_IN_SHORT and bad.bit_count() <= _MAX_BAD_IN_LONG:
                return FrameEffect.NONE
            self.trusted = False
            return FrameEffect.CORRUPT
        counter = data[1] & 0xF
        self.steps = (counter - self.counter) & 0xF if self.counter >= 0 else 1
        self.counter = counter
        if self.steps == 0:  # a repeated frame only grows older
            return FrameEffect.NONE
        self._bad = self._bad << 1 & _LONG_WINDOW
        broken = self.steps > _MAX_COUNTER_STEP and self.trusted
        self._good = 1 if self.steps > _MAX_COUNTER_STEP else self._good + 1
        self.trusted = not broken and (self.trusted or self._good >= _MIN_GOOD_COUNT)
        if not self.trusted:
            return FrameEffect.GAP if broken else FrameEffect.NONE
        self.word = int.from_bytes(data, "little")
        self.stamp_ns = min(frame.stamp_ns, now_ns)
        return FrameEffect.NEW_WORD

    def old(self, now_ns: int) -> bool:
        """Tell whether no trusted frame came within the time-out; then the stream must qualify again."""
        if self.trusted and now_ns - self.stamp_ns <= self.layout.timeout_ns:
            return False
        if self.trusted:
            self.trusted, self._good, self.counter = False, 0, -1
        return True

    def raw(self, name: str) -> int:
        """Return the raw value of a signal in the newest good frame."""
        return self.layout.fields[name].raw(self.word)


class Punctuality:
    """How late commands come, from their number: one for each period, and the most punctual one sets the scale.

    A transmit queue that a busy bus holds up delivers commands in order, complete, with good checksums, and old.
    """

    __slots__ = ("_due_ns", "_last_ns", "_period_ns")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = self._last_ns = 0

    def late(self, stamp_ns: int, steps: int, silence_ns: int) -> bool:
        """Tell whether a command is too late that came at ``stamp_ns``, ``steps`` after the one before."""
        gap_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        due_ns = self._due_ns + steps * self._period_ns + int(gap_ns * DELAY_FORGIVEN_PER_S)
        self._due_ns = stamp_ns if gap_ns > silence_ns else min(due_ns, stamp_ns)
        return stamp_ns - self._due_ns > MAX_DELAY_NS


class SentMessage:
    """One protected message of the guard: at its period, and at once after a change."""

    __slots__ = ("_counter", "_next_ns", "_period_ns", "layout")

    def __init__(self, layout: Layout, period_ns: int) -> None:
        self.layout = layout
        self._period_ns = period_ns
        self._counter = self._next_ns = 0

    def due(self, now_ns: int, changed: bool) -> bool:
        """Tell whether to send it now."""
        if not changed and now_ns < self._next_ns:
            return False
        late = changed or now_ns - self._next_ns >= self._period_ns
        self._next_ns = (now_ns if late else self._next_ns) + self._period_ns
        return True

    def frame(self, values: dict[str, int]) -> RawFrame:
        """Build the next frame; signals that are not in ``values`` are 0, and values without a signal are left out."""
        layout, counter = self.layout, self._counter
        self._counter = (counter + 1) & 0xF
        word = layout.fields["Counter"].put(counter)
        for name, value in values.items():
            if name in layout.fields:
                word |= layout.fields[name].put(value)
        data = word.to_bytes(layout.length, "little")
        return layout.key, bytes((checksum(data, layout.data_ids[counter]),)) + data[1:]
