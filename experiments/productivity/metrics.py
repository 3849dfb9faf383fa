"""What the productivity experiment reports: figures with their limits, and the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from experiments.common.result import Figure, rate
from experiments.common.result_page import Section

HOUR_S: Final = 3600.0
EXPERT_S: Final = (20.0, 25.0)
"""An expert's single log from the ground into the bunk (docs/reference/machines.md section 10, assumed)."""
HUMAN_S: Final = (18.0, 25.0)
"""A crane cycle of an operator with 40 to 50 grapple loads a load (derived on assumed sizes, Manner 2016)."""
KINDS_SHOWN: Final = {"singles": "Single logs", "piles": "Piles", "landing": "Unloading"}

CYCLES: Final = (
    Figure("cycle_median_s", "Crane cycle, one log from the ground into the bunk: median", "s", "From the look at the "
           "logs until the crane is clear of the stakes with the log in the bunk; grasps of one log along the route "
           "of single logs.", most=25.0),
    Figure("cycle_p90_s", "The same, 90 of 100 are below", "s", "The same grasps."),
    Figure("shortest_median_s", "Shortest time for the same ways, median", "s", "What joint speeds, joint "
           "accelerations and the pump's flow allow for the same paths, and the time that the tongs need; no look, no "
           "settling, no jerk."),
    Figure("over_shortest", "Crane cycle over that, mean", "", "Of the same grasps."),
    Figure("piles.cycle_median_s", "Crane cycle from a pile: median", "s", "One grasp, whatever it holds."),
    Figure("piles.logs_per_grasp", "Logs a grasp from a pile", "", "Of those that did not come up empty."),
)  # fmt: skip
HOURS: Final = (
    Figure("logs_per_hour", "Single logs: logs an hour", "", "Loaded logs over the time from the first state that "
           "follows arming to the end of the route, driving included."),
    Figure("m3_per_hour", "Single logs: wood an hour", "m³", "The same; cylinders of the mid diameter."),
    Figure("crane_logs_per_hour", "Single logs: logs an hour of crane work", "", "The same, without driving."),
    Figure("piles.logs_per_hour", "Piles: logs an hour", "", "The same for piles."),
    Figure("piles.m3_per_hour", "Piles: wood an hour", "m³", "The same."),
    Figure("loaded", "Logs loaded, of all that lay there", "%", "By the plant's physics; both.", scale=100.0),
    Figure("faults", "Stops and faults", "", "All runs.", most=0.0),
)  # fmt: skip
UNLOADING: Final = (
    Figure("unload_s", "A full bunk unloaded in", "min", "From the begin of the first grasp to the end of the last.",
           scale=1 / 60),
    Figure("unload_logs_per_hour", "Logs an hour while unloading", "", "The same time."),
    Figure("unload_m3_per_hour", "Wood an hour while unloading", "m³", "The same time."),
    Figure("unload_cycle_median_s", "Crane cycle while unloading: median", "s", "One grasp, whatever it holds."),
    Figure("unload_logs_per_grasp", "Logs a grasp while unloading", "", "Of those that did not come up empty."),
    Figure("unloaded", "Logs that lie at the landing", "%", "Within 3 m of its middle and not on board.", scale=100.0),
)  # fmt: skip
FIGURES: Final = CYCLES + HOURS + UNLOADING
INTRODUCTION: Final = (
    "How much wood in an hour. Three pieces of work on the nominal machine, with birch logs of about 2 m by 25 cm: "
    "single logs right and left of a straight route; mini-piles of paper A's sizes, two to six logs each; and a full "
    "bunk that is driven to a landing and unloaded. The whole machine is on its two buses in lockstep; a detector "
    "that makes no mistakes sees the logs. `timberhand experiment productivity --docs docs` measures everything and "
    "writes this page; no number is typed."
)
HUMAN: Final = (
    f"People: an expert takes a single log into the bunk in {EXPERT_S[0]:.0f} to {EXPERT_S[1]:.0f} s (assumed; 145 to "
    f"180 logs an hour of crane work). Over 8868 loads of nine operators (Manner 2016) loading is 45 % of 45.8 "
    f"minutes a load, the crane moves in 75 % of it: {HUMAN_S[0]:.0f} to {HUMAN_S[1]:.0f} s a cycle at 40 to 50 "
    "grapple loads, and 20 to 22 m³ an hour of productive work with 16 m³ a load (derived on assumed sizes); unloading "
    "is 19 %, 8.7 minutes. Those cycles hold many thin logs; ours hold one or a few."
)


@dataclass(frozen=True, slots=True)
class Cycle:
    """One grasp: what the crane was about, logs in it, its time, the time of its phases and the shortest possible [s];
    ``good`` when it did what it was to do.
    """

    state: str
    logs: int
    seconds: float
    phases: tuple[tuple[str, float], ...]
    shortest_s: float
    good: bool


def cycles(outcome: Mapping[str, Any], tongs_s: float) -> Iterator[Cycle]:
    """The grasps of a mission that came to an end; ``tongs_s`` is what closing and opening take at least."""
    for grasp in outcome["grasps"]:
        if "end_s" not in grasp:
            continue
        ends = [begin for _, begin, _ in grasp["phases"][1:]] + [grasp["end_s"]]
        phases = tuple((n, end - begin) for (n, begin, _), end in zip(grasp["phases"], ends, strict=True))
        shortest = sum(s for name, _, s in grasp["phases"] if name != "CLOSE") + tongs_s
        logs = grasp["attempts"][-1]["logs"] if grasp["attempts"] else 0
        yield Cycle(grasp["state"], logs, grasp["end_s"] - grasp["begin_s"], phases, shortest, grasp["failure"] is None)


def sections() -> tuple[Section, ...]:
    """Sections of the page."""
    return (
        Section("The crane's cycle", HUMAN, CYCLES, (
            ("cycles.png", "Every grasp and its phases; black bars: the shortest possible for the same ways."),
        )),
        Section("Logs and wood in an hour", "", HOURS),
        Section("Unloading", "", UNLOADING),
    )  # fmt: skip


def gather(outcomes: Mapping[str, Any], tongs_s: float) -> dict[str, float]:
    """The figures of all runs; outcomes are named KIND/NUMBER."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for name, outcome in outcomes.items():
        kinds.setdefault(name.split("/")[0], []).append(outcome)
    metrics: dict[str, float] = {"faults": float(sum(o["stops"] for o in outcomes.values()))}
    loads = [o for kind in ("singles", "piles") for o in kinds.get(kind, [])]
    logs = [log for o in loads for log in o["logs"]]
    metrics |= rate("loaded", sum(log["in_bunk"] for log in logs), len(logs))
    for kind, prefix in (("singles", ""), ("piles", "piles.")):
        if some := kinds.get(kind):
            metrics |= {f"{prefix}{k}": v for k, v in _loading(some, tongs_s, kind == "singles").items()}
    if some := kinds.get("landing"):
        metrics |= _unloading(some, tongs_s)
    return metrics


def _loading(outcomes: Sequence[Mapping[str, Any]], tongs_s: float, single: bool) -> dict[str, float]:
    good = [c for o in outcomes for c in cycles(o, tongs_s) if c.good and c.state == "COLLECT"]
    shown = [c for c in good if c.logs == 1] if single else good
    wood = sum(_m3(log) for o in outcomes for log in o["logs"] if log["in_bunk"])
    logs = sum(log["in_bunk"] for o in outcomes for log in o["logs"])
    hours = sum(o["seconds"] for o in outcomes) / HOUR_S
    metrics = {"logs_per_hour": logs / hours, "m3_per_hour": wood / hours}
    if not shown:
        return metrics
    metrics["cycle_median_s"] = float(np.median([c.seconds for c in shown]))
    if single:
        crane_s = sum(c.seconds for o in outcomes for c in cycles(o, tongs_s))
        metrics |= {
            "cycle_p90_s": float(np.percentile([c.seconds for c in shown], 90.0)),
            "shortest_median_s": float(np.median([c.shortest_s for c in shown])),
            "over_shortest": float(np.mean([c.seconds / c.shortest_s for c in shown])),
            "crane_logs_per_hour": HOUR_S * logs / crane_s,
        }
    else:
        metrics["logs_per_grasp"] = logs / len(good)
    return metrics


def _unloading(outcomes: Sequence[Mapping[str, Any]], tongs_s: float) -> dict[str, float]:
    parts = [[c for c in cycles(o, tongs_s) if c.state == "UNLOAD"] for o in outcomes]
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
    """From the first to the last grasp at the landing."""
    some = [g for g in outcome["grasps"] if g["state"] == "UNLOAD" and "end_s" in g]
    return some[-1]["end_s"] - some[0]["begin_s"] if some else math.nan


def _m3(log: Mapping[str, Any]) -> float:
    length_m, diameter_m = log["size_m"]
    return 0.25 * math.pi * diameter_m**2 * length_m
