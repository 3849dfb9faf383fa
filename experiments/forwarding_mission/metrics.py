"""What the forwarding-mission experiment reports: figures with their limits, the error table, the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from experiments.common.result import Figure, rate
from experiments.common.result_page import Section

CM: Final = 100.0
MOVED_M: Final = 0.3
"""A machine that stands so far from where it stood has driven on."""
FIRST: Final = {"ours": "first/ours", "faithful": "first/paper-b"}
"""The nominal machine on the field as the file has it, both ways; by the prefix of its figures."""
PAPER: Final = {
    "faithful.detected": 23 / 24,
    "faithful.loaded": 21 / 24,
    "faithful.grasp_offset_mean_m": 0.2893,
    "detected": 23 / 24,
    "loaded": 21 / 24,
    "grasp_offset_mean_m": 0.2893,
}
PAPER_TABLE_MM: Final = {"across": 232.6, "along": 113.0, "up": 79.5, "distance": 289.3}
"""Means of the paper's Table 1 (X is across, Y along its rear frame); 23 logs."""

OURS: Final = (
    Figure("detected", "Logs detected", "%", "Before it was taken, the machine believed in a log within 80 cm of it "
           "while it lay where it had been laid. All missions of ours.", least=0.99, scale=100.0),
    Figure("loaded", "Logs loaded", "%", "At the end it lies between the stakes of the bunk, by the plant's physics.",
           least=0.98, scale=100.0),
    Figure("grasp_offset_mean_m", "Grapple to log, mean", "cm", "On top of the log, just before the grapple is "
           "activated, in truth: from the point between the open tips to the log's middle, across, along and up (less "
           "the height at which it was to be); all grasps of one log.", most=0.08, scale=CM),
    Figure("grasp_offset_p95_m", "The same, 95 of 100 are below", "cm", "The same grasps.", scale=CM),
    Figure("grasp_offset_across_m", "Across the machine, mean of the sizes", "cm", "The same grasps.", scale=CM),
    Figure("grasp_offset_along_m", "Along the machine, mean of the sizes", "cm", "The same grasps.", scale=CM),
    Figure("grasp_offset_up_m", "Up, mean of the sizes", "cm", "The same grasps.", scale=CM),
    Figure("faults", "Stops and faults", "", "Times the controller stopped the machine, so that somebody had to press "
           "a button; all missions of ours.", most=0.0),
    Figure("refused", "Setpoints refused", "", "All missions of ours.", most=0.0),
    Figure("missions", "Missions driven", "", "Ours: the one on the field of the file, and those on others, of which "
           "20 are wanted."),
    Figure("finished", "Missions driven to the end of the route", "%", "Of these.", least=1.0, scale=100.0),
    Figure("uncalibrated", "Machines without a calibrated profile", "", "The calibration stopped or doubted a value; "
           "such a machine drives no mission.", most=0.0),
    Figure("missed", "Grasps that came up empty", "", "All missions of ours."),
    Figure("mission_mean_s", "Time of a mission, mean", "min", "From arming to the end of the route.", scale=1 / 60),
    Figure("stops_mean", "Stops to load, mean", "", "In a mission; paper B stops twice for every log."),
)  # fmt: skip
BOTH: Final = tuple(
    Figure(f"{prefix}.{name}", f"{who}: {title}", unit, how, scale=scale)
    for prefix, who in (("faithful", "Paper B's way"), ("first", "Ours"))
    for name, title, unit, how, scale in (
        ("detected", "logs detected", "%", "As above.", 100.0),
        ("loaded", "logs loaded", "%", "As above.", 100.0),
        ("grasp_offset_mean_m", "grapple to log, mean", "cm", "As above.", CM),
        ("mission_mean_s", "time of the mission", "min", "As above.", 1 / 60),
        ("stops_mean", "stops to load", "", "As above."  , 1.0),
        ("faults", "stops and faults", "", "As above.", 1.0),
    )
)  # fmt: skip
FIGURES: Final = OURS + BOTH
INTRODUCTION: Final = (
    "Paper B's whole task (4.2, 5.2, its Fig. 12): four waypoints on a field of 40 by 30 m, two laps, twelve places "
    "along the long sides with a birch log of 2 m by 25 cm each, replaced after the machine has passed, so 24 logs. "
    "The whole machine is on its two buses in lockstep: carrier, swing arms, crane and grapple in the physics, "
    "receiver with the errors of RTK, controller, guard, and the activity manager over them. First one mission on the "
    "field as in [`paper_b.geojson`](examples/paper_b.geojson) each way; then missions on {machines} calibrated "
    "individuals whose steel, oil and sensors the plant hides, every one on another field: each log up to "
    "{along:.0f} cm along, {across:.0f} cm across and {turn:.0f} degrees off. {eyes} "
    "`timberhand experiment forwarding-mission --docs docs` measures everything and writes this page; no number is "
    "typed. It takes hours: `--trials` asks for fewer missions, and the same code goes on from those that are "
    "published, with what became of every log, way and grasp, as "
    "[trials.jsonl.xz](results/forwarding-mission/trials.jsonl.xz)."
)
SEEN_BY: Final = (
    "The logs are seen by the front camera alone, drawn with its noise and mounted as the plant hides it; its mount "
    "was surveyed. The shipped network finds them, our perception measures them (in paper B's way its own pipeline, "
    "half a diameter added along the line of sight, for the paper does not say how the surface became the middle), and "
    "the crane works from memory, as paper B's did."
)


def sections(outcomes: Mapping[str, Any]) -> tuple[Section, ...]:
    """Sections of the page."""
    return (
        Section("All missions of ours", "", OURS, (
            ("offsets.png", "Grapple to log just before the grapple is activated, all missions; dark ours, light paper "
             "B's Table 1."),
        )),
        Section("The trial, both ways", table(outcomes), BOTH, (
            ("map.png", "Way of the front axle from square to circle, the logs as they lay (red: not loaded; black: "
             "not even detected), places of the crane's foot while it loaded (green) and where it reached to."),
        )),
    )  # fmt: skip


def table(outcomes: Mapping[str, Any]) -> str:
    """The error table like paper B's Table 1, both ways side by side, as Markdown; the paper's means below."""
    rows = {prefix: by_log(outcomes.get(name)) for prefix, name in FIRST.items()}
    lines = [
        "As paper B's Table 1: true offset of the grapple from the log's middle just before it is activated, mm; "
        "across and along the rear frame, up. Logs 13 to 24 are those of the second lap. A dash: never reached for.",
        "",
        "| log | ours: across | along | up | distance | loaded | paper B's way: across | along | up | distance | "
        "loaded |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    count = max((len(r) for r in rows.values()), default=0)
    for i in range(count):
        cells = [cell for prefix in FIRST for cell in _cells(rows[prefix][i] if i < len(rows[prefix]) else None)]
        lines.append(f"| {i + 1} | {' | '.join(cells)} |")
    means = [cell for prefix in FIRST for cell in _means(rows[prefix])]
    lines.append(f"| mean size | {' | '.join(means)} |")
    p = PAPER_TABLE_MM
    lines.append(
        f"| paper B, measured | | | | | | {p['across']:.0f} | {p['along']:.0f} | {p['up']:.0f} | {p['distance']:.0f} | "
        "21 of 24 |"
    )
    return "\n".join(lines)


def _cells(row: Mapping[str, Any] | None) -> list[str]:
    if row is None:
        return ["–"] * 5
    off = row["off_m"]
    numbers = ["–"] * 4 if off is None else [f"{1e3 * v:.0f}" for v in (*off, math.hypot(*off))]
    return [*numbers, "yes" if row["in_bunk"] else "**no**"]


def _means(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    known = [r["off_m"] for r in rows if r["off_m"] is not None]
    if not known:
        return ["–"] * 5
    sizes = np.mean(np.abs([[*off, math.hypot(*off)] for off in known]), axis=0)
    return [*(f"{1e3 * v:.0f}" for v in sizes), f"{sum(r['in_bunk'] for r in rows)} of {len(rows)}"]


def by_log(outcome: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Every log of a mission: whether it was detected and lies in the bunk, and the offset of the last grasp of it
    alone, None where there was none."""
    if outcome is None:
        return []
    last = dict(offsets(outcome))
    return [{**log, "off_m": last.get(i)} for i, log in enumerate(outcome["logs"])]


def offsets(outcome: Mapping[str, Any]) -> Iterator[tuple[int, list[float]]]:
    """Log and offset (across, along, up) [m] just before each grasp of one log alone on the ground."""
    for grasp in outcome["grasps"]:
        if grasp["state"] != "COLLECT":
            continue
        for attempt in grasp["attempts"]:
            if attempt["log"] is not None and attempt["logs"] == 1:
                yield attempt["log"], attempt["off_m"]


def gather(outcomes: Mapping[str, Any]) -> dict[str, float]:
    """The figures of all missions; outcomes are named first/WAY, mission/NUMBER and machine/NUMBER."""
    ours = [o for name, o in outcomes.items() if name.startswith("mission/") or name == FIRST["ours"]]
    machines = [o for name, o in outcomes.items() if name.startswith("machine/")]
    metrics = figures(ours)
    metrics["uncalibrated"] = float(sum(m["profile"] is None for m in machines))
    for prefix, name in (("faithful", FIRST["faithful"]), ("first", FIRST["ours"])):
        if name in outcomes:
            metrics |= {f"{prefix}.{key}": value for key, value in figures([outcomes[name]]).items()}
    return metrics


def _stops(stands: Sequence[Sequence[float]]) -> int:
    """How often the machine stopped: it may load several logs from one stand."""
    return sum(i == 0 or math.dist(at[:2], stands[i - 1][:2]) > MOVED_M for i, at in enumerate(stands))


def figures(outcomes: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of some missions together."""
    logs = [log for o in outcomes for log in o["logs"]]
    off = np.array([v for o in outcomes for _, v in offsets(o)]).reshape(-1, 3)
    far = np.linalg.norm(off, axis=1)
    metrics = rate("detected", sum(log["detected"] for log in logs), len(logs))
    metrics |= rate("loaded", sum(log["in_bunk"] for log in logs), len(logs))
    if len(far):
        across, along, up = np.mean(np.abs(off), axis=0).tolist()
        metrics |= {
            "grasp_offset_mean_m": float(far.mean()), "grasp_offset_p95_m": float(np.percentile(far, 95.0)),
            "grasp_offset_across_m": across, "grasp_offset_along_m": along, "grasp_offset_up_m": up,
        }  # fmt: skip
    done = [o for o in outcomes if o["finished"]]
    metrics["missions"] = float(len(outcomes))
    metrics |= rate("finished", len(done), len(outcomes))
    metrics["faults"] = float(sum(o["stops"] for o in outcomes))
    metrics["refused"] = float(sum(o["refused"] for o in outcomes))
    metrics["missed"] = float(sum(g.get("failure") is not None for o in outcomes for g in o["grasps"]))
    if done:
        metrics["mission_mean_s"] = float(np.mean([o["seconds"] for o in done]))
        metrics["stops_mean"] = float(np.mean([_stops(o["stands"]) for o in done]))
    return metrics
