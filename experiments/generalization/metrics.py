"""Metrics of the generalization experiment with their limits, and the page that shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from experiments.common.result import Metric, mean, rate
from experiments.common.result_page import Section
from experiments.generalization.matrix import MISSION, is_drawn, is_mission, title_of

CONCLUSION: Final = (
    "With a truth at either end of every parameter, or everything drawn, {calibrated_share} of the machines are "
    "calibrated. With everything drawn {grasp_success} of single logs reach the bunk without a stop, "
    "{grasp_first_closing} at the first closing.",
    "On missions of drawn machines on drawn ground and wood, seen by their own cameras, {mission_loaded} of the logs "
    "are loaded, with {stops_per_mission} stops each that need a person.",
    "A figure was wrong, or something was called done that was not, without a word: {unsafe_or_silent} times.",
)
INTRODUCTION: Final = (
    "All other figures are of machines near the profiles with which the software grew up. Here every parameter of the "
    "hidden truth stands at one of its ends, alone, then all are drawn at once; each machine is calibrated from the "
    "shipped profile and then loads logs with what the calibration has written. Drawn forwarders drive missions on "
    "flat, rough, sloping, hilly, muddy and drawn ground, among logs of 1.7 to 2.6 m and 11 to 32 cm of which nobody "
    "has told them. A refusal that says why is a result; a wrong value or a job called done that is not is the worst "
    "one, and counted."
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


def of_truth(name: str) -> tuple[Metric, ...]:
    """Define the metrics of one truth."""
    title, whole = title_of(name), is_mission(name)
    return (
        Metric(f"{name}.calibrated", f"{title}: calibrated", "%", "Share of its machines."),
        Metric(
            f"{name}.success",
            f"{title}: logs in the bunk",
            "%",
            "By the plant's physics." if whole else "Without a stop.",
        ),
        Metric(f"{name}.seconds", f"{title}: duration", "s", "The mission." if whole else "Mean of its jobs."),
    )


def sections(truths: Sequence[str]) -> tuple[Section, ...]:
    """Make the sections of a page about these truths."""
    singles, missions = ([t for t in truths if is_mission(t) is kind] for kind in (False, True))
    plots = (("truths.png", "Logs in the bunk, for every truth; hollow: no profile was written."),)
    return (
        Section("All machines", "Every truth counts alike.", OVERALL),
        Section(
            "Truth by truth",
            "The nominal machine with one parameter changed, or with all drawn.",
            tuple(m for name in singles for m in of_truth(name)),
            plots,
        ),
        Section(
            "Mission by mission",
            "Every mission has another machine, route and wood.",
            tuple(m for name in missions for m in of_truth(name)),
        ),
    )


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
            metrics[f"{name}.seconds"] = o[MISSION]["seconds"]
        elif o["jobs"]:
            metrics |= rate(f"{name}.success", sum(map(succeeded, o["jobs"])), len(o["jobs"]))
            metrics[f"{name}.seconds"] = mean([job["seconds"] for job in o["jobs"]])
    return metrics
