"""What the navigation experiment reports: figures with their limits, and the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from autonomy.navigation.clothoid_path import Point2
from experiments.common.result import Figure, rate
from experiments.common.result_page import Section
from experiments.navigation import measure
from experiments.navigation.measure import Drive
from machine.profile import Carrier

CM: Final = 100.0
GROUNDS: Final = {"flat": "firm level ground", "mud": "mud", "hill": "a side slope of 10 degrees"}
LAP: Final = 4
PAPER: Final = {"heading_deg_per_m": 9.0}

OURS: Final = (
    Figure("lateral_p95_m", "Ours: lateral error, 95th percentile", "cm",
           "True middle of the front axle from the planned path, after the bend at the first waypoint, all grounds, "
           "starts and laps together.", most=0.08, scale=CM),
    *(Figure(f"{g}.lateral_p95_m", f"Ours on {words}", "cm", "The same on this ground.", scale=CM)
      for g, words in GROUNDS.items()),
    Figure("lateral_max_m", "Ours: greatest lateral error", "cm", "Of the same.", scale=CM),
    Figure("own_p95_m", "Ours: lateral error that the machine saw", "cm", "By its own location: what the follower "
           "leaves; the rest is localization.", scale=CM),
    Figure("stop_max_m", "Stop beside the wanted place, along the path, greatest", "cm",
           "Where the front axle came to rest at the end of each drive.", most=0.05, scale=CM),
)  # fmt: skip
FAITHFUL: Final = (
    Figure("faithful.lateral_p95_m", "Paper B's law: lateral error on the last lap, 95th percentile", "cm",
           "From the common path, the mean of the last laps of all starts.", most=0.20, scale=CM),
    *(Figure(f"{g}.faithful.lateral_p95_m", f"Paper B's law on {words}", "cm", "The same on this ground.", scale=CM)
      for g, words in GROUNDS.items()),
    Figure("faithful.coming_p95_m", "Paper B's law: the same on the way there, 95th percentile", "cm",
           "From the first corner to the last lap: how far apart the starts still are while they come together.",
           scale=CM),
    Figure("heading_deg_per_m", "Paper B's law: the heading settles by", "deg/m", "Turn of the front per metre driven, "
           "between 10 and 90 % of each corner; median of all corners.", least=9.0),
    Figure("full_bend_deg_per_m", "Turn at full articulation", "deg/m", "While the articulation is at its end; median. "
           "9.03 without slip."),
)  # fmt: skip
BOTH: Final = (
    Figure("arrived", "Drives that arrived", "%", "At the last waypoint, or at the end of the path.", 1.0, None, 100.0),
    Figure("stops", "Stops by the supervisor", "", "Of all drives.", most=0.0),
    Figure("located_p95_m", "Localization: error of the position, 95th percentile", "cm", "Middle of the front axle "
           "in the plane, all drives; antennas stand up to 3 cm beside their places.", scale=CM),
    Figure("honesty", "Squared error over what was claimed, mean", "", "Of the position, in claimed standard "
           "deviations of its worst direction; 2 is honest in two dimensions, more is too sure.", most=4.0),
)  # fmt: skip
FIGURES: Final = OURS + FAITHFUL + BOTH
SECTIONS: Final = (
    Section(
        "Ours",
        "The polyline is rounded by clothoids and arcs that the machine can drive, and the front axle follows it with "
        "feed-forward of the articulation and feedback on the lateral and the course error of an extended Kalman "
        "filter over receiver, wheels, articulation and inclination. The speed is what bends, slope and ground allow.",
        OURS,
        (("lateral.png", "Lateral error of ours over the way, every start; dashed is the limit."),
         ("steering.png", "Articulation over the way on one start: paper B's law and ours.")),
    ),
    Section(
        "Paper B's law",
        "Bearing to the waypoint less heading sets the rate of the articulation, in the controller's tick; the "
        "waypoint changes within R tan(turn / 2) of it. The law knows no path, only points: starts that come to a "
        "corner from different sides leave it on different lines, and each corner brings them closer by the "
        "distance of the switch over the length of the leg. So the error is measured from the path that all starts "
        "come to, on the last lap; the way there is told beside it.",
        FAITHFUL,
        (("paths.png", "As paper B's Fig. 13: three starts by its law, two laps. Squares are starts, circles ends, "
          "diamonds waypoints."),
         ("heading.png", "As paper B's Fig. 14: bearing less heading over the way, the same three starts."),
         ("all.png", "As paper B's Fig. 15: all starts in one picture, paper B's law and ours.")),
    ),
    Section("Both", "", BOTH, ()),
)  # fmt: skip
INTRODUCTION: Final = (
    "Paper B's test of its navigation (4.1.1, 5.1.1): four waypoints on a field of 40 by 30 m at 63.657853 N, "
    "19.895562 E, two laps from each of six starts, at 2.3 km/h. The whole machine is on its two buses in lockstep; "
    "its receiver has the noise, the wandering error and the delay of RTK, its antennas stand beside their places, and "
    "every trial draws another individual. Ground: firm, mud (half the friction, a third of the tyres' slip stiffness, "
    "rolling resistance of 0.13) and a plane that rises by 10 degrees across two of the legs. Each way drives every "
    "start on every ground. `timberhand experiment navigation --docs docs` measures everything and writes this page; "
    "no number is typed."
)


def gather(outcomes: Mapping[str, Any], points: Sequence[Point2], carrier: Carrier, lap: int = LAP) -> dict[str, float]:
    """The figures of all drives; outcomes are named way/ground/trial/start."""
    groups: dict[tuple[str, str, str], list[Drive]] = {}
    for name, outcome in outcomes.items():
        way, ground, trial, _ = name.split("/")
        groups.setdefault((way, ground, trial), []).append(Drive(outcome))
    ours: dict[str, list[np.ndarray]] = {}
    common: dict[str, list[np.ndarray]] = {}
    coming: list[np.ndarray] = []
    own, stops, rates, fulls, off, claimed = [], [], [], [], [], []
    for (way, ground, _), drives in groups.items():
        good = [d for d in drives if d.outcome["arrived"]]
        for drive in drives:
            error = measure.located(drive)
            off.append(error)
            claimed.append(error / drive["sigma_m"])
        if way == "ours":
            for drive in good:
                path = measure.planned(drive, points, carrier)
                ways, lateral = measure.lateral(drive, path)
                after = ways > measure.corner_end_m(path, points[0])
                ours.setdefault(ground, []).append(np.abs(lateral[after]))
                own.append(np.abs(drive["off_m"][after]))
                stops.append(abs(path.nearest(*drive.outcome["rest_m"], path.length_m - 1.0) - path.length_m))
            continue
        for drive in good:
            steady, full = measure.turn_rates(drive)
            rates += steady
            fulls += full
        if len(good) > 1 and len(points) >= 2 * lap:
            for before, last in measure.faithful_errors(good, points, lap):
                common.setdefault(ground, []).append(last)
                coming.append(before)
    metrics = {f"{g}.lateral_p95_m": _p95(parts) for g, parts in ours.items()}
    metrics |= {f"{g}.faithful.lateral_p95_m": _p95(parts) for g, parts in common.items()}
    every, last = [p for parts in ours.values() for p in parts], [p for parts in common.values() for p in parts]
    for name, parts in (("lateral_p95_m", every), ("own_p95_m", own), ("located_p95_m", off),
                        ("faithful.lateral_p95_m", last), ("faithful.coming_p95_m", coming)):  # fmt: skip
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
