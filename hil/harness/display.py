"""The terminal view of a run: phase, joints, bus, timing and every event in words.

On a terminal a small table is redrawn in place; elsewhere (a pipe, CI) one row of a table is printed per second, 80
columns wide.  Input: state reports and events.
"""

from __future__ import annotations

import math

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS, Joint
from machine.status.modes import Mode

_LINE_EVERY_NS = 1_000_000_000
_DRAW_EVERY_NS = 100_000_000
_ROOM_MIN = 20
_ROWS_PER_HEADING = 40
_COLUMNS = (*(j.name.lower() for j in JOINTS), "opening")
_HEADING = f"{'time':>8}  {'mode':<8}{'phase':<8}" + "".join(f" {name:>8}" for name in _COLUMNS)


def say(console: Console, lead: str, text: str, style: str = "") -> None:
    """Print ``text`` after ``lead``: on a terminal broken between words and indented, elsewhere in one line."""
    head, body = Text.from_markup(lead), Text.from_markup(text)
    room = max(console.width - head.cell_len, _ROOM_MIN) if console.is_terminal else max(body.cell_len, 1)
    for line in body.wrap(console, room):
        line.rstrip()
        # Soft wrapping would reach the table of a `Live` too, which is drawn again below the line.
        console.print(head + line, style=style or None, highlight=False, soft_wrap=not console.is_terminal)
        head = Text(" " * head.cell_len)


class Display:
    """The terminal view of one run; use as a context manager."""

    def __init__(self, console: Console, title: str) -> None:
        self._console = console
        self._title = title
        self._phase = "starting"
        self._report: StateReport | None = None
        self._rate_hz = 0.0
        self._rate_mark: tuple[int, int] | None = None
        self._start_ns: int | None = None
        self._next_ns = 0
        self._tick_ns = 0
        self._late_ns = 0
        self._rows = 0
        self._live: Live | None = None

    def __enter__(self) -> Display:
        say(self._console, "", self._title, "bold")
        if self._console.is_terminal:
            self._live = Live(console=self._console, refresh_per_second=10, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def event(self, text: str, style: str = "") -> None:
        """Print one event; it stays on the screen."""
        say(self._console, f"{self._elapsed_s():6.1f} s  " if self._start_ns is not None else " " * 10, text, style)

    def phase(self, name: str) -> None:
        """Show the planner's new phase."""
        self._phase = name
        self.event(f"→ {name}", "cyan")

    def report(self, report: StateReport) -> None:
        """Take the controller's newest report; redraw when due."""
        if self._start_ns is None:
            self._start_ns = self._next_ns = report.stamp_ns
        self._report = report
        self._tick_ns = max(self._tick_ns, report.tick_ns)
        self._late_ns = max(self._late_ns, report.late_ns)
        self._measure_rate(report)
        if report.stamp_ns < self._next_ns:
            return
        if self._live:
            self._next_ns = report.stamp_ns + _DRAW_EVERY_NS
            self._live.update(self._table(report))
        else:
            self._next_ns += _LINE_EVERY_NS
            if self._rows % _ROWS_PER_HEADING == 0:
                self._console.print(_HEADING, highlight=False, soft_wrap=True)
            self._rows += 1
            self._console.print(self._row(report), highlight=False, soft_wrap=True)

    def _elapsed_s(self) -> float:
        now = self._report.stamp_ns if self._report else 0
        return (now - (self._start_ns or now)) / 1e9

    def _measure_rate(self, report: StateReport) -> None:
        if self._rate_mark is None:
            self._rate_mark = (report.stamp_ns, report.frames_received)
        elif report.stamp_ns - self._rate_mark[0] >= _LINE_EVERY_NS:
            frames = report.frames_received - self._rate_mark[1]
            self._rate_hz = frames * 1e9 / (report.stamp_ns - self._rate_mark[0])
            self._rate_mark = (report.stamp_ns, report.frames_received)

    def _row(self, report: StateReport) -> str:
        joints = "".join(f" {_value_text(j, report.position[j]):>8}" for j in JOINTS)
        opening = _whole_text(report.opening_pct, "%")
        return f"{self._elapsed_s():6.1f} s  {Mode(report.mode).name:<8}{self._phase:<8}{joints} {opening:>8}"

    def _table(self, report: StateReport) -> Table:
        mode = Mode(report.mode)
        table = Table(title=f"{self._phase} · {mode.name}", title_justify="left", box=None, pad_edge=False)
        for heading in ("joint", "measured", "reference", "error"):
            table.add_column(heading, justify="left" if heading == "joint" else "right", min_width=11)
        for j in JOINTS:
            error = report.reference[j] - report.position[j]
            table.add_row(
                j.name.lower(),
                _value_text(j, report.position[j]),
                _value_text(j, report.reference[j]),
                _value_text(j, error),
            )
        table.add_row("grapple", _whole_text(report.opening_pct, "% open"), _whole_text(report.clamp_bar, "bar"), "")
        table.caption = (
            f"{self._elapsed_s():.1f} s   bus {self._rate_hz:.0f} frames/s   longest tick "
            f"{self._tick_ns / 1e6:.2f} ms   longest delay {self._late_ns / 1e6:.2f} ms   "
            f"missed {report.missed_ticks}"
        )
        table.caption_justify = "left"
        return table


def _value_text(joint: Joint, value: float) -> str:
    """Format metres for the telescope, degrees for the other joints; a dash for an unknown value."""
    if math.isnan(value):
        return "–".rjust(7)
    return f"{value:6.3f} m" if joint is Joint.EXT else f"{math.degrees(value):6.1f}°"


def _whole_text(value: float, unit: str) -> str:
    """Format a value without decimals; a dash for an unknown one."""
    return "–" if math.isnan(value) else f"{value:.0f} {unit}"
