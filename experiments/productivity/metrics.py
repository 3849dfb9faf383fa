"""Metrics of the productivity experiment with their limits, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from experiments.common.result import Metric, rate
from experiments.common.result_page import Section

HOUR_S: Final = 3600.0
EXPERT_S: Final = (20.0, 25.0)
"""Time of an expert for a single log from the ground into the bunk (docs/reference/machines.md section 10, assumed)."""
HUMAN_S: Final = (18.0, 25.0)
"""Crane cycle of an operator with 40 to 50 grapple loads per load (derived on assumed sizes, Manner 2016)."""
KIND_TITLES: Final = {"singles": "Single logs", "piles": "Piles", "landing": "Unloading"}

CONCLUSION: Final = (
    "A crane cycle for one log takes {cycle_median_s} in the median, {over_shortest} times the shortest possible time.",
    "The machine loads {logs_per_hour} single logs or {piles.logs_per_hour} logs from piles per hour, driving "
    "included, and unloads a full bunk in {unload_s}.",
)
CYCLES: Final = (
    Metric(
        "cycle_median_s",
        "Crane cycle, one log from the ground into the bunk: median",
        "s",
        "From the detection of the logs until the crane is clear of the stakes with the log in the bunk; grasps of one "
        "log on the route of single logs.",
        most=25.0,
    ),
    Metric(
        "cycle_p90_s", "Crane cycle, one log from the ground into the bunk: 90th percentile", "s", "The same grasps."
    ),
    Metric(
        "shortest_median_s",
        "Shortest possible time for the same paths, median",
        "s",
        "What joint speeds, joint accelerations and the pump's flow allow for the same paths, plus closing and opening "
        "of the grapple; without detection, settling and jerk limit.",
    ),
    Metric("over_shortest", "Crane cycle over the shortest possible time, mean", "", "The same grasps."),
    Metric("piles.cycle_median_s", "Crane cycle from a pile: median", "s", "One grasp of any number of logs."),
    Metric("piles.logs_per_grasp", "Logs per grasp from a pile", "", "Grasps with at least one log."),
)
HOURS: Final = (
    Metric(
        "logs_per_hour",
        "Single logs: logs per hour",
        "",
        "Loaded logs over the time from the first state after arming to the end of the route, driving included.",
    ),
    Metric("m3_per_hour", "Single logs: wood per hour", "m³", "The same time; cylinders of the mid diameter."),
    Metric("crane_logs_per_hour", "Single logs: logs per hour of crane work", "", "The same, without driving."),
    Metric("piles.logs_per_hour", "Piles: logs per hour", "", "As for single logs."),
    Metric("piles.m3_per_hour", "Piles: wood per hour", "m³", "As for single logs."),
    Metric("loaded", "Logs loaded", "%", "Share of all single logs and logs in piles, by the plant's physics."),
    Metric("faults", "Stops and faults", "", "All runs.", most=0.0),
)
UNLOADING: Final = (
    Metric(
        "unload_s", "Time to unload a full bunk", "min", "From the start of the first grasp to the end of the last."
    ),
    Metric("unload_logs_per_hour", "Logs per hour while unloading", "", "The same time."),
    Metric("unload_m3_per_hour", "Wood per hour while unloading", "m³", "The same time."),
    Metric("unload_cycle_median_s", "Crane cycle while unloading: median", "s", "One grasp of any number of logs."),
    Metric("unload_logs_per_grasp", "Logs per grasp while unloading", "", "Grasps with at least one log."),
    Metric("unloaded", "Logs delivered to the landing", "%", "Within 3 m of its middle and not on board."),
)
METRICS: Final = CYCLES + HOURS + UNLOADING
INTRODUCTION: Final = (
    "This experiment measures how much wood the machine moves per hour. The nominal machine has three tasks with birch "
    "logs of about 2 m by 25 cm: single logs right and left of a straight route; small piles of paper A's sizes, two "
    "to six logs each; and a full bunk that is driven to a landing and unloaded. The whole machine is on its two buses "
    "in lockstep; an ideal detector without errors sees the logs."
)
HUMAN: Final = (
    f"Human operators: an expert loads a single log into the bunk in {EXPERT_S[0]:.0f} to {EXPERT_S[1]:.0f} s "
    "(assumed; 145 to 180 logs per hour of crane work). In 8868 loads of nine operators (Manner 2016) loading takes 45 "
    f"% of 45.8 minutes per load, and the crane moves for 75 % of it: {HUMAN_S[0]:.0f} to {HUMAN_S[1]:.0f} s per cycle "
    "with 40 to 50 grapple loads, and 20 to 22 m³ per hour of productive work with 16 m³ per load (derived on assumed "
    "sizes). Unloading takes 19 %, 8.7 minutes. Those cycles hold many thin logs; ours hold one or a few."
)


@dataclass(frozen=True, slots=True)
class Cycle:
    """One grasp: state of the manager, number of logs, duration, durations of its phases and shortest possible time
    [s].

    ``good``: it succeeded.
    """

    state: str
    logs: int
    seconds: float
    phases: tuple[tuple[str, float], ...]
    shortest_s: float
    good: bool


def cycles(outcome: Mapping[str, Any], grapple_s: float) -> Iterator[Cycle]:
    """Find the completed grasps of a mission; ``grapple_s``: minimum time for closing and opening the grapple."""
    for grasp in outcome["grasps"]:
        if "end_s" not in grasp:
            continue
        ends = [begin for _, begin, _ in grasp["phases"][1:]] + [grasp["end_s"]]
        phases = tuple((n, end - begin) for (n, begin, _), end in zip(grasp["phases"], ends, strict=True))
        shortest = sum(s for name, _, s in grasp["phases"] if name != "CLOSE") + grapple_s
        logs = grasp["attempts"][-1]["logs"] if grasp["attempts"] else 0
        yield Cycle(grasp["state"], logs, grasp["end_s"] - grasp["begin_s"], phases, shortest, grasp["failure"] is None)


def sections() -> tuple[Section, ...]:
    """Make the sections of the page."""
    return (
        Section(
            "Crane cycle",
            HUMAN,
            CYCLES,
            (("cycles.png", "Every grasp and its phases; black bars: the shortest possible time for the same paths."),),
        ),
        Section("Logs and wood per hour", "", HOURS),
        Section("Unloading", "", UNLOADING),
    )


def gather(outcomes: Mapping[str, Any], grapple_s: float) -> dict[str, float]:
    """Compute the metrics of all runs; outcomes are named KIND/NUMBER."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for name, outcome in outcomes.items():
        kinds.setdefault(name.split("/")[0], []).append(outcome)
    metrics: dict[str, float] = {"faults": float(sum(o["stops"] for o in outcomes.values()))}
    loads = [o for kind in ("singles", "piles") for o in kinds.get(kind, [])]
    logs = [log for o in loads for log in o["logs"]]
    metrics |= rate("loaded", sum(log["in_bunk"] for log in logs), len(logs))
    for kind, prefix in (("singles", ""), ("piles", "piles.")):
        if some := kinds.get(kind):
            metrics |= {f"{prefix}{k}": v for k, v in _loading(some, grapple_s, kind == "singles").items()}
    if some := kinds.get("landing"):
        metrics |= _unloading(some, grapple_s)
    return metrics


def _loading(outcomes: Sequence[Mapping[str, Any]], grapple_s: float, single: bool) -> dict[str, float]:
    good = [c for o in outcomes for c in cycles(o, grapple_s) if c.good and c.state == "COLLECT"]
    shown = [c for c in good if c.logs == 1] if single else good
    wood = sum(_m3(log) for o in outcomes for log in o["logs"] if log["in_bunk"])
    logs = sum(log["in_bunk"] for o in outcomes for log in o["logs"])
    hours = sum(o["seconds"] for o in outcomes) / HOUR_S
    metrics = {"logs_per_hour": logs / hours, "m3_per_hour": wood / hours}
    if not shown:
        return metrics
    metrics["cycle_median_s"] = float(np.median([c.seconds for c in shown]))
    if single:
        crane_s = sum(c.seconds for o in outcomes for c in cycles(o, grapple_s))
        metrics |= {
            "cycle_p90_s": float(np.percentile([c.seconds for c in shown], 90.0)),
            "shortest_median_s": float(np.median([c.shortest_s for c in shown])),
            "over_shortest": float(np.mean([c.seconds / c.shortest_s for c in shown])),
            "crane_logs_per_hour": HOUR_S * logs / crane_s,
        }
    else:
        metrics["logs_per_grasp"] = logs / len(good)
    return metrics


def _unloading(outcomes: Sequence[Mapping[str, Any]], grapple_s: float) -> dict[str, float]:
    parts = [[c for c in cycles(o, grapple_s) if c.state == "UNLOAD"] for o in outcomes]
    spans = [_span_s(o) for o in outcomes]
    at_landing = [log["landed"] for o in outcomes for log in o["logs"]]
    metrics = rate("unloaded", sum(at_landing), len(at_landing))
    good = [c for part in parts for c in part if c.good]
    if not good or not all(map(math.isfinite, spans)):
        return metrics
    wood = sum(_m3(log) for o in outcomes for log in o["logs"] if log["landed"])
    metrics |= {
        "unload_s": float(np.mean(spans)),
        "unload_logs_per_hour": HOUR_S * sum(at_landing) / sum(spans),
        "unload_m3_per_hour": HOUR_S * wood / sum(spans),
        "unload_cycle_median_s": float(np.median([c.seconds for c in good])),
        "unload_logs_per_grasp": sum(at_landing) / len(good),
    }
    return metrics


def _span_s(outcome: Mapping[str, Any]) -> float:
    """Compute the time from the first to the last grasp at the landing [s]."""
    some = [g for g in outcome["grasps"] if g["state"] == "UNLOAD" and "end_s" in g]
    return float(some[-1]["end_s"] - some[0]["begin_s"]) if some else math.nan


def _m3(log: Mapping[str, Any]) -> float:
    length_m, diameter_m = log["size_m"]
    return float(0.25 * math.pi * diameter_m**2 * length_m)
