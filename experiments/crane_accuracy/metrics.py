"""Metrics of the crane-accuracy experiment with their limits, and the page that shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from experiments.common.result import Metric, rate
from experiments.common.result_page import Section
from experiments.crane_accuracy.plan import LAWS, OWN, UNCALIBRATED, UNCOMPENSATED, UNSHAPED

MM: Final = 1e3
PAPER: Final = {"encoder_error_mean_m": 0.08, "encoder_error_xy_mean_m": 0.04, "encoder_error_z_mean_m": 0.06}
"""Paper B, Fig. 20: means of 80 points, tip from forward kinematics of the joint sensors."""


CONCLUSION: Final = (
    "By encoders the tip comes to rest {encoder_error_mean_m} from its goal on average (paper B: "
    "{paper:encoder_error_mean_m}); the true pin is {tip_error_mean_m} from the goal.",
    "A motion takes {time_ratio} times the shortest time that the machine allows, and shaped references reduce the "
    "swing of the grapple by {sway_reduction}.",
)
INTRODUCTION: Final = (
    "This experiment repeats paper B's test of the crane (4.1.2, 5.1.3) on `aoro_fc8`: motions from the middle of the "
    "trail to [4.27, ±1.86, 1] and [6, ±1.86, 1] m in the crane's base frame, {repetitions} of each on every machine "
    "(paper B: 20 on one machine), half of them empty, half with 200 kg on the hook. Every machine is another "
    "individual drawn from the truth's spread and calibrated first with `timberhand calibrate`, survey included. "
    "Controller, guard, bus and plant run in lockstep. The paper does not state where its motions start. Here the pin "
    "starts 3 m from the slew axis and 3.5 m high above the middle line of the bunk, so that the open grapple stays "
    "clear of the stakes."
)


def _mm(name: str, title: str, how: str, most: float | None = None) -> Metric:
    return Metric(name, title, "mm", how, most=most)


ACCURACY: Final = (
    _mm(
        "encoder_error_mean_m",
        "Error by encoders, 3-D, mean",
        "Distance of the hanger pin, by the controller's joint positions, from the point to which the encoders were "
        "commanded; mean over half a second, 3 s after arrival; all machines, goals, repetitions and loads.",
        0.010,
    ),
    _mm("encoder_error_xy_mean_m", "Error by encoders, horizontal, mean", "The same points.", 0.007),
    _mm("encoder_error_z_mean_m", "Error by encoders, height, mean", "The same points.", 0.007),
    _mm("encoder_error_p95_m", "Error by encoders, 3-D, 95th percentile", "The same points.", 0.020),
    _mm("encoder_error_max_m", "Error by encoders, 3-D, worst", "The same points."),
    _mm("encoder_error_empty_mean_m", "Error by encoders, 3-D, grapple empty, mean", "Half of the points."),
    _mm("encoder_error_loaded_mean_m", "Error by encoders, 3-D, with 200 kg, mean", "The other half."),
    _mm(
        "tip_error_mean_m",
        "True pin from the goal, 3-D, mean",
        "Position of the pin in the crane's base frame, from the plant's ground truth; same times.",
        0.03,
    ),
    _mm("tip_error_p95_m", "True pin from the goal, 3-D, 95th percentile", "The same points."),
    _mm("tip_error_empty_mean_m", "True pin from the goal, grapple empty, mean", "Half of the points."),
    _mm("tip_error_loaded_mean_m", "True pin from the goal, with 200 kg, mean", "The other half."),
    _mm(
        "aim_offset_mean_m",
        "Offset of the commanded encoder position from the goal, mean",
        "The correction of the profile's sag model for the lean of the column.",
    ),
    _mm(
        "tip_error_uncorrected_mean_m",
        "True pin from the goal without sag compensation, mean",
        "The calibrated profile without its sag table.",
    ),
    _mm(
        "uncompensated_encoder_error_mean_m",
        "Error by encoders against the goal without sag compensation, mean",
        "The same motions; the encoders are commanded to the goal itself, as in paper B.",
    ),
    _mm(
        "uncalibrated_error_mean_m",
        "Error by encoders against the goal before calibration, mean",
        "The profile as shipped, on the same individuals.",
        0.06,
    ),
    _mm("uncalibrated_tip_error_mean_m", "True pin from the goal before calibration, mean", "The same motions."),
)
MOTION: Final = (
    Metric(
        "time_ratio",
        "Motion time over the shortest possible, mean",
        "",
        "From the start of the reference until the pin by encoders stays within 20 mm of its end, over the time "
        "that full joint speeds, joint accelerations and the pump's flow allow for the same path (without jerk "
        "limit, delay or swing).",
        most=1.15,
    ),
    Metric("time_ratio_p95", "Motion time over the shortest possible, 95th percentile", "", "The same motions."),
    Metric("planned_ratio", "Planned duration over the shortest possible, mean", "", "Duration of the reference."),
    Metric("motion_s", "Motion time, mean", "s", "The same motions."),
    Metric("ended", "Completed motions", "%", "The pin stays within 20 mm of the end.", least=0.99),
    Metric(
        "limit_cycle_share",
        "Valve commands that are not zero after settling",
        "%",
        "Share of the valve commands on the bus with any joint not exactly zero, from 2 s after arrival on.",
        most=0.05,
    ),
    Metric("stops", "Controlled stops", "", "All runs of all variants.", most=0),
    Metric("failures", "Failed motions", "", "Stopped, refused or never started; all variants.", most=0),
    Metric(
        "calibration_failures",
        "Machines without a calibrated profile",
        "",
        "The calibration stopped or rejected a value; such a machine makes no motions.",
        most=0,
    ),
)
SWING: Final = (
    Metric(
        "sway_residual_deg",
        "Swing of the grapple, 95th percentile",
        "deg",
        "Largest true lean of the grapple from the vertical in both planes, 1 to 3 s after the end of the "
        "reference, whether or not the pin has settled.",
        most=3.0,
    ),
    Metric("sway_residual_mean_deg", "Swing of the grapple, mean", "deg", "The same motions."),
    Metric(
        "unshaped_sway_residual_deg",
        "Swing with unshaped references, 95th percentile",
        "deg",
        "The same paths in the same time with a time law that ignores the swing.",
    ),
    Metric("unshaped_sway_residual_mean_deg", "Swing with unshaped references, mean", "deg", "The same motions."),
    Metric(
        "sway_reduction", "Reduction of the swing by shaping", "%", "One minus the ratio of the two means.", least=0.6
    ),
)
LAW_NAMES: Final = {"pd": "PD", "smc": "sliding mode", "sta": "super-twisting"}


def _law(prefix: str) -> tuple[Metric, ...]:
    name = LAW_NAMES[prefix]
    how = "As above, with this law on every joint and the gain of the profile."
    return (
        _mm(f"{prefix}.encoder_error_mean_m", f"{name}: error by encoders, 3-D, mean", how),
        _mm(f"{prefix}.encoder_error_p95_m", f"{name}: error by encoders, 3-D, 95th percentile", how),
        _mm(f"{prefix}.tip_error_mean_m", f"{name}: true pin from the goal, mean", how),
        Metric(f"{prefix}.time_ratio", f"{name}: motion time over the shortest possible, mean", "", how),
        Metric(f"{prefix}.sway_residual_deg", f"{name}: swing of the grapple, 95th percentile", "deg", how),
        Metric(f"{prefix}.limit_cycle_share", f"{name}: valve commands that are not zero after settling", "%", how),
    )


SECTIONS: Final = (
    Section(
        "Accuracy at rest",
        "Figures 19 and 20 of paper B. The 8, 4 and 6 cm of the paper are comparable with the first three rows: "
        "forward kinematics of the joint sensors, without the deflection of the steel. With sag compensation the "
        "encoders are commanded to a point beside the goal, so that the true pin is at the goal; their error is "
        "measured from that point. Without compensation it is measured from the goal itself. All limits are those of "
        "this project.",
        ACCURACY,
        (
            (
                "histogram.png",
                "As Fig. 20 of paper B: error by encoders in 3-D, horizontal and in height. Dashed: mean "
                "of paper B; solid: mean here.",
            ),
            (
                "points.png",
                "As Fig. 19 of paper B, enlarged: rest positions of the pin by encoders, from above, relative to the "
                "commanded point. Squares: empty; x: with 200 kg.",
            ),
            (
                "true_points.png",
                "True pin at the same times relative to the goal, from the side. Squares: empty; x: with 200 kg; "
                "light: without sag compensation.",
            ),
        ),
    ),
    Section(
        "Motion time and settling",
        "The shortest time is a bound that no machine reaches: full acceleration of every joint from one moment to the "
        "next, the full flow of the pump, and no regard for swing.",
        MOTION,
        (
            (
                "motion.png",
                "One motion to point 3 with 200 kg: path of the pin, its errors, the valve commands, the lean of the "
                "grapple.",
            ),
        ),
    ),
    Section(
        "Swing of the grapple",
        "The grapple hangs from two joints without actuator and sensor.",
        SWING,
    ),
    Section(
        "Control laws",
        "The same machines and goals with one empty and one loaded motion to each goal. For the law of the profile all "
        "its motions count, and only it runs without sag compensation, without calibration and unshaped. Sliding mode "
        "and super-twisting are reconstructions: paper B names them without equations.",
        tuple(m for prefix in LAWS.values() for m in _law(prefix)),
    ),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


def accuracy(motions: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Compute the metrics of the motions of one variant; empty without motions."""
    if not motions:
        return {}
    error, true = (np.array([m[key] for m in motions]) for key in ("encoder_m", "true_m"))
    size, off = np.linalg.norm(error, axis=1), np.linalg.norm(true, axis=1)
    ended = [m for m in motions if m["motion_s"] is not None]
    ratios = np.array([m["motion_s"] / m["minimum_s"] for m in ended])
    swing = np.array([m["swing_deg"] for m in motions])
    commands = sum(m["commands"] for m in motions)
    loaded = np.array([m["load_kg"] > 0.0 for m in motions])
    metrics = {
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
            metrics[f"encoder_error_{name}_mean_m"] = size[chosen].mean()
            metrics[f"tip_error_{name}_mean_m"] = off[chosen].mean()
    if ended:
        metrics["time_ratio"], metrics["time_ratio_p95"] = ratios.mean(), np.percentile(ratios, 95.0)
        metrics["motion_s"] = np.mean([m["motion_s"] for m in ended])
    if commands:
        metrics["limit_cycle_share"] = 1.0 - sum(m["shut"] for m in motions) / commands
    return {name: float(value) for name, value in metrics.items()} | rate("ended", len(ended), len(motions))


def gather(outcomes: Mapping[str, Any], own_law: str) -> dict[str, float]:
    """Compute all metrics from the outcomes by name (MACHINE/VARIANT, and MACHINE/calibration)."""
    runs: dict[str, list[dict[str, Any]]] = {}
    for name, outcome in outcomes.items():
        runs.setdefault(name.split("/")[1], []).append(outcome)
    calibrations = runs.pop("calibration", [])
    done = {v: [m for o in results for m in o["motions"] if not m["failed"]] for v, results in runs.items()}
    by_variant = {v: accuracy(motions) for v, motions in done.items()}
    metrics = dict(by_variant.get(OWN, {}))
    for law, prefix in LAWS.items():
        results = by_variant.get(OWN if law == own_law else law, {})
        metrics |= {f"{prefix}.{name}": value for name, value in results.items()}
    bare, raw, unshaped = (by_variant.get(v, {}) for v in (UNCOMPENSATED, UNCALIBRATED, UNSHAPED))
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
    if unshaped:
        for name in ("sway_residual_deg", "sway_residual_mean_deg"):
            metrics[f"unshaped_{name}"] = unshaped[name]
        if "sway_residual_mean_deg" in metrics:
            metrics["sway_reduction"] = 1.0 - metrics["sway_residual_mean_deg"] / unshaped["sway_residual_mean_deg"]
    if own_law in LAWS:
        alone = ("tip_error_uncorrected_mean_m", "uncalibrated_error_mean_m", "sway_reduction")
        metrics |= {f"{LAWS[own_law]}.{name}": metrics[name] for name in alone if name in metrics}
    everything = [o for results in runs.values() for o in results]
    metrics["stops"] = float(sum(o["stops"] for o in everything))
    metrics["failures"] = float(sum(o["missing"] + sum(m["failed"] for m in o["motions"]) for o in everything))
    metrics["calibration_failures"] = float(sum(o["profile"] is None for o in calibrations))
    return metrics


def _mean_size(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())
