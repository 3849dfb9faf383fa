"""The numbers of a shift: logs, volume, stops, metres driven and working time, from the reports as they arrive.  Pure.

A shift begins with the console's first report of the controller or when a person begins a new one, and counts whether a
page is open or not.  Of a mission that had begun before, only what follows is counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.messages.crane import StateReport
from can_dbc.messages.mission import MissionReport
from machine.status.modes import Mode

MIN_RATE_NS: Final = 300_000_000_000
"""Volume per hour is told from this time on: before, a single log decides it."""
MAX_GAP_NS: Final = 1_000_000_000
"""Between reports that are farther apart it is unknown whether the machine worked."""


@dataclass(slots=True)
class _Counts:
    """What a shift has counted."""

    logs: int = 0
    volume_m3: float = 0.0
    driven_m: float = 0.0
    lifts: int = 0
    stops: int = 0
    working_ns: int = 0


class Shift:
    """Takes reports in their order."""

    def __init__(self) -> None:
        self._begun_ns: int | None = None
        self._counts = _Counts()
        self._mission: MissionReport | None = None
        self._report_ns = 0
        self._events_known = (0, 0)

    def begin(self, now_ns: int) -> None:
        """Begin a new shift now; the present mission is counted from here."""
        self._begun_ns, self._counts = now_ns, _Counts()

    def on_report(self, report: StateReport, now_ns: int, stops: int, lifts: int) -> None:
        """Take a state report; ``stops`` and ``lifts`` are those of the timeline since the console began."""
        if self._begun_ns is None:
            self.begin(now_ns)
        counts, (stops_known, lifts_known) = self._counts, self._events_known
        counts.stops += stops - stops_known
        counts.lifts += lifts - lifts_known
        self._events_known = (stops, lifts)
        if report.mode == Mode.ACTIVE and 0 < now_ns - self._report_ns < MAX_GAP_NS:
            counts.working_ns += now_ns - self._report_ns
        self._report_ns = now_ns

    def on_mission(self, report: MissionReport) -> None:
        """Take a mission report."""
        last, self._mission = self._mission, report
        if last is None or last.name != report.name or report.loaded < last.loaded:
            return
        counts = self._counts
        counts.logs += report.loaded - last.loaded
        counts.driven_m += max(0.0, report.driven_m - last.driven_m)
        gained_m3 = report.on_board_m3 - last.on_board_m3
        if report.loaded > last.loaded and math.isfinite(gained_m3):
            counts.volume_m3 += max(0.0, gained_m3)

    def numbers(self, now_ns: int) -> dict[str, Any] | None:
        """The numbers for the page; None before the first report."""
        if self._begun_ns is None:
            return None
        c, long_ns = self._counts, now_ns - self._begun_ns
        return {
            "seconds": round(long_ns * 1e-9),
            "working_s": round(c.working_ns * 1e-9),
            "logs": c.logs,
            "lifts": c.lifts,
            "stops": c.stops,
            "driven_m": round(c.driven_m, 1),
            "m3": round(c.volume_m3, 3),
            "m3_h": round(c.volume_m3 * 3.6e12 / long_ns, 2) if long_ns >= MIN_RATE_NS else None,
        }
