"""``/diagnostics``: the machine's mode, and the reason why it stopped or cannot be armed, in the operator's words."""

from __future__ import annotations

from math import isfinite
from typing import Final

from can_dbc.messages.crane import StateReport
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.stale_inputs import STALE_INPUT_NAMES
from ros2.interfaces.builtin import Header, time_of
from ros2.interfaces.diagnostic import ERROR, OK, STALE, WARN, DiagnosticArray, DiagnosticStatus, KeyValue

SILENT_NS: Final = 1_000_000_000
"""Without a report for so long the machine's state is unknown."""
_LEVELS: Final = {Mode.STOP: WARN, Mode.FAULT: ERROR, Mode.BOOT: WARN}


def diagnostics(machine: str, report: StateReport | None, refused: str, stamp_ns: int) -> DiagnosticArray:
    """The state of the machine by its last ``report``, None when it is silent; ``refused`` is the sentence about the
    last goal that was not executed, empty when there is none.
    """
    if report is None:
        status = DiagnosticStatus(STALE, "timberhand: machine", "the controller is silent", machine, [])
        return DiagnosticArray(Header(time_of(stamp_ns), ""), [status])
    mode = next((mode for mode in Mode if mode == report.mode), None)
    name = str(report.mode) if mode is None else mode.name
    level = WARN if mode is None else _LEVELS.get(mode, WARN if report.reason else OK)
    text = f"{name}: {describe(report.reason, numbers=report.numbers)}" if report.reason else name
    stale = [words for bit, words in sorted(STALE_INPUT_NAMES.items()) if report.stale_mask >> bit & 1]
    values = {
        "mode": name,
        "reason": str(report.reason & 0xFF),
        "stale inputs": ", ".join(stale) or "none",
        "refused setpoints": str(report.refused),
        "load [kg]": _number(report.load_kg),
        "grapple opening [%]": _number(report.opening_pct),
        "missed ticks": str(report.missed_ticks),
        "last goal that was not executed": refused or "none",
    }
    pairs = [KeyValue(key, value) for key, value in values.items()]
    status = DiagnosticStatus(level, "timberhand: machine", text, machine, pairs)
    return DiagnosticArray(Header(time_of(stamp_ns), ""), [status])


def _number(value: float) -> str:
    return f"{value:.1f}" if isfinite(value) else "unknown"
