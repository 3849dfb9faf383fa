"""A recording in the page: where it stands, and the state of the page there.  Pure but for the recording itself.

The recording is read by whoever starts the console (`Recording`), which needs none of the processes that made it.  A
page has a `ReplayView` of its own: it plays, pauses and seeks by itself.  After a seek the state is built anew from the
second before, so it is the state that the page showed then.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Protocol

from can_dbc.bus.base import BITRATES
from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import VehicleReport
from console.can_table import CanTable
from console.panel import Panel
from console.state import CraneState, timing_facts
from console.timeline import Timeline
from machine.geometry.map_projection import MapProjection, Metres
from machine.profile import Profile

BUILD_NS: Final = 1_000_000_000
"""The state is built from the reports of this time before."""
PLOT_NS: Final = 20_000_000_000
PLOT_STEP_NS: Final = 100_000_000
TABLE_NS: Final = 2_000_000_000
SPEEDS: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
MAX_ENTRIES: Final = 20_000
_ORDER: Final = re.compile(r"(play|pause|seek|speed)(?: (-?[0-9]{1,12}(?:\.[0-9]{1,9})?))?")


class Recording(Protocol):
    """A recorded run; times are the monotonic ones of the run [ns]."""

    begin_ns: int
    end_ns: int
    buses: tuple[str, ...]

    def reports(self, begin_ns: int, end_ns: int) -> Iterator[StateReport | VehicleReport]:
        """Read the controller's reports of a time."""

    def frames(self, bus: str, begin_ns: int, end_ns: int) -> list[Frame]:
        """Read the frames of a bus."""

    def timing(self, at_ns: int) -> dict[str, Any] | None:
        """Read the newest state of the timing page."""


class Overview:
    """The whole run, read once: its timeline and the vehicle's track."""

    def __init__(self, recording: Recording, profile: Profile) -> None:
        self.ground = MapProjection()
        timeline, vehicle = Timeline(MAX_ENTRIES), CraneState(profile, ground=self.ground)
        for report in recording.reports(recording.begin_ns, recording.end_ns + 1):
            if isinstance(report, StateReport):
                timeline.on_report(report)
            else:
                vehicle.accept(report, report.stamp_ns)
        self.entries: list[dict[str, Any]] = list(timeline.entries)
        self.count = timeline.count
        self.trail: list[Metres] = list(vehicle.mission_state.trail)


class ReplayView:
    """What one page shows; ``step`` is called with a clock that only goes forward."""

    def __init__(
        self,
        recording: Recording,
        profile: Profile,
        overview: Overview,
        databases: Mapping[str, Sequence[Database]],
        at_ns: int | None = None,
    ) -> None:
        self.panel = Panel()
        self.playing, self.speed = False, 1.0
        self._recording, self._profile, self._overview, self._databases = recording, profile, overview, databases
        self._now_ns: int | None = None
        self._tables: dict[str, CanTable] = {}
        self._timed: tuple[int, dict[str, Any] | None] = (-1, None)
        self.seek(recording.begin_ns + BUILD_NS if at_ns is None else at_ns)

    def order(self, text: str) -> bool:
        """Take a message of the page; tell whether it was understood."""
        if self.panel.choose(text):
            self._tables = {}
            return True
        order_match = _ORDER.fullmatch(text)
        if order_match is None or (order_match[2] is None) != (order_match[1] in ("play", "pause")):
            return False
        match order_match[1]:
            case "play":
                self.playing = True
                if self.at_ns >= self._recording.end_ns:
                    self.seek(self._recording.begin_ns)
            case "pause":
                self.playing = False
            case "speed":
                self.speed = min(SPEEDS, key=lambda speed: abs(speed - float(order_match[2])))
            case "seek":
                self.seek(round(float(order_match[2]) * 1e9))
        return True

    def seek(self, at_ns: int) -> None:
        """Go to a time of the run, or to its nearer end."""
        recording = self._recording
        self.at_ns = min(max(at_ns, recording.begin_ns), recording.end_ns)
        self._state = CraneState(self._profile, ground=self._overview.ground)
        self._take(self.at_ns - BUILD_NS, self.at_ns)
        self._history: list[tuple[float, list[float | None]]] | None = self._errors()
        self._tables = {}

    def step(self, now_ns: int) -> dict[str, Any]:
        """Go on by the time since the last step, and return the page's state."""
        before_ns, last_ns = self.at_ns, self._now_ns
        self._now_ns = now_ns
        if self.playing and last_ns is not None:
            self.at_ns = min(before_ns + round((now_ns - last_ns) * self.speed), self._recording.end_ns)
            self._take(before_ns, self.at_ns)
            self.playing = self.at_ns < self._recording.end_ns
        state = self._state.state(self.at_ns)
        state |= {
            "entries": self._overview.count,
            "sent_ms": now_ns // 1_000_000,
            "may_stop": False,
            "may_command": False,
            "may_order": False,
            "timing": self._timing(),
            "replay": {"at_s": self.at_ns / 1e9, "playing": self.playing, "speed": self.speed},
        }
        if self._history is not None:
            state["history"], self._history = self._history, None
        if self.panel.shown == "can":
            self._fill_tables(before_ns)
            if self.panel.due(state["sent_ms"]):
                state["can"] = [table.table(self.at_ns) for table in self._tables.values()]
        return state

    def _take(self, begin_ns: int, end_ns: int) -> None:
        for report in self._recording.reports(begin_ns, end_ns):
            self._state.accept(report, report.stamp_ns)

    def _fill_tables(self, before_ns: int) -> None:
        if not self._tables:
            self._tables = {bus: self._new_table(bus) for bus in self._recording.buses}
            before_ns = self.at_ns - TABLE_NS
        for bus, table in self._tables.items():
            table.on_frames(self._recording.frames(bus, before_ns, self.at_ns))

    def _new_table(self, bus: str) -> CanTable:
        return CanTable(bus, self._databases.get(bus, ()), BITRATES.get(bus, 0))

    def _timing(self) -> dict[str, Any] | None:
        """Return the timing card, read again when the time is in another second."""
        second = self.at_ns // 1_000_000_000
        if self._timed[0] != second:
            page = self._recording.timing(self.at_ns)
            self._timed = second, None if page is None else timing_facts(page)
        return self._timed[1]

    def _errors(self) -> list[tuple[float, list[float | None]]]:
        """List the tracking errors of the time that the plot shows [mrad, mm]."""
        error_samples: list[tuple[float, list[float | None]]] = []
        due_ns = 0
        for report in self._recording.reports(self.at_ns - PLOT_NS, self.at_ns):
            if isinstance(report, StateReport) and report.stamp_ns >= due_ns:
                due_ns = report.stamp_ns + PLOT_STEP_NS
                pairs = zip(report.position, report.reference, strict=True)
                errors = [round(1000.0 * (r - q), 3) for q, r in pairs]
                error_samples.append((report.stamp_ns / 1e9, [e if math.isfinite(e) else None for e in errors]))
        return error_samples
