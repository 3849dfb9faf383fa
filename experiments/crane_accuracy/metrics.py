"""What the crane-accuracy experiment reports: figures with their limits, how the motions become metrics, the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from experiments.common.result import Figure, rate
from experiments.common.result_page import Section
from experiments.crane_accuracy.plan import LAWS, OWN, UNCALIBRATED, UNCOMPENSATED, UNSHAPED

MM, PERCENT = 1e3, 100.0
PAPER: Final = {"encoder_error_mean_m": 0.08, "encoder_error_xy_mean_m": 0.04, "encoder_error_z_mean_m": 0.06}
"""Paper B, Fig. 20: means of 80 points, tip by forward kinematics of the joint sensors."""


def _mm(name: str, title: str, how: str, most: float | None = None) -> Figure:
    return Figure(name, title, "mm", how, most=most, scale=MM)


ACCURACY: Final = (
    _mm("encoder_error_mean_m", "By encoder kinematics, 3-D, mean",
        "Distance of the hanger pin by the controller's joint positions from the place where the encoders were sent, "
        "mean of half a second, 3 s after arrival; all machines, goals, repetitions and loads.", 0.010),
    _mm("encoder_error_xy_mean_m", "The same, horizontal", "The same points.", 0.007),
    _mm("encoder_error_z_mean_m", "The same, height", "The same points."),
    _mm("encoder_error_p95_m", "The same, 3-D, 95 of 100 are below", "The same points.", 0.020),
    _mm("encoder_error_max_m", "The same, 3-D, worst", "The same points."),
    _mm("encoder_error_empty_mean_m", "The same, 3-D, grapple empty, mean", "Half of the points."),
    _mm("encoder_error_loaded_mean_m", "The same, 3-D, with 200 kg, mean", "The other half."),
    _mm("tip_error_mean_m", "True pin against the goal, 3-D, mean",
        "Where the pin really is in the crane's base frame, from the plant; same times.", 0.03),
    _mm("tip_error_p95_m", "The same, 95 of 100 are below", "The same points."),
    _mm("tip_error_empty_mean_m", "The same, grapple empty, mean", "Half of the points."),
    _mm("tip_error_loaded_mean_m", "The same, with 200 kg, mean", "The other half."),
    _mm("aim_offset_mean_m", "How far beside the goal the encoders are sent, mean",
        "What the profile's sag model adds for the lean of the column."),
    _mm("tip_error_uncorrected_mean_m", "True pin against the goal without sag compensation, mean",
        "The calibrated profile without its sag table."),
    _mm("uncompensated_encoder_error_mean_m", "By encoder kinematics against the goal itself, without sag compensation",
        "The same motions; here the encoders are sent to the goal, as in paper B."),
    _mm("uncalibrated_error_mean_m", "By encoder kinematics against the goal before calibration, mean",
        "The profile as shipped, on the same individuals.", 0.06),
    _mm("uncalibrated_tip_error_mean_m", "True pin against the goal before calibration, mean", "The same motions."),
)  # fmt: skip
MOTION: Final = (
    Figure("time_ratio", "Motion time over the shortest possible, mean", "",
           "From the begin of the reference until the pin by encoders is within 20 mm of its end and stays, over the "
           "time that full joint speeds, joint accelerations and the pump's flow allow for the same path (no jerk, "
           "delay or swing in it).", most=1.15),
    Figure("time_ratio_p95", "The same, 95 of 100 are below", "", "The same motions."),
    Figure("planned_ratio", "Planned duration over the shortest possible, mean", "", "What the reference takes."),
    Figure("motion_s", "Motion time, mean", "s", "As above."),
    Figure("ended", "Motions that ended", "%", "Within 20 mm of the end, and stayed.", least=0.99, scale=PERCENT),
    Figure("limit_cycle_share", "Valves commanded after settling", "%",
           "Valve commands on the bus in which any joint's is not exactly zero, from 2 s after arrival on.", most=0.05,
           scale=PERCENT),
    Figure("stops", "Controlled stops", "", "All runs of all variants.", most=0),
    Figure("failures", "Motions that failed", "", "Stopped, refused, or never begun; all variants.", most=0),
    Figure("calibration_failures", "Machines without a calibrated profile", "",
           "The calibration stopped or doubted a value; such a machine makes no motions.", most=0),
)  # fmt: skip
SWING: Final = (
    Figure("sway_residual_deg", "Swing of the grapple, 95 of 100 are below", "deg",
           "Greatest lean of the grapple against the vertical, both planes, in truth, 1 to 3 s after the end of the "
           "reference, whether or not the pin has settled.",
           most=3.0),
    Figure("sway_residual_mean_deg", "The same, mean", "deg", "The same motions."),
    Figure("unshaped_sway_residual_deg", "The same with unshaped references, 95 of 100 are below", "deg",
           "The same paths in the same time with a plain time law."),
    Figure("unshaped_sway_residual_mean_deg", "The same, mean", "deg", "The same motions."),
    Figure("sway_reduction", "How much less the grapple swings", "%",
           "1 less the ratio of the two means.", least=0.6, scale=PERCENT),
)  # fmt: skip
LAW_NAMES: Final = {"pd": "PD", "smc": "sliding mode", "sta": "super-twisting"}


def _law(prefix: str) -> tuple[Figure, ...]:
    name = LAW_NAMES[prefix]
    how = "As above, with this law on every joint and the gain budget of the profile."
    return (
        _mm(f"{prefix}.encoder_error_mean_m", f"{name}: by encoder kinematics, 3-D, mean", how),
        _mm(f"{prefix}.encoder_error_p95_m", f"{name}: 95 of 100 are below", how),
        _mm(f"{prefix}.tip_error_mean_m", f"{name}: true pin, mean", how),
        Figure(f"{prefix}.time_ratio", f"{name}: motion time over the shortest possible", "", how),
        Figure(f"{prefix}.sway_residual_deg", f"{name}: swing, 95 of 100 are below", "deg", how),
        Figure(f"{prefix}.limit_cycle_share", f"{name}: valves commanded after settling", "%", how, scale=PERCENT),
    )


SECTIONS: Final = (
    Section(
        "Where the crane rests",
        "Figures 19 and 20 of paper B. The paper's 8, 4 and 6 cm are of the same kind as the first three rows: forward "
        "kinematics of the joint sensors, in which the give of the steel is not. With sag compensation the encoders "
        "are sent beside the goal on purpose, so that the true pin is on it; their error is counted from where they "
        "were sent. The row without compensation counts it from the goal itself. All limits are of this project.",
        ACCURACY,
        (
            ("histogram.png", "As Fig. 20: error by encoder kinematics in 3-D, horizontal, height. Dashed: the mean of "
             "paper B; solid: the mean here."),
            ("points.png", "As Fig. 19, zoomed: where the pin rests by encoder kinematics, seen from above, around "
             "where it was sent. Squares: empty; x: with 200 kg."),
            ("true_points.png", "The true pin at the same times around the goal, seen from beside: squares empty, x "
             "with 200 kg; light: without sag compensation."),
        ),
    ),
    Section(
        "How long it takes, and whether it is quiet then",
        "The shortest time is a bound that no machine reaches: full acceleration of every joint from one moment to the "
        "next, all of the pump's flow, no swing to care for.",
        MOTION,
        (("motion.png", "One motion to point 3 with 200 kg: the way of the pin, its errors, the valve commands, the "
          "lean of the grapple."),),
    ),
    Section(
        "How the grapple swings",
        "The grapple hangs from two joints without actuator and sensor.",
        SWING,
    ),
    Section(
        "The laws",
        "The same machines and goals, one empty and one loaded motion to each; the profile's own law has all its "
        "motions in these figures, and it alone is run without sag, without calibration and unshaped. Sliding mode "
        "and super-twisting are reconstructions: paper B names them without equations.",
        tuple(f for prefix in LAWS.values() for f in _law(prefix)),
    ),
)  # fmt: skip
FIGURES: Final = tuple(f for section in SECTIONS for f in section.figures)
INTRODUCTION: Final = (
    "Paper B's test of the crane (4.1.2, 5.1.3) on `aoro_fc8`: motions from the middle of the trail to [4.27, ±1.86, "
    "1] and [6, ±1.86, 1] m in the crane's base frame, {repetitions} of each on every machine (paper B: 20 on one), "
    "half of them empty, half with 200 kg on the hook. "
    "Every machine is another individual drawn from the truth's spread that `timberhand calibrate` was run on first, "
    "survey included; controller, guard, bus and plant run in lockstep. The paper does not say where its motions "
    "start: here the pin stands 3 m from the slew axis and 3.5 m high over the bunk's middle line, so that the open "
    "grapple is clear of the stakes on the whole way. `timberhand experiment crane-accuracy --docs docs` measures "
    "everything and writes this page; no number is typed."
)


def accuracy(motions: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The metrics of one variant's motions; empty without any."""
    if not motions:
        return {}
    error, true = (np.array([m[key] for m in motions]) for key in ("encoder_m", "true_m"))
    size, off = np.linalg.norm(error, axis=1), np.linalg.norm(true, axis=1)
    ended = [m for m in motions if m["motion_s"] is not None]
    ratios = np.array([m["motion_s"] / m["minimum_s"] for m in ended])
    swing = np.array([m["swing_deg"] for m in motions])
    commands = sum(m["commands"] for m in motions)
    loaded = np.array([m["load_kg"] > 0.0 for m in motions])
    found = {
        "encoder_error_mean_m": size.mean(),
        "encoder_error_xy_mean_m": np.hypot(error[:, 0], error[:, 1]).mean(),
        "encoder_error_z_mean_m": np.abs(error[:, 2]).mean(),
        "encoder_error_p95_m": np.percentile(size, 95.0),
        "encoder_error_max_m": size.max(),
        "tip_error_mean_m": off.mean(),
        "tip_error_p95_m": np.percentile(off, 95.0),
        "sway_residual_deg": np.percentile(swing, 95.0),
        "sway_residual_mean_deg": swing.mean(),
        "planned_ratio": np.mean([m["planned_s"] / m["minimum_s"] for m in motions]),
    }
    for name, chosen in (("empty", ~loaded), ("loaded", loaded)):
        if chosen.any():
            found[f"encoder_error_{name}_mean_m"] = size[chosen].mean()
            found[f"tip_error_{name}_mean_m"] = off[chosen].mean()
    if ended:
        found["time_ratio"], found["time_ratio_p95"] = ratios.mean(), np.percentile(ratios, 95.0)
        found["motion_s"] = np.mean([m["motion_s"] for m in ended])
    if commands:
        found["limit_cycle_share"] = 1.0 - sum(m["shut"] for m in motions) / commands
    return {name: float(value) for name, value in found.items()} | rate("ended", len(ended), len(motions))


def gather(outcomes: Mapping[str, Any], own_law: str) -> dict[str, float]:
    """All metrics from the outcomes by name (MACHINE/VARIANT, and MACHINE/calibration)."""
    runs: dict[str, list[dict[str, Any]]] = {}
    for name, outcome in outcomes.items():
        runs.setdefault(name.split("/")[1], []).append(outcome)
    calibrations = runs.pop("calibration", [])
    done = {v: [m for o in found for m in o["motions"] if not m["failed"]] for v, found in runs.items()}
    by_variant = {v: accuracy(motions) for v, motions in done.items()}
    metrics = dict(by_variant.get(OWN, {}))
    for law, prefix in LAWS.items():
        found = by_variant.get(OWN if law == own_law else law, {})
        metrics |= {f"{prefix}.{name}": value for name, value in found.items()}
    bare, raw, plain = (by_variant.get(v, {}) for v in (UNCOMPENSATED, UNCALIBRATED, UNSHAPED))
    if own := done.get(OWN):
        metrics["aim_offset_mean_m"] = _mean_size(
            np.array([m["encoder_to_goal_m"] for m in own]) - np.array([m["encoder_m"] for m in own])
        )
    if bare:
        metrics["tip_error_uncorrected_mean_m"] = bare["tip_error_mean_m"]
        metrics["uncompensated_encoder_error_mean_m"] = bare["encoder_error_mean_m"]
    if raw:
        metrics["uncalibrated_error_mean_m"] = _mean_size(
            np.array([m["encoder_to_goal_m"] for m in done[UNCALIBRATED]])
        )
        metrics["uncalibrated_tip_error_mean_m"] = raw["tip_error_mean_m"]
    if plain:
        for name in ("sway_residual_deg", "sway_residual_mean_deg"):
            metrics[f"unshaped_{name}"] = plain[name]
        if "sway_residual_mean_deg" in metrics:
            metrics["sway_reduction"] = 1.0 - metrics["sway_residual_mean_deg"] / plain["sway_residual_mean_deg"]
    if own_law in LAWS:
        alone = ("tip_error_uncorrected_mean_m", "uncalibrated_error_mean_m", "sway_reduction")
        metrics |= {f"{LAWS[own_law]}.{name}": metrics[name] for name in alone if name in metrics}
    everything = [o for found in runs.values() for o in found]
    metrics["stops"] = float(sum(o["stops"] for o in everything))
    metrics["failures"] = float(sum(o["missing"] + sum(m["failed"] for m in o["motions"]) for o in everything))
    metrics["calibration_failures"] = float(sum(o["profile"] is None for o in calibrations))
    return metrics


def _mean_size(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())
