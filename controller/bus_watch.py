"""One bus as the supervisor sees it: what its reading says of this tick's frames, of a recovery, of what it refuses.

A node that came back from bus-off may not go on as if nothing had been (can_bus.md, sections 9 and 12): what waited is
thrown away, everything is unknown, and a human arms again.  A bus that does so three times within a minute is not fit
to work on for the next minute.
"""

from __future__ import annotations

from typing import Final

from can_dbc.bus import BusState
from can_dbc.tick_record import BusReading
from machine.reasons import Reason

SEND_REFUSALS: Final = 3
RECOVERIES: Final = 3
RECOVERY_WINDOW_NS: Final = 60_000_000_000
_OFF, _PASSIVE = int(BusState.OFF), int(BusState.PASSIVE)


class BusWatch:
    """Watches one bus; `read` once per tick.  ``number`` is 0 for crane0 and 1 for mach0."""

    __slots__ = (
        "_dropped", "_latest", "_recovered_ns", "_recoveries", "_refused", "_refusing", "_unfit_until_ns", "lost",
        "number", "reason", "recovered",
    )  # fmt: skip

    def __init__(self, number: int) -> None:
        self.number = number
        self.reason = Reason.NONE
        """What is to be found now."""
        self.lost = False
        """Frames of this tick were lost, or belong to a time before a recovery: none is to be used."""
        self.recovered = False
        """The bus came back from OFF or DOWN since the last tick."""
        self._dropped = self._refused = self._refusing = self._recoveries = self._latest = 0
        self._recovered_ns = [-RECOVERY_WINDOW_NS] * RECOVERIES
        self._unfit_until_ns = 0

    def read(self, reading: BusReading, sent: bool, now_ns: int) -> None:
        """Takes the reading of a tick; ``sent``: the tick before had frames to send."""
        self.recovered = reading.recoveries != self._recoveries
        self.lost = self.recovered or reading.dropped != self._dropped
        self._dropped = reading.dropped
        if reading.refused > self._refused:
            self._refusing += 1
        elif sent:
            self._refusing = 0
        self._refused = reading.refused
        if self.recovered:
            self._note_recoveries(reading.recoveries, now_ns)
        state = reading.state
        if state > _OFF:
            self.reason = Reason.BUS_DOWN
        elif state == _OFF or self.recovered:  # it may come and go between two ticks
            self.reason = Reason.BUS_OFF
        elif self._refusing >= SEND_REFUSALS:
            self.reason = Reason.SEND_REFUSED
        else:
            self.reason = Reason.BUS_PASSIVE if state == _PASSIVE else Reason.NONE

    def fit(self, now_ns: int) -> bool:
        """Whether a machine may be armed on it."""
        return now_ns >= self._unfit_until_ns

    def _note_recoveries(self, recoveries: int, now_ns: int) -> None:
        stamps = self._recovered_ns
        for _ in range(min(abs(recoveries - self._recoveries), RECOVERIES)):
            stamps[self._latest % RECOVERIES] = now_ns
            self._latest += 1
        self._recoveries = recoveries
        if now_ns - min(stamps) < RECOVERY_WINDOW_NS:
            self._unfit_until_ns = now_ns + RECOVERY_WINDOW_NS
