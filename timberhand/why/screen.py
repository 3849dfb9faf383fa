"""A stop for a person, and as a dictionary for JSON."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Any, Final

from rich.console import Console
from rich.markup import escape

from machine.status.evidence import EVIDENCE
from machine.status.reasons import Reason
from recorder.stop_recorder import Stop
from timberhand.why.stops import FoundStop
from timberhand.why.timeline import Event

MAX_EVENTS: Final = 24
"""Lines of the timeline; the ones nearest to the stop are kept."""
_STYLES: Final = {"FAULT": "bold red", "STOP": "bold yellow"}


def when(stop: Stop) -> str:
    """Write the time of the stop: UTC, or in lockstep the virtual time, which the candump files have too."""
    if stop.utc_ns is None:
        return f"at {stop.at_ns / 1e9:.3f} s of virtual time"
    at = datetime.datetime.fromtimestamp(stop.utc_ns // 10**9, datetime.UTC)
    return f"at {at:%Y-%m-%d %H:%M:%S}.{stop.utc_ns // 10**6 % 1000:03d} UTC"


def show(console: Console, found: FoundStop, events: Sequence[Event]) -> None:
    """Print time, mode, reason, numbers, advice, timeline and file."""
    stop, explained = found.stop, found.stop.explanation
    style = _STYLES.get(stop.mode, "bold")
    head = f"[{style}]{stop.mode}[/] {when(stop)}, {stop.mode_before} before, {escape(found.manifest.profile)}"
    _line(console, head)
    for name, lines in (
        ("code", [explained.code]),
        ("what", [explained.sentence]),
        ("measured", _measured(stop)),
        ("what to do", [explained.advice]),
    ):
        for number, line in enumerate(lines):
            _line(console, f"  [dim]{'' if number else name:<12}[/]{escape(line)}")
    _line(console, "[dim]  what happened[/]")
    shown_events = sorted(sorted(events, key=lambda event: abs(event.at_s))[:MAX_EVENTS])
    for event in shown_events:
        _line(console, f"  {event.at_s:+9.3f} s  {escape(event.text)}")
    if not shown_events:
        _line(console, "  nothing else in the two seconds before it")
    if len(shown_events) < len(events):
        _line(console, f"  {len(events) - len(shown_events)} more events are in --json")
    _line(console, f"[dim]  recorded in[/]  {escape(str(found.source))}")


def _measured(stop: Stop) -> list[str]:
    """List the numbers, one a line, or why there are none."""
    if quantities := [quantity.text for quantity in stop.explanation.quantities]:
        return quantities
    if Reason(stop.reason & 0xFF) not in EVIDENCE:
        return ["no number belongs to this reason"]
    return ["unknown" if stop.numbers else "not recorded; the recording is of an earlier release"]


def _line(console: Console, markup: str) -> None:
    console.print(markup, highlight=False, soft_wrap=True)


def as_dict(found: FoundStop, events: Sequence[Event]) -> dict[str, Any]:
    """Return the same for JSON, with values in SI units (times in ms where the unit says so)."""
    stop, explained = found.stop, found.stop.explanation
    return {
        "number": stop.number,
        "utc_ns": stop.utc_ns,
        "monotonic_ns": stop.at_ns,
        "profile": found.manifest.profile,
        "mode_before": stop.mode_before,
        "mode": stop.mode,
        "code": explained.code,
        "reason": stop.reason & 0xFF,
        "detail": stop.reason >> 8,
        "sentence": explained.sentence,
        "measured": [quantity._asdict() for quantity in explained.quantities],
        "advice": explained.advice,
        "text": explained.text,
        "events": [event._asdict() for event in events],
        "recording": str(found.source),
    }
