"""A stop: what one is, when one begins, and the record of it.

A stop begins when the mode enters STOP or FAULT from another mode, and when its reason changes to another one while the
machine is stopped (a second fault during the ramp).  A FAULT that follows the ramp of its STOP is the same stop.
"""

from __future__ import annotations

from typing import Final

import msgspec

from can_dbc.messages.crane import StateReport
from machine.status.explanation import Explanation, explain
from machine.status.faults import describe
from machine.status.modes import Mode
from machine.status.reasons import Reason

STOPPED: Final = (Mode.STOP, Mode.FAULT)
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


class StopDetector:
    """Finds stops in a sequence of state reports."""

    def __init__(self) -> None:
        self._mode: Mode | None = None
        self._reason = 0
        self._before = "unknown"

    def step(self, report: StateReport) -> str | None:
        """The mode before a stop that begins with this report; None when none begins.

        A machine that is stopped already in the first report has stopped before it: no stop begins.
        """
        mode, before = Mode(report.mode), self._mode
        reason, changed = report.reason, report.reason != self._reason
        self._mode, self._reason = mode, reason
        if mode not in STOPPED:
            self._before = mode.name
            return None
        if before is None:
            return None
        if before not in STOPPED:
            return before.name
        return self._before if changed else None


def stop_from(report: StateReport, mode_before: str, number: int, utc_offset_ns: int | None) -> Stop:
    """The record of a stop that begins with a report; ``utc_offset_ns`` is None in lockstep.

    A reason of another release keeps its number; its words say so.
    """
    at_ns = report.since_ns or report.stamp_ns
    known = report.reason & 0xFF in set(Reason)
    text = describe(report.reason, numbers=report.numbers) if known else f"Unknown reason {report.reason & 0xFF}."
    return Stop(
        number=number,
        at_ns=at_ns,
        utc_ns=None if utc_offset_ns is None else at_ns + utc_offset_ns,
        mode_before=mode_before,
        mode=Mode(report.mode).name,
        reason=report.reason,
        code=Reason(report.reason & 0xFF).name if known else f"REASON_{report.reason & 0xFF}",
        numbers=tuple(None if value != value else value for value in report.numbers),
        text=text,
    )
