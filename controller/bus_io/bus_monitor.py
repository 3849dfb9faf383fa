"""Health of one bus for the supervisor: lost frames, recoveries, refused sends, and the bus state.

A node that came back from bus-off must not continue as if nothing had happened (docs/reference/can-bus.md sections 9
and 12): waiting frames are discarded, all values are unknown, and a human arms again.  A bus that recovers three times
within a minute is not usable for arming during the next minute.
"""

from __future__ import annotations

from typing import Final

from can_dbc.bus.base import BusState
from can_dbc.messages.tick_record import BusReading
from machine.status.reasons import Reason

SEND_REFUSAL_LIMIT_TICKS: Final = 3
SEND_REFUSAL_LIMIT_NS: Final = 10_000_000
"""A bus that refuses frames in this many ticks in a row, over this time or longer, is not usable."""
RECOVERY_LIMIT_COUNT: Final = 3
RECOVERY_WINDOW_NS: Final = 60_000_000_000
_OFF: Final = int(BusState.OFF)
_PASSIVE: Final = int(BusState.PASSIVE)
_NONE: Final = Reason.NONE


class BusMonitor:
    """Monitors one bus; `update` once per tick.  ``number`` is 0 for crane0 and 1 for mach0."""

    __slots__ = (
        "_dropped",
        "_recovered_ns",
        "_recoveries",
        "_recovery_count",
        "_refused",
        "_refusing_since_ns",
        "_refusing_ticks",
        "_unusable_until_ns",
        "frames_lost",
        "number",
        "reason",
        "recovered",
    )

    def __init__(self, number: int) -> None:
        self.number = number
        self.reason = Reason.NONE
        """The finding of this tick."""
        self.frames_lost = False
        """Frames of this tick were lost, or are older than a recovery: none may be used."""
        self.recovered = False
        """The bus came back from OFF or DOWN since the last tick."""
        self._dropped = self._refused = self._refusing_ticks = self._recoveries = self._recovery_count = 0
        self._refusing_since_ns = 0
        self._recovered_ns = [-RECOVERY_WINDOW_NS] * RECOVERY_LIMIT_COUNT
        self._unusable_until_ns = 0

    def update(self, reading: BusReading, sent: bool, now_ns: int) -> None:
        """Update from the reading of a tick; ``sent``: the previous tick had frames to send."""
        self.recovered = reading.recoveries != self._recoveries
        self.frames_lost = self.recovered or reading.dropped != self._dropped
        self._dropped = reading.dropped
        if reading.refused > self._refused:
            if not self._refusing_ticks:
                self._refusing_since_ns = now_ns
            self._refusing_ticks += 1
        elif sent:
            self._refusing_ticks = 0
        self._refused = reading.refused
        if self.recovered:
            self._note_recoveries(reading.recoveries, now_ns)
        state = reading.state
        if state > _OFF:
            self.reason = Reason.BUS_DOWN
        elif state == _OFF or self.recovered:  # it may come and go between two ticks
            self.reason = Reason.BUS_OFF
        elif (
            self._refusing_ticks >= SEND_REFUSAL_LIMIT_TICKS
            and now_ns - self._refusing_since_ns >= SEND_REFUSAL_LIMIT_NS
        ):
            self.reason = Reason.SEND_REFUSED
        else:
            self.reason = Reason.BUS_PASSIVE if state == _PASSIVE else _NONE

    def usable(self, now_ns: int) -> bool:
        """Whether the machine may be armed on this bus."""
        return now_ns >= self._unusable_until_ns

    def _note_recoveries(self, recoveries: int, now_ns: int) -> None:
        stamps = self._recovered_ns
        for _ in range(min(abs(recoveries - self._recoveries), RECOVERY_LIMIT_COUNT)):
            stamps[self._recovery_count % RECOVERY_LIMIT_COUNT] = now_ns
            self._recovery_count += 1
        self._recoveries = recoveries
        if now_ns - min(stamps) < RECOVERY_WINDOW_NS:
            self._unusable_until_ns = now_ns + RECOVERY_WINDOW_NS
