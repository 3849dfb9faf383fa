"""Metrics of the fault campaign from plain outcomes, with their limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from experiments.common.result import Metric
from hil.faults.catalogue import CASES, Case, Where

HOUR_S: Final = 3600.0
MIN_INJECTIONS: Final = 4500

CAMPAIGN: Final = (
    Metric("cases", "Entries of the catalogue that were exercised or counted", "", "Each entry, with or without a "
           "detector.", least=len(CASES)),
    Metric("injections", "Injections", "", "Faults injected at random moments; an entry without an input to inject "
           "into counts as many missed ones.", least=MIN_INJECTIONS),
    Metric("missed", "Missed injections", "", "Undetected, after the bound, answered more mildly than promised, more "
           "tip travel than promised, or a stop where nothing may stop."),
    Metric("blind_missed", "Missed injections in named blind spots", "", "Of them: entries for which the software has "
           "no input or detector; each is named with its harm."),
    Metric("unexplained", "Missed injections outside the named blind spots", "", "The difference.", most=0.0),
    Metric("neutral_max_ms", "Longest time to neutral valves after the loss of a needed input", "ms", "From the fault "
           "to the moment after which commands or node are neutral for good on the buses, and the outputs of valve node"
           " or PLC too (ground truth): the later of both. Entries of which a needed input is lost.", most=100.0),
    Metric("travel_max_m", "Longest way of the tip from the fault to rest", "m", "Hanger pin in the crane's base frame "
           "by the true joints, intended motion included; all injections that must stop the crane."),
)  # fmt: skip
NOMINAL: Final = (
    Metric("nominal_hours", "Simulated hours of work without a fault", "h", "All stretches, also on rough ground and "
           "with other individual machines.", least=10.0),
    Metric("false_trips", "False trips", "", "Stops in those hours.", most=0.0),
)  # fmt: skip
METRICS: Final = CAMPAIGN + NOMINAL


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """All metrics; outcomes of cases have ``case``, those of nominal work ``trips``."""
    by_case = injections_of(outcomes)
    metrics: dict[str, float] = {}
    for case in CASES:
        metrics |= case_metrics(case, by_case.get(case.number, []))
    prefix = [case_prefix(case) for case in CASES]
    total = {key: sum(metrics[f"{p}_{key}"] for p in prefix) for key in ("injections", "missed")}
    blind = sum(metrics[f"{case_prefix(c)}_missed"] for c in CASES if is_blind(c))
    nominal = [o for o in outcomes.values() if "trips" in o]
    promised = [o for c in CASES if c.promise for o in by_case.get(c.number, [])]
    stopping = [o["travel_m"] for c in CASES for o in by_case.get(c.number, []) if o["expected"] in ("H", "R1", "R0")]
    return metrics | {
        "cases": float(sum(metrics[f"{p}_injections"] > 0 for p in prefix)),
        "injections": total["injections"], "missed": total["missed"], "blind_missed": blind,
        "unexplained": total["missed"] - blind,
        "neutral_max_ms": max((ms for o in promised if (ms := neutral_ms(o)) is not None), default=math.nan),
        "travel_max_m": max(stopping, default=math.nan),
        "nominal_hours": sum(o["seconds"] for o in nominal) / HOUR_S,
        "false_trips": float(sum(len(o["trips"]) for o in nominal)),
    }  # fmt: skip


def injections_of(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[int, list[dict[str, Any]]]:
    """All injections by the number of their case, each with its scene."""
    found: dict[int, list[dict[str, Any]]] = {}
    for outcome in outcomes.values():
        if "case" in outcome:
            rows = [o | {"scene": outcome["scene"]} for o in outcome["outcomes"]]
            found.setdefault(outcome["case"], []).extend(rows)
    return found


def neutral_ms(outcome: Mapping[str, Any]) -> float | None:
    """Time to neutral valves of one injection that must stop the machine, by the buses and by the outputs of valve node
    or PLC, the later of both; infinite if they never were.
    """
    if outcome["expected"] not in ("H", "R1", "R0", "NODE"):
        return None
    if outcome["valves_ms"] is None:
        return math.inf
    return max(float(outcome["valves_ms"]), float(outcome["neutral_ms"] or 0.0))  # a cut bus shows nothing


def is_blind(case: Case) -> bool:
    """Whether the software has nothing that could see this fault."""
    return case.where is Where.ABSENT


def case_prefix(case: Case) -> str:
    """Beginning of the names of a case's metrics."""
    return f"c{case.number:02d}"


def case_metrics(case: Case, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Metrics of one case: number, missed, detection, time to neutral, travel, distance from the reference, and the
    harm of the missed ones: that distance, or the travel where there is no reference."""
    p = case_prefix(case)
    times = [float(o["detect_ms"]) for o in rows if o["detect_ms"] is not None]
    neutral = [ms for o in rows if (ms := neutral_ms(o)) is not None]
    missed = [o for o in rows if o["missed"]]

    def at(share: float) -> float:
        return float(np.percentile(times, share)) if times else math.nan

    return {
        f"{p}_injections": float(len(rows)), f"{p}_missed": float(len(missed)),
        f"{p}_p50_ms": at(50), f"{p}_p99_ms": at(99), f"{p}_max_ms": max(times, default=math.nan),
        f"{p}_neutral_max_ms": max(neutral, default=math.nan),
        f"{p}_travel_max_m": max((o["travel_m"] for o in rows), default=math.nan),
        f"{p}_astray_max_m": max((o["astray_m"] for o in rows), default=math.nan),
        f"{p}_harm_m": max((max(o["astray_m"], 0.0) or o["travel_m"] for o in missed), default=0.0),
    }  # fmt: skip
