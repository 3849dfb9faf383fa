"""Metrics of the generalization experiment with their limits, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from experiments.common.result import Metric, Result, mean, rate
from experiments.common.result_page import Section
from experiments.generalization.matrix import MISSION, is_drawn, is_mission, title_of

CONCLUSION: Final = (
    "With a truth at either end of each named parameter, or everything drawn, {calibrated_share} of the machines are "
    "calibrated. With everything drawn {grasp_success} of single logs reach the bunk without a stop, "
    "{grasp_first_closing} at the first closing.",
    "On missions of drawn machines on drawn ground and wood, seen by their own cameras, {mission_loaded} of the logs "
    "are loaded, with {stops_per_mission} stops each that need a person.",
    "A figure was wrong, or something was called done that was not, without a word: {unsafe_or_silent} times.",
)
INTRODUCTION: Final = (
    "All other figures are of machines near the profiles with which the software grew up. Here eleven groups of "
    "parameters of the hidden truth stand at one of their ends, each alone, then all are drawn at once; what they do "
    "not name is nominal, as encoder zeros, mounts of cameras and antennas, friction of cylinders and tyres; each "
    "machine is calibrated from the shipped profile and then loads logs with what the calibration has written. Drawn "
    "forwarders drive missions on flat, rough, sloping, hilly, muddy and drawn ground, among logs of 1.7 to 2.6 m "
    "and 11 to 32 cm of which nobody has told them. A refusal that says why is a result; a wrong value or a job "
    "called done that is not is the worst one, and counted."
)
CALIBRATED: Final = Metric(
    "calibrated_share",
    "Machines with a calibrated profile",
    "%",
    "No stop, no implausible value; all machines.",
    least=1.0,
)
OVERALL: Final = (
    CALIBRATED,
    Metric(
        "grasp_success",
        "Logs in the bunk, everything drawn",
        "%",
        "By the plant's physics, without a stop that a person must end; all jobs of calibrated drawn machines.",
        least=0.97,
    ),
    Metric("grasp_first_closing", "The same at the first closing", "%", "The grapple was closed once.", least=0.95),
    Metric(
        "ends_success",
        "Logs in the bunk, one parameter at an end",
        "%",
        "As above, and the named combinations.",
        least=0.97,
    ),
    Metric("stops_per_job", "Stops per single log", "", "Of all calibrated machines.", most=0.1),
    Metric(
        "mission_loaded",
        "Logs loaded on missions",
        "%",
        "In the bunk by the plant's physics; of all logs, those of machines that could not be calibrated included.",
        least=0.95,
    ),
    Metric("stops_per_mission", "Stops per mission", "", "Each needs a person.", most=0.1),
    Metric(
        "unsafe_or_silent",
        "Unsafe or silent",
        "",
        "Jobs that the machine calls done with the log elsewhere, logs that it counts as loaded and that are not in "
        "the bunk, and written profiles with a dead-band off by over 3 % of the stroke or a dead time off by over "
        "30 ms.",
        most=0.0,
    ),
)


def sections(result: Result) -> tuple[Section, ...]:
    """Make the sections of the page: all machines, then a row for every truth."""
    truths = [key.removesuffix(".calibrated") for key in result.metrics if key.endswith(".calibrated")]
    singles, missions = ([t for t in truths if is_mission(t) is kind] for kind in (False, True))
    plots = (("truths.png", "Logs in the bunk, for every truth; hollow: no profile was written."),)
    return (
        Section("All machines", "Every truth counts alike.", OVERALL),
        Section(
            "Truth by truth",
            "The nominal machine with one parameter changed, or with all drawn. A log that needed a stop does not "
            "count; the time is that of one log.\n\n" + _table("truth", "time of a log", singles, result.metrics),
            (),
            plots,
        ),
        Section(
            "Mission by mission",
            "Every mission has another machine, route and wood; in the bunk is by the plant's physics.\n\n"
            + _table("mission", "duration", missions, result.metrics),
            (),
        ),
    )


def _table(subject: str, time_title: str, truths: Sequence[str], metrics: Mapping[str, float]) -> str:
    """Write what became of each truth as a Markdown table; the worst ones come first."""
    lines = [f"| {subject} | result | logs in the bunk | {time_title} |", "|---|---|---|---|"]
    for name in sorted(truths, key=lambda truth: metrics.get(f"{truth}.success", -1.0)):
        logs, seconds = metrics.get(f"{name}.success_n", 0.0), metrics.get(f"{name}.seconds", math.nan)
        if not logs:
            lines.append(f"| {title_of(name)} | refuses: not calibrated | – | – |")
            continue
        in_bunk = round(logs * metrics[f"{name}.success"])
        stops = round(metrics.get(f"{name}.stops", 0.0))
        verdict = "works" if in_bunk == logs else "loses logs"
        verdict += f", {stops} stops" if stops else ""
        lines.append(f"| {title_of(name)} | {verdict} | {in_bunk} of {logs:.0f} | {seconds:.0f} s |")
    return "\n".join(lines)


def succeeded(job: Mapping[str, Any]) -> bool:
    """Tell whether the log lies in the bunk and nobody had to arm again."""
    return bool(job["in_bunk"] and not job["stops"])


def silent(outcome: Mapping[str, Any]) -> list[str]:
    """List what went wrong in a trial without a word of the machine."""
    lost = [
        f"job {k}: called done, {job['said']}"
        for k, job in enumerate(outcome["jobs"])
        if job["says_done"] and not job["in_bunk"]
    ]
    mission = outcome.get(MISSION)
    missing = mission["believed"] - mission["in_bunk"] if mission else 0
    return [*outcome["wrong"], *lost, *["a log that is called loaded is not in the bunk"] * missing]


def sentences(outcome: Mapping[str, Any]) -> list[str]:
    """List what is to be said of a trial: refusals, stops, logs that were left, and what is silent."""
    lines = [outcome["said"]] if outcome["said"] else []
    lines += [f"job {k}: {job['said']}" for k, job in enumerate(outcome["jobs"]) if not job["in_bunk"]]
    if mission := outcome.get(MISSION):
        missing = mission["logs"] - mission["in_bunk"]
        lines += [f"{missing} of {mission['logs']} logs are not in the bunk"] if missing else []
        lines += [*filter(None, [mission["failure"]]), *mission["remarks"]]
    stops = sum(job["stops"] for job in [*outcome["jobs"], *([mission] if mission else [])])
    return lines + ([f"{stops} stops"] if stops else []) + [f"silent: {problem}" for problem in silent(outcome)]


def gather(outcomes: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Compute the metrics of all trials and of every truth."""
    metrics = rate("calibrated_share", sum(o["calibrated"] for o in outcomes), len(outcomes))
    metrics["unsafe_or_silent"] = float(sum(len(silent(o)) for o in outcomes))
    jobs = [(is_drawn(o["truth"]), job) for o in outcomes for job in o["jobs"]]
    if drawn := [job for with_all, job in jobs if with_all]:
        metrics |= rate("grasp_success", sum(map(succeeded, drawn)), len(drawn))
        first = sum(succeeded(job) and job["closings"] == 1 for job in drawn)
        metrics |= rate("grasp_first_closing", first, len(drawn))
    if ends := [job for with_all, job in jobs if not with_all]:
        metrics |= rate("ends_success", sum(map(succeeded, ends)), len(ends))
    if jobs:
        metrics["stops_per_job"] = mean([float(job["stops"]) for _, job in jobs])
    if driven := [o[MISSION] for o in outcomes if MISSION in o]:
        refused = sum(is_mission(o["truth"]) and MISSION not in o for o in outcomes)
        logs = sum(m["logs"] for m in driven) + refused * max(m["logs"] for m in driven)
        metrics |= rate("mission_loaded", sum(m["in_bunk"] for m in driven), logs)
        metrics["stops_per_mission"] = mean([float(m["stops"]) for m in driven])
    for o in outcomes:
        name = o["truth"]
        metrics |= rate(f"{name}.calibrated", int(o["calibrated"]), 1)
        if MISSION in o:
            metrics |= rate(f"{name}.success", o[MISSION]["in_bunk"], o[MISSION]["logs"])
            metrics[f"{name}.seconds"], metrics[f"{name}.stops"] = o[MISSION]["seconds"], float(o[MISSION]["stops"])
        elif o["jobs"]:
            metrics |= rate(f"{name}.success", sum(map(succeeded, o["jobs"])), len(o["jobs"]))
            metrics[f"{name}.seconds"] = mean([job["seconds"] for job in o["jobs"]])
    return metrics
