"""The timeline: modes, stops with sentence and remedy, and loads, from state reports and mission reports.  Pure.

A stop begins as in the recorder's files.  A load is what the grapple holds: from its lift, once it has been weighed,
until the grapple opens.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from can_dbc.messages.crane import StateReport
from can_dbc.messages.mission import MissionReport
from machine.status.explanation import StopDetector, explain
from machine.status.modes import mode_name
from machine.status.reasons import known

ENTRIES: Final = 400
"""The newest entries are kept; of a long run the beginning is in its recording."""
HOLDING: Final = 5
"""``GrappleStat.State``: stopped by its load."""
OPEN_STATES: Final = (1, 2)
"""``GrappleStat.State``: open, opening."""


LIFTED_KG: Final = 10.0
"""Jaws that close empty are stopped, too, and a log on the ground weighs nothing: a load bears at least this."""
WEIGHED_NS: Final = 1_000_000_000
"""So long it hangs before its weight is told; lifting takes about as long."""


class Timeline:
    """Takes reports in their order; ``entries`` are dictionaries for JSON, oldest first."""

    def __init__(self, limit: int = ENTRIES) -> None:
        self.entries: deque[dict[str, Any]] = deque(maxlen=limit)
        self.count = 0
        """Entries so far: the page asks again when this has changed."""
        self.stops = self.lifts = 0
        """Stops and held loads so far."""
        self._mode: int | None = None
        self._reason = 0
        self._detector = StopDetector()
        self._holds = False
        self._lifted_ns: int | None = None
        self._mission: MissionReport | None = None

    def on_report(self, report: StateReport) -> None:
        """Take a state report."""
        if report.mode != self._mode or report.reason != self._reason:
            self._on_mode(report)
        self._on_grapple(report)

    def on_mission(self, report: MissionReport, now_ns: int) -> None:
        """Take a mission report."""
        last, self._mission = self._mission, report
        if last is None or last.name != report.name:
            self._add(now_ns, "mission", f"Mission {report.name}", "")
            return
        if report.loaded > last.loaded:
            volume = f"{report.on_board_m3:.2f} m³" if math.isfinite(report.on_board_m3) else "unknown volume"
            self._add(now_ns, "load", "Log loaded", f"{report.on_board} on board, {volume}.")
        if report.unloaded > last.unloaded:
            self._add(now_ns, "load", "Log unloaded", f"{report.unloaded} unloaded, {report.on_board} on board.")
        if report.ended and not last.ended:
            self._add(now_ns, "mission", "Mission ended", report.failure or "As planned.")

    def _on_mode(self, report: StateReport) -> None:
        changed, name = report.mode != self._mode, mode_name(report.mode)
        self._mode, self._reason = report.mode, report.reason
        before = self._detector.step(report.mode, report.reason)
        if before is not None:
            self.stops += 1
            self._add(report.since_ns or report.stamp_ns, "stop", *stop_words(report), mode=name, before=before)
        elif changed:  # also the FAULT behind the ramp of its STOP, or stopped before the first report
            self._add(report.stamp_ns, "mode", name, "", mode=name)

    def _on_grapple(self, report: StateReport) -> None:
        if report.grapple_state in OPEN_STATES:
            self._lifted_ns = None
            if self._holds:
                self._holds = False
                self._add(report.stamp_ns, "grip", "Grapple opens", "")
        elif report.grapple_state == HOLDING and not self._holds:
            if report.load_kg < LIFTED_KG:
                self._lifted_ns = None
                return
            if self._lifted_ns is None:
                self._lifted_ns = report.stamp_ns
            if math.isnan(report.load_kg) or report.stamp_ns - self._lifted_ns >= WEIGHED_NS:
                self._holds = True
                self.lifts += 1
                weight = "weight not known" if math.isnan(report.load_kg) else f"{report.load_kg:.0f} kg"
                self._add(self._lifted_ns, "grip", "Grapple holds a load", f"{weight}.")

    def _add(self, at_ns: int, kind: str, title: str, text: str, advice: str = "", **more: Any) -> None:
        self.count += 1
        self.entries.append(
            {"n": self.count, "at_s": at_ns / 1e9, "kind": kind, "title": title, "text": text, "advice": advice, **more}
        )


def stop_words(report: StateReport) -> tuple[str, str, str]:
    """Return code, sentence with what was measured, and remedy of a stop."""
    if known(report.reason) is None:
        code = f"REASON_{report.reason & 0xFF}"
        return code, "A reason of another release.", "Run controller and console of one release."
    explanation = explain(report.reason, report.numbers)
    measured = "; ".join(quantity.text for quantity in explanation.quantities)
    return explanation.code, explanation.sentence + (f" Measured: {measured}." if measured else ""), explanation.advice
