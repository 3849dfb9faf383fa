"""The record of a stop; when one begins says `machine.status.explanation.StopDetector`."""

from __future__ import annotations

from typing import Final

import msgspec

from can_dbc.messages import datagrams
from can_dbc.messages.crane import StateReport
from can_dbc.messages.tick_record import TickRecord
from machine.status.explanation import Explanation, explain
from machine.status.modes import Mode
from machine.status.reasons import known

TOPIC: Final = "/stop"


class Stop(msgspec.Struct, frozen=True, kw_only=True):
    """One stop, as the topic ``/stop`` stores it.

    ``reason`` has the detail in bits 8 to 15; ``numbers`` are those of ``StateReport``, None where there is none.
    """

    number: int
    """Counts the stops of a directory; the numbers below the oldest file's are those of removed files."""
    at_ns: int
    """Monotonic time at which the reason began."""
    utc_ns: int | None
    """The same as UTC; None in lockstep."""
    mode_before: str
    mode: str
    reason: int
    code: str
    numbers: tuple[float | None, ...]
    text: str
    """The whole explanation, for readers without this program."""

    @property
    def explanation(self) -> Explanation:
        """The reason in today's words; raises ValueError for a reason that this release does not know."""
        return explain(self.reason, self.numbers)


def stop_from(report: StateReport, mode_before: str, number: int, utc_offset_ns: int | None) -> Stop:
    """The record of a stop that begins with a report; ``utc_offset_ns`` is None in lockstep.

    A reason of another release keeps its number; its words say so.
    """
    at_ns = report.since_ns or report.stamp_ns
    found = None if known(report.reason) is None else explain(report.reason, report.numbers)
    return Stop(
        number=number,
        at_ns=at_ns,
        utc_ns=None if utc_offset_ns is None else at_ns + utc_offset_ns,
        mode_before=mode_before,
        mode=Mode(report.mode).name,
        reason=report.reason,
        code=found.code if found else f"REASON_{report.reason & 0xFF}",
        numbers=tuple(None if value != value else value for value in report.numbers),
        text=found.text if found else f"Unknown reason {report.reason & 0xFF}.",
    )


def report_of(tick: TickRecord) -> StateReport | None:
    """The state report of a tick; None where it sent none.

    Raises:
        DatagramRefused: it is one of another release.
    """
    report = datagrams.decode(tick.report) if tick.report else None
    return report if isinstance(report, StateReport) else None
