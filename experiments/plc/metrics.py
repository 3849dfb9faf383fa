"""Metrics of the PLC experiment with their limits, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

from experiments.common.result import Metric, mean, rate
from experiments.common.result_page import Section

PATHS: Final = {
    "can": "CAN, valve node",
    "references": "PLC closes the loops, Modbus/TCP",
    "valves": "PLC forwards valve commands, UDP",
}
"""Command paths by the prefix of their metrics."""
CONCLUSION: Final = (
    "Over CAN {can_success} of the logs end in the bunk, with a PLC that closes the loops {references_success}, and "
    "with a PLC that forwards valve commands {valves_success}.",
    "The pin comes to rest {can_rest_mm} from its reference over CAN, {references_rest_mm} and {valves_rest_mm} "
    "through the PLC; a command reaches the valve after {can_command_ms}, {references_command_ms} and "
    "{valves_command_ms}.",
)
INTRODUCTION: Final = (
    "On paper A's machine a PLC sits between the computer and the valves. The same jobs run over CAN and through the "
    "PLC in both of its roles: closing the joint loops (Modbus/TCP), and forwarding valve commands (cyclic UDP). All "
    "times are virtual, so they show the cost of the path, not of the host."
)


def _metrics(path: str, title: str) -> Iterator[Metric]:
    yield Metric(
        f"{path}_success", f"Logs in the bunk: {title}", "%", "Share of the trials, by the plant's ground truth.",
        least=1.0, scale=100.0,
    )  # fmt: skip
    yield Metric(f"{path}_stops", f"Stops in all trials: {title}", "", "The emulated operator arms again after each.")
    yield Metric(f"{path}_seconds", f"Duration of a job: {title}", "s", "Mean of the trials.")
    yield Metric(f"{path}_rest_mm", f"Error of the pin at rest, mean: {title}", "mm",
                 "Hanger pin by the true joints against a reference that has rested for 0.6 s.")  # fmt: skip
    yield Metric(f"{path}_rest_max_mm", f"Error of the pin at rest, largest: {title}", "mm", "All rests of all trials.")
    yield Metric(f"{path}_track_mm", f"Error of the pin in motion, RMS: {title}", "mm",
                 "Against the reference at the same time.")  # fmt: skip
    yield Metric(f"{path}_command_ms", f"Latency from command to valve: {title}", "ms",
                 "From the controller's first command that opens the boom's valve to the output; mean.")  # fmt: skip
    yield Metric(f"{path}_measured_ms", f"Age of a measurement: {title}", "ms",
                 "Slope of true less estimated boom angle over its speed, so that offsets do not count.")  # fmt: skip


SECTIONS: Final = (
    Section(
        "CAN and PLC compared",
        "Every trial draws another individual machine and another log; the three paths get the same ones.",
        tuple(m for path, title in PATHS.items() for m in _metrics(path, title)),
    ),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Metrics of all paths; outcomes are named PATH-NUMBER."""
    metrics: dict[str, float] = {}
    for path in PATHS:
        trials = [o for name, o in outcomes.items() if name.startswith(f"{path}-")]
        rests = [e for t in trials for e in t["rests_mm"]]
        metrics |= rate(f"{path}_success", sum(t["success"] for t in trials), len(trials))
        metrics |= {
            f"{path}_stops": float(sum(t["stops"] for t in trials)),
            f"{path}_seconds": mean([t["seconds"] for t in trials]),
            f"{path}_rest_mm": mean(rests),
            f"{path}_rest_max_mm": max(rests, default=math.nan),
            f"{path}_track_mm": math.sqrt(mean([t["squares"] / max(1, t["moments"]) for t in trials])),
            f"{path}_command_ms": mean([d for t in trials for d in t["delays_ms"]]),
            f"{path}_measured_ms": mean([t["age_ms"] for t in trials]),
        }
    return metrics
