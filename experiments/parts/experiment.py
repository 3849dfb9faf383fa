"""The parts experiment: what single parts of the forwarder do, each with its own figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Metric, Result, make_result
from experiments.common.result_page import Page, Section, publish
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint, sampled_unless_given
from experiments.common.worlds import carrier_profile
from experiments.parts.trial import demonstrations, perform
from runtime.plot_style import OIL, TIMBER, sheet

TRIALS: Final = 4
"""Individual machines, each calibrated first; they take turns with the demonstrations."""
FIRST_SEED: Final = 9400
SEEDS_PER_RUN: Final = 100
SLOPES: Final = {"side": ("slope", 0.0), "uphill": ("slope", 90.0)}
"""Terrain and heading [deg]: the ground rises by a tenth to the left, or ahead."""
LIFTED_SHARE: Final = 0.05
"""A wheel that bears less than this share of a quarter of the weight has lifted off."""
SETTLED_RAD: Final = np.radians(1.0)
LOW_PERCENTILE: Final = 5.0
PAPER: Final = {"estimates_hz": 15.0}

CONCLUSION: Final = (
    "Movement primitives keep within {shape_rms_m} of a demonstration that they have not seen, and the tip within "
    "{tip_rms_m} of them.",
    "On rough ground the least loaded wheel bears {float.load_low} of its share with the front axle on its float "
    "valve, {arms.load_low} with all four arms held.",
    "Levelling leaves {side.after_deg} of {side.before_deg} on a side slope.",
)
PRIMITIVES: Final = (
    Metric(
        "shape_rms_m",
        "Primitive from the demonstration, RMS",
        "cm",
        "Distance of the pin's path from that of a demonstration which was left out of the learning; mean of all.",
    ),
    Metric("shape_max_m", "Primitive from the demonstration, largest", "cm", "Mean of all demonstrations."),
    Metric("time_share", "Duration over that of the demonstration", "", "Mean of all demonstrations."),
    Metric(
        "tip_rms_m",
        "Tip from the primitive, RMS",
        "cm",
        "Pin by the encoders from its reference while the crane repeats the primitive in lockstep.",
    ),
    Metric("true_rms_m", "Tip from the primitive, truly, RMS", "cm", "The same with sag and lean of the column."),
    Metric(
        "rest_m",
        "Tip at rest from its goal",
        "cm",
        "By the encoders, in the last of three seconds; mean.",
        most=0.03,
    ),
    Metric("refused", "Demonstrations out of reach for the primitives", "", "Of all.", most=0.0),
)
GROUND: Final = tuple(
    metric
    for key, title in (("float", "Front axle floats"), ("arms", "All arms held"))
    for metric in (
        Metric(
            f"{key}.height_rms_m",
            f"{title}: height of held arms from the wanted one, RMS",
            "cm",
            "True heights, ten times a second while the machine drives 20 m.",
        ),
        Metric(
            f"{key}.load_low",
            f"{title}: load of the least loaded wheel, 5th percentile",
            "%",
            "Over a quarter of the weight on all wheels.",
        ),
        Metric(f"{key}.lifted", f"{title}: time with a wheel off the ground", "%", "Below 5 % of its share."),
        Metric(
            f"{key}.arrived",
            f"{title}: drives that arrived",
            "%",
            "The machine ended the others: a lifted wheel spins, and the receiver denies it.",
        ),
        Metric(f"{key}.roll_deg", f"{title}: roll of the rear half, RMS about its mean", "deg", "True roll."),
    )
)
LEVEL: Final = tuple(
    metric
    for key, title in (("side", "Side slope"), ("uphill", "Uphill"))
    for metric in (
        Metric(f"{key}.before_deg", f"{title}: tilt before", "deg", "Greater of roll and pitch of the rear half."),
        Metric(f"{key}.after_deg", f"{title}: tilt after 40 s of levelling", "deg", "Mean of all machines.", most=1.5),
        Metric(f"{key}.settle_s", f"{title}: until the tilt stays below 1 degree", "s", "40: not within the time."),
    )
)
PICTURES: Final = (
    Metric(
        "estimates_hz",
        "Estimates per second on one processor",
        "1/s",
        "One over the median processor time of a picture: segmentation, fits and tracks, without drawing it.",
        clocked=True,
    ),
    Metric("logs_per_picture", "Logs measured in a picture", "", "Mean over the drive."),
)
BOTH: Final = (Metric("stops", "Stops by the supervisor", "", "All trials.", most=0.0),)
METRICS: Final = (*PRIMITIVES, *GROUND, *LEVEL, *PICTURES, *BOTH)
INTRODUCTION: Final = (
    "Each part works with the whole machine on its buses in lockstep, calibrated: movement primitives "
    "(paper B 3.2.5), each demonstration left out once; the swing arms' law and the front axle's float valve (3.2.4) "
    "on a straight drive of 20 m over undulating ground; levelling on a plane that rises by a tenth; and the front "
    "camera's pictures of logs beside the drive."
)


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), sampled_unless_given(options.truth)
    check_truth(name, truth)
    trials = 1 if options.quick else options.trials or TRIALS
    machines = calibrations(options, name, truth, trials)
    with checkpoint(options, (), [name], truth, LOCKSTEP_SOURCES) as trial_store:
        texts = pool.run(perform, machines, trial_store, options.workers, "calibrations", console)
        jobs = plan(options, name, truth, [texts[machine.name]["profile"] for machine in machines])
        outcomes = pool.run(perform, jobs, trial_store, options.workers, "trials of parts", console)
        result = make_result(
            "parts",
            METRICS,
            gather(outcomes),
            profile=name,
            seed=options.seed,
            trials=trials,
            more={"truth": truth},
            paper=PAPER,
        )
        draw(outcomes, options)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    sections = (
        Section(
            "Movement primitives",
            "Primitives learn from all demonstrations but one, and repeat that one from its beginning to its end.",
            PRIMITIVES,
            (("primitives.png", "Pin in the crane's plane: demonstrations (dark) and primitives (light)."),),
        ),
        Section(
            "Swing arms and float valve",
            "An axle on its float valve has its left and right arm connected: it follows the ground as a beam does, "
            "so that four wheels bear.",
            GROUND,
        ),
        Section("Levelling", "", LEVEL, (("levelling.png", "Tilt of the rear half while the machine levels."),)),
        Section("Pictures while driving", "", PICTURES),
        Section("All parts", "", BOTH),
    )
    return Page("Parts of the machine", CONCLUSION, INTRODUCTION, sections)


def calibrations(options: Options, profile: str, truth: str, count: int) -> list[Job]:
    """List the calibration of every individual."""
    first_seed = FIRST_SEED + options.seed * SEEDS_PER_RUN
    job_options = {"profile": profile, "truth": truth}
    return [Job(f"machine/{i}", "calibration", first_seed + i, job_options) for i in range(count)]


def plan(options: Options, profile: str, truth: str, texts: Sequence[str | None]) -> list[Job]:
    """Plan every trial, named PART/VARIANT/NUMBER; ``texts``: the calibrated profiles, None where that failed.

    The individuals take turns with the demonstrations; one that could not be calibrated has its shipped profile.
    """
    first_seed = FIRST_SEED + options.seed * SEEDS_PER_RUN
    numbers = range(2 if options.quick else len(demonstrations(profile)))
    jobs = []

    def add(name: str, kind: str, machine: int, **more: Any) -> None:
        job_options = {"profile": profile, "truth": truth, "text": texts[machine]}
        jobs.append(Job(name, kind, first_seed + machine, job_options | more))

    for i in numbers:
        add(f"primitive/own/{i}", "primitive", i % len(texts), number=i)
    for i in range(len(texts)):
        for key in ("float", "arms"):
            add(f"ground/{key}/{i}", "ground", i, terrain="rough", floats=key == "float")
        for key, (terrain, heading_deg) in SLOPES.items():
            add(f"level/{key}/{i}", "level", i, terrain=terrain, heading_deg=heading_deg)
        add(f"pictures/own/{i}", "pictures", i)
    return jobs


def gather(outcomes: Mapping[str, Any]) -> dict[str, float]:
    """Compute the metrics of all trials."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, outcome in outcomes.items():
        part, variant, _ = name.split("/")
        groups.setdefault((part, variant), []).append(outcome)
    repeated = [o for o in groups.get(("primitive", "own"), []) if not o.get("failure")]
    metrics = {
        key: _mean(o[key] for o in repeated)
        for key in ("shape_rms_m", "shape_max_m", "time_share", "tip_rms_m", "true_rms_m", "rest_m")
    }
    metrics["refused"] = float(len(groups.get(("primitive", "own"), [])) - len(repeated))
    for key in ("float", "arms"):
        metrics |= {f"{key}.{name}": value for name, value in _driven(groups.get(("ground", key), [])).items()}
    for key in SLOPES:
        levelled = groups.get(("level", key), [])
        metrics[f"{key}.before_deg"] = _mean(np.degrees(o["before_rad"]) for o in levelled)
        metrics[f"{key}.after_deg"] = _mean(np.degrees(o["after_rad"]) for o in levelled)
        metrics[f"{key}.settle_s"] = _mean(settled_s(o["curve"]) for o in levelled)
    seen = groups.get(("pictures", "own"), [])
    times_ms = [ms for o in seen for ms in o["ms"]]
    metrics["estimates_hz"] = 1000.0 / float(np.median(times_ms)) if times_ms else float("nan")
    metrics["logs_per_picture"] = _mean(n for o in seen for n in o["logs"])
    metrics["stops"] = float(sum(o["stops"] for o in outcomes.values()))
    return metrics


def settled_s(curve: Sequence[Sequence[float]]) -> float:
    """Find the time [s] from which a curve of (time, tilt [rad]) stays below a degree; its end if it does not."""
    late = [time_s for time_s, tilt_rad in curve if tilt_rad > SETTLED_RAD]
    return min(late[-1] + 1.0, float(curve[-1][0])) if late else 0.0


def _driven(drives: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    heights = np.array([h for o in drives for sample in o["heights_m"] for h in sample])
    least = np.array([min(sample) for o in drives for sample in o["loads"]])
    rolls = [np.degrees(np.array(o["roll_rad"]) - np.mean(o["roll_rad"])) for o in drives if o["roll_rad"]]
    if not len(heights) or not len(least):
        return {}
    return {
        "height_rms_m": float(np.sqrt(np.mean(heights**2))),
        "load_low": float(np.percentile(least, LOW_PERCENTILE)),
        "lifted": float(np.mean(least < LIFTED_SHARE)),
        "arrived": float(np.mean([o["arrived"] for o in drives])),
        "roll_deg": float(np.sqrt(np.mean(np.concatenate(rolls) ** 2))),
    }


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return float(np.mean(listed)) if listed else float("nan")


def draw(outcomes: Mapping[str, Any], options: Options) -> None:
    """Write the plots of the page."""
    with sheet(options.out / "primitives.png") as axis:
        for name, outcome in outcomes.items():
            if name.startswith("primitive/") and not outcome.get("failure"):
                for key, colour in (("demonstrated", OIL), ("planned", TIMBER)):
                    axis.plot(*np.array(outcome[key]).T, color=colour, lw=0.9, ls="-")
        axis.set(xlabel="distance from the slew axis [m]", ylabel="height [m]")
    with sheet(options.out / "levelling.png") as axis:
        for name, outcome in outcomes.items():
            if name.startswith("level/"):
                colour = OIL if "/side/" in name else TIMBER
                time_s, tilt_rad = np.array(outcome["curve"]).T
                axis.plot(time_s, np.degrees(tilt_rad), color=colour, lw=0.9, ls="-")
        axis.set(xlabel="time [s]", ylabel="tilt [deg] (dark: side slope, light: uphill)")
