"""What became of an injected fault: what stopped the machine, why, after how long, how far the tip moved.  Pure.

The tip is the hanger pin by the joints' encoders, as the controller reports it, so a fault of an encoder falsifies it,
and the card says so.  Two ways are measured: from the fault to the reaction, and from there until the machine rests.
The answer to an order may be later than the reaction, so the last reports are kept and followed from the fault's time.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

from can_dbc.messages.crane import StateReport
from console.timeline import stop_words
from machine.geometry import kinematics
from machine.profile import Profile
from machine.status.modes import STOPPED, mode_name

FOLLOWED_NS: Final = 10_000_000_000
"""A fault that has not stopped the machine by then is said not to have done so."""
KEPT_NS: Final = 12_000_000_000
"""Reports of this time are kept."""
REST_NS: Final = 3_000_000_000
"""So long after the reaction the tip is followed."""
PIN: Final = 4
"""Of `kinematics.ChainPoints`: the hanger pin."""
_STOPPED_NAMES: Final = tuple(mode.name for mode in STOPPED)
Tip = tuple[float, ...]


class FaultWatch:
    """Follows the newest fault."""

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._recent: deque[StateReport] = deque()
        self._fault: dict[str, Any] | None = None
        self._at_ns = self._reacted_ns = 0
        self._reason = 0
        self._from: Tip | None = None

    def begin(self, title: str, said: str, at_ns: int) -> None:
        """Begin to watch a fault that has begun at ``at_ns``, now or some seconds ago."""
        before = [report for report in self._recent if report.stamp_ns < at_ns]
        last = before[-1] if before else None
        self._at_ns, self._reacted_ns = at_ns, 0
        self._reason, self._from = (last.reason, self._tip(last)) if last else (0, None)
        self._fault = {
            "title": title,
            "said": said,
            "begun_in": mode_name(last.mode) if last else "unknown",
            "stood": last is not None and last.mode in STOPPED,
            "stop": None,
            "ms": None,
            "before_mm": None,
            "after_mm": None,
            "done": False,
        }
        for report in self._recent:
            self._follow(report)

    def on_report(self, report: StateReport) -> None:
        """Take a state report."""
        self._recent.append(report)
        while self._recent[0].stamp_ns < report.stamp_ns - KEPT_NS:
            self._recent.popleft()
        self._follow(report)

    def card(self) -> dict[str, Any] | None:
        """Return the card for the page; None before the first fault."""
        return self._fault

    def _follow(self, report: StateReport) -> None:
        fault = self._fault
        if fault is None or fault["done"] or report.stamp_ns < self._at_ns:
            return
        reason = report.reason if report.reason & 0xFF else 0
        stops = report.mode in STOPPED and not fault["stood"]
        if (stops and (fault["stop"] is None or fault["stop"]["mode"] not in _STOPPED_NAMES)) or (
            not self._reacted_ns and reason and reason != self._reason
        ):
            self._react(fault, report)
        elif self._reacted_ns and fault["stop"]["mode"] in _STOPPED_NAMES and report.mode not in STOPPED:
            fault["done"] = True  # reset or armed again: what moves now is the next motion
        elif self._reacted_ns:
            way_mm = self._way_mm(report)
            if way_mm is not None:
                fault["after_mm"] = max(way_mm, fault["after_mm"] or 0.0)
            fault["done"] = report.stamp_ns >= self._reacted_ns + REST_NS
        else:
            fault["done"] = report.stamp_ns >= self._at_ns + FOLLOWED_NS

    def _react(self, fault: dict[str, Any], report: StateReport) -> None:
        since_ns = report.since_ns if report.since_ns >= self._at_ns else report.stamp_ns
        code, text, advice = stop_words(report)
        fault["stop"] = {"code": code, "text": text, "advice": advice, "mode": mode_name(report.mode)}
        if not self._reacted_ns:  # the reaction begins with its first reason, also when a STOP follows a slower motion
            fault["ms"] = round((since_ns - self._at_ns) / 1e6, 1)
            fault["before_mm"] = self._way_mm(report)
            self._from = self._tip(report) or self._from
            fault["after_mm"] = None if self._from is None else 0.0
        self._reacted_ns = since_ns

    def _way_mm(self, report: StateReport) -> float | None:
        tip = self._tip(report)
        return None if tip is None or self._from is None else round(1000.0 * math.dist(tip, self._from), 1)

    def _tip(self, report: StateReport) -> Tip | None:
        q = report.position[:4]
        if not all(map(math.isfinite, q)):
            return None
        return tuple(kinematics.chain_points(self._profile.kinematics, (*q, 0.0))[PIN])
