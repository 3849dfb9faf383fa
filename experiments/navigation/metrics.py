"""Metrics of the navigation experiment with their limits, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from autonomy.navigation.clothoid_path import Point2
from experiments.common.result import Metric, rate
from experiments.common.result_page import Section
from experiments.navigation import measure
from experiments.navigation.measure import Drive
from machine.profile import Carrier

CM: Final = 100.0
GROUNDS: Final = {"flat": "firm level ground", "mud": "mud", "hill": "a side slope of 10 degrees"}
LAP: Final = 4
PAPER: Final = {"heading_deg_per_m": 9.0}

CONCLUSION: Final = (
    "Our path follower keeps the front axle within {lateral_p95_m} of the planned path (95th percentile) and stops "
    "within {stop_max_m} of the goal.",
    "With paper B's law the last laps of all starts agree within {faithful.lateral_p95_m}, and the heading settles by "
    "{heading_deg_per_m} (paper: {paper:heading_deg_per_m}).",
)
OURS: Final = (
    Metric(
        "lateral_p95_m",
        "Ours: lateral error, 95th percentile",
        "cm",
        "True middle of the front axle from the planned path, after the bend at the first waypoint; all grounds, "
        "starts and laps.",
        most=0.08,
    ),
    *(
        Metric(f"{g}.lateral_p95_m", f"Ours on {title}: lateral error, 95th percentile", "cm", "On this ground.")
        for g, title in GROUNDS.items()
    ),
    Metric("lateral_max_m", "Ours: largest lateral error", "cm", "All grounds."),
    Metric(
        "own_p95_m",
        "Ours: lateral error by the machine's own location, 95th percentile",
        "cm",
        "The error of the follower; the rest is localization.",
    ),
    Metric(
        "stop_max_m",
        "Ours: stopping error along the path, largest",
        "cm",
        "Rest position of the front axle at the end of each drive.",
        most=0.05,
    ),
)
FAITHFUL: Final = (
    Metric(
        "faithful.lateral_p95_m",
        "Paper B's law: lateral error on the last lap, 95th percentile",
        "cm",
        "From the common path, the mean of the last laps of all starts.",
        most=0.20,
    ),
    *(
        Metric(
            f"{g}.faithful.lateral_p95_m",
            f"Paper B's law on {title}: lateral error on the last lap, 95th percentile",
            "cm",
            "On this ground.",
        )
        for g, title in GROUNDS.items()
    ),
    Metric(
        "faithful.coming_p95_m",
        "Paper B's law: lateral error before the last lap, 95th percentile",
        "cm",
        "From the first corner to the last lap: distance between the starts while they converge.",
    ),
    Metric(
        "heading_deg_per_m",
        "Paper B's law: settling of the heading",
        "deg/m",
        "Turn of the front per metre, between 10 and 90 % of each corner; median of all corners.",
        least=9.0,
    ),
    Metric(
        "full_bend_deg_per_m",
        "Turn at full articulation",
        "deg/m",
        "While the articulation is at its limit; median. 9.03 without slip.",
    ),
)
BOTH: Final = (
    Metric("arrived", "Completed drives", "%", "At the last waypoint, or at the end of the path.", 1.0, None, 100.0),
    Metric("stops", "Stops by the supervisor", "", "All drives.", most=0.0),
    Metric(
        "located_p95_m",
        "Localization: error of the position, 95th percentile",
        "cm",
        "Middle of the front axle in the plane, all drives; antennas are mounted up to 3 cm off.",
    ),
    Metric(
        "honesty",
        "Localization: squared error over the claimed variance, mean",
        "",
        "Error of the position over the claimed standard deviation of its worst direction; 2 is consistent in two "
        "dimensions, more is overconfident.",
        most=4.0,
    ),
)
METRICS: Final = OURS + FAITHFUL + BOTH
SECTIONS: Final = (
    Section(
        "Our path follower",
        "The polyline is rounded by clothoids and arcs that the machine can drive. The front axle follows it with "
        "feed-forward of the articulation and feedback on lateral and course error from an extended Kalman filter over "
        "receiver, wheels, articulation and inclination. Bends, slope and ground limit the speed.",
        OURS,
        (
            ("lateral.png", "Lateral error of our follower along the path, every start; dashed: limit."),
            ("steering.png", "Articulation along the path from one start: paper B's law and ours."),
        ),
    ),
    Section(
        "Paper B's law",
        "Bearing to the waypoint less heading sets the rate of the articulation in the controller's tick; the waypoint "
        "changes within R tan(turn / 2) of it. The law knows points but no path. Starts that reach a corner from "
        "different sides leave it on different lines, and each corner brings them closer by the ratio of the switching "
        "distance to the length of the leg. Therefore the error is measured from the path to which all starts "
        "converge, on the last lap; the part before is reported as well.",
        FAITHFUL,
        (
            (
                "paths.png",
                "As Fig. 13 of paper B: three starts by its law, two laps. Squares: starts; circles: ends; "
                "diamonds: waypoints.",
            ),
            ("heading.png", "As Fig. 14 of paper B: bearing less heading along the path, the same three starts."),
            ("all.png", "As Fig. 15 of paper B: all starts, paper B's law and ours."),
        ),
    ),
    Section("Both", "", BOTH),
)
INTRODUCTION: Final = (
    "This experiment repeats paper B's test of its navigation (4.1.1, 5.1.1): four waypoints on a field of 40 by 30 m "
    "at 63.657853 N, 19.895562 E, two laps from each of six starts, at 2.3 km/h. The whole machine is on its two buses "
    "in lockstep. Its receiver has the noise, the drift and the delay of RTK, its antennas are mounted with errors, "
    "and every trial uses another individual machine. Ground: firm, mud (half the friction, a third of the tyres' slip "
    "stiffness, rolling resistance of 0.13) and a plane that rises by 10 degrees across two of the legs. Both methods "
    "drive every start on every ground."
)


def gather(outcomes: Mapping[str, Any], points: Sequence[Point2], carrier: Carrier, lap: int = LAP) -> dict[str, float]:
    """Compute the metrics of all drives; outcomes are named METHOD/GROUND/TRIAL/START."""
    groups: dict[tuple[str, str, str], list[Drive]] = {}
    for name, outcome in outcomes.items():
        method, ground, trial, _ = name.split("/")
        groups.setdefault((method, ground, trial), []).append(Drive(outcome))
    ours: dict[str, list[np.ndarray]] = {}
    common: dict[str, list[np.ndarray]] = {}
    coming: list[np.ndarray] = []
    own, stops, rates, fulls, location_errors_m, claimed = [], [], [], [], [], []
    for (method, ground, _), drives in groups.items():
        good = [d for d in drives if d.outcome["arrived"]]
        for drive in drives:
            error = measure.located(drive)
            location_errors_m.append(error)
            claimed.append(error / drive["sigma_m"])
        if method == "ours":
            for drive in good:
                path = measure.planned(drive, points, carrier)
                distances_m, lateral = measure.lateral(drive, path)
                after = distances_m > measure.corner_end_m(path, points[0])
                ours.setdefault(ground, []).append(np.abs(lateral[after]))
                own.append(np.abs(drive["off_m"][after]))
                x, y = drive.outcome["rest_m"]
                stops.append(abs(path.nearest(x, y, path.length_m - 1.0) - path.length_m))
            continue
        for drive in good:
            steady, full = measure.turn_rates(drive)
            rates += steady
            fulls += full
        if len(good) > 1 and len(points) >= 2 * lap:
            for before, last in measure.convergence_errors(good, points, lap):
                common.setdefault(ground, []).append(last)
                coming.append(before)
    metrics = {f"{g}.lateral_p95_m": _p95(parts) for g, parts in ours.items()}
    metrics |= {f"{g}.faithful.lateral_p95_m": _p95(parts) for g, parts in common.items()}
    every, final = [p for parts in ours.values() for p in parts], [p for parts in common.values() for p in parts]
    for name, parts in (
        ("lateral_p95_m", every),
        ("own_p95_m", own),
        ("located_p95_m", location_errors_m),
        ("faithful.lateral_p95_m", final),
        ("faithful.coming_p95_m", coming),
    ):
        if any(len(p) for p in parts):
            metrics[name] = _p95(parts)
    if every:
        metrics |= {"lateral_max_m": float(np.max(np.concatenate(every))), "stop_max_m": max(stops)}
    metrics |= {n: float(np.median(v)) for n, v in (("heading_deg_per_m", rates), ("full_bend_deg_per_m", fulls)) if v}
    known = np.concatenate(claimed)
    known = known[np.isfinite(known)]
    metrics["honesty"] = float(np.mean(known**2)) if len(known) else math.nan
    metrics["stops"] = float(sum(o["stops"] for o in outcomes.values()))
    return metrics | rate("arrived", sum(o["arrived"] for o in outcomes.values()), len(outcomes))


def _p95(parts: Sequence[np.ndarray]) -> float:
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.percentile(values, 95.0)) if len(values) else math.nan
