"""Whether an injection was answered as the catalogue promises.  Pure: an outcome in, a verdict out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

SEVERITY: Final = {"D": 1, "H": 2, "R1": 3, "R0": 4}
STOPS: Final = ("H", "R1", "R0")
T_MS: Final = 5.0
NODE_MS: Final = 200.0
"""Bound of a dead controller: the valve node's own time-out makes the valves neutral."""


def judge(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """``detect_ms`` (None: never), ``verdict`` and ``missed`` of an outcome.

    Verdicts: ok; late (after the bound); undetected; weak (a milder reaction than promised); tripped (a stop where
    nothing may stop); far (more tip travel than promised).  All but ok count as missed.
    """
    expected, reached = outcome["expected"], outcome["reached"]
    due_ms = outcome.get("due_ms", 0.0)
    # A fault between two ticks is met by the next; where the bound does not begin, any reaction is in time.
    bound_ms = outcome["bound_ms"] + outcome["seen_ms"] + T_MS + (math.inf if due_ms is None else due_ms)
    stops = [reached[r] for r in STOPS if r in reached]
    match expected:
        case "NONE":
            return _answer(min(stops) if stops else None, "tripped" if stops else "ok")
        case "REFUSED":
            refused = outcome["refused_ms"]
            if stops:
                return _answer(refused, "tripped")
            return _answer(refused, _timed(refused, bound_ms))
        case "X":
            return _answer(reached.get("X"), _timed(reached.get("X"), bound_ms))
        case "NODE":
            return _answer(outcome["valves_ms"], _timed(outcome["valves_ms"], bound_ms))
    enough = [ms for r, ms in reached.items() if SEVERITY.get(r, 0) >= SEVERITY[expected]]
    if not enough:
        return _answer(min(reached.values(), default=None), "weak" if reached else "undetected")
    detect_ms = min(enough)
    verdict = _timed(detect_ms, bound_ms)
    limit_m = outcome["tip_limit_m"]
    if verdict == "ok" and limit_m is not None and outcome["astray_m"] > limit_m:
        verdict = "far"
    return _answer(detect_ms, verdict)


def _timed(found_ms: float | None, bound_ms: float) -> str:
    if found_ms is None:
        return "undetected"
    return "ok" if found_ms <= bound_ms else "late"


def _answer(detect_ms: float | None, verdict: str) -> dict[str, Any]:
    return {"detect_ms": detect_ms, "verdict": verdict, "missed": verdict != "ok"}
