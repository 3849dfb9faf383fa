"""Metrics of the fault campaign from plain outcomes, with their limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from experiments.common.result import Metric
from hil.faults.catalogue import CASES, Case

HOUR_S: Final = 3600.0
MIN_INJECTIONS: Final = 4500

CAMPAIGN: Final = (
    Metric(
        "cases",
        "Entries of the catalogue that were exercised or counted",
        "",
        "Each entry, with or without a detector.",
        least=len(CASES),
    ),
    Metric(
        "injections",
        "Injections",
        "",
        "Faults injected at random moments; an entry without an input to inject into counts as many missed ones.",
        least=MIN_INJECTIONS,
    ),
    Metric(
        "missed",
        "Missed injections",
        "",
        "Undetected, after the bound, answered more mildly than promised, more "
        "tip travel than promised, or a stop where nothing may stop.",
    ),
    Metric(
        "blind_missed",
        "Missed injections in named blind spots",
        "",
        "Of them: entries, or works of an entry, for "
        "which the software has no input or detector; each is named with its harm.",
    ),
    Metric("unexplained", "Missed injections outside the named blind spots", "", "The difference.", most=0.0),
    Metric(
        "neutral_max_ms",
        "Longest time to neutral valves after the loss of a needed input",
        "ms",
        "From the fault to the moment after which the outputs of valve node or PLC to the crane's joints, and the "
        "vehicle's drive, are neutral for good; grapple, steering and swing arms are not looked at (ground truth; a "
        "frame tells it up to its period later). Entries of which a needed input is lost.",
        most=100.0,
    ),
    Metric(
        "travel_max_m",
        "Longest way of the tip from the fault to rest",
        "m",
        "Hanger pin in the crane's base frame "
        "by the true joints, intended motion included; all injections that must stop the crane.",
    ),
)
NOMINAL: Final = (
    Metric(
        "nominal_hours",
        "Simulated hours of work without a fault",
        "h",
        "All stretches, also on rough ground and with other individual machines.",
        least=10.0,
    ),
    Metric(
        "false_trips",
        "False trips",
        "",
        "Stops in those hours; `work-without-faults.md` beside the evidence pages names each.",
        most=0.0,
    ),
)
METRICS: Final = CAMPAIGN + NOMINAL


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Compute all metrics; outcomes of cases have ``case``, those of nominal work ``trips``."""
    by_case = injections_of(outcomes)
    metrics: dict[str, float] = {}
    for case in CASES:
        metrics |= case_metrics(case, by_case.get(case.number, []))
    prefix = [case_prefix(case) for case in CASES]
    total = {key: sum(metrics[f"{p}_{key}"] for p in prefix) for key in ("injections", "missed")}
    blind = sum(metrics[f"{p}_blind_missed"] for p in prefix)
    nominal = [o for o in outcomes.values() if "trips" in o]
    promised = [o for c in CASES if c.promise for o in by_case.get(c.number, [])]
    stopping = [o["travel_m"] for c in CASES for o in by_case.get(c.number, []) if o["expected"] in ("H", "R1", "R0")]
    return metrics | {
        "cases": float(sum(metrics[f"{p}_injections"] > 0 for p in prefix)),
        "injections": total["injections"],
        "missed": total["missed"],
        "blind_missed": blind,
        "unexplained": total["missed"] - blind,
        "neutral_max_ms": max((ms for o in promised if (ms := neutral_ms(o)) is not None), default=math.nan),
        "travel_max_m": max(stopping, default=math.nan),
        "nominal_hours": sum(o["seconds"] for o in nominal) / HOUR_S,
        "false_trips": float(sum(len(o["trips"]) for o in nominal)),
    }


def injections_of(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[int, list[dict[str, Any]]]:
    """Group all injections by the number of their case, each with its scene."""
    by_case: dict[int, list[dict[str, Any]]] = {}
    for outcome in outcomes.values():
        if "case" in outcome:
            rows = [o | {"scene": outcome["scene"]} for o in outcome["outcomes"]]
            by_case.setdefault(outcome["case"], []).extend(rows)
    return by_case


def neutral_ms(outcome: Mapping[str, Any]) -> float | None:
    """Compute the time to neutral outputs of valve node, vehicle or PLC (ground truth) of one injection that must stop
    the machine; infinite if they never were.
    """
    if outcome["expected"] not in ("H", "R1", "R0", "NODE"):
        return None
    return math.inf if outcome["valves_ms"] is None else float(outcome["valves_ms"])


def harm_m(outcome: Mapping[str, Any]) -> float:
    """Compute the distance of the tip from its reference [m], or its travel where there is no reference."""
    return max(float(outcome["astray_m"]), 0.0) or float(outcome["travel_m"])


def is_blind(case: Case, missed: Mapping[str, Any]) -> bool:
    """Tell whether a missed injection, with its scene, is in a blind spot that the catalogue names."""
    named = missed["scene"].split()[0] in case.blind_in or missed["verdict"] in case.blind_as
    return named and harm_m(missed) <= case.blind_most_m


def case_prefix(case: Case) -> str:
    """Return the beginning of the names of a case's metrics."""
    return f"c{case.number:02d}"


def case_metrics(case: Case, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Compute the metrics of one case: number, missed, those in named blind spots, detection, time to neutral, travel,
    distance from the reference, and the harm of the missed ones: that distance, or the travel where there is no
    reference.
    """
    p = case_prefix(case)
    times = [float(o["detect_ms"]) for o in rows if o["detect_ms"] is not None]
    neutral = [ms for o in rows if (ms := neutral_ms(o)) is not None]
    missed = [o for o in rows if o["missed"]]
    blind = [o for o in missed if is_blind(case, o)]

    def at(share: float) -> float:
        return float(np.percentile(times, share)) if times else math.nan

    return {
        f"{p}_injections": float(len(rows)),
        f"{p}_missed": float(len(missed)),
        f"{p}_blind_missed": float(len(blind)),
        f"{p}_p50_ms": at(50),
        f"{p}_p99_ms": at(99),
        f"{p}_max_ms": max(times, default=math.nan),
        f"{p}_neutral_max_ms": max(neutral, default=math.nan),
        f"{p}_travel_max_m": max((o["travel_m"] for o in rows), default=math.nan),
        f"{p}_astray_max_m": max((o["astray_m"] for o in rows), default=math.nan),
        f"{p}_harm_m": max(map(harm_m, missed), default=0.0),
    }
