"""Plots of the forwarding-mission experiment: maps of the missions, and offsets of the grasps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.forwarding_mission.metrics import CM, FIRST, offsets
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

TITLES: Final = {"ours": "ours", "faithful": "paper B's method"}
PAPER_MM: Final = (
    160.3,
    308.2,
    743.3,
    684.3,
    307.5,
    434.1,
    219.1,
    285.3,
    357.4,
    374.2,
    151.5,
    356.3,
    74.7,
    416.9,
    35.7,
    421.2,
    163.4,
    222.9,
    120.4,
    475.4,
    235.3,
    222.1,
    173.9,
)
"""Distances in Table 1 of paper B."""
LOG_WIDTH: Final = 3.2
LAP_M: Final = 0.6
"""Logs of the second lap are drawn this far beside those of the first."""


def draw(outcomes: Mapping[str, Any], out: Path) -> None:
    """Write all plots into ``out``."""
    _maps({prefix: outcomes[name] for prefix, name in FIRST.items() if name in outcomes}, out / "map.png")
    ours = [o for name, o in outcomes.items() if name.startswith("mission/") or name == FIRST["ours"]]
    _offsets(ours, out / "offsets.png")


def _maps(trials: Mapping[str, Any], path: Path) -> None:
    with sheet(path, max(1, len(trials)), width=5.2 * max(1, len(trials)), height=4.9) as axes:
        for axis, (prefix, outcome) in zip(np.atleast_1d(axes), trials.items(), strict=True):
            field(axis, outcome, TITLES[prefix])


def field(axis: Any, outcome: Mapping[str, Any], title: str) -> None:
    """Draw one mission from above."""
    driven_path = np.array(outcome["path"], float).reshape(-1, 4)
    axis.plot(driven_path[:, 1], driven_path[:, 2], color=STEEL, lw=0.9, zorder=1)
    if len(driven_path):
        axis.plot(*driven_path[0, 1:3], "s", color=STEEL, ms=5)
        axis.plot(*driven_path[-1, 1:3], "o", color=STEEL, ms=5)
    poses = _lying(outcome)
    for grasp in outcome["grasps"]:
        if grasp["state"] != "COLLECT" or not outcome["stands"]:
            continue
        stand = max((s for s in outcome["stands"] if s[2] <= grasp["begin_s"]), key=lambda s: s[2], default=None)
        for attempt in grasp["attempts"]:
            log = attempt["log"]
            if stand is not None and log is not None:
                axis.plot([stand[0], poses[log][0]], [stand[1], poses[log][1]], color=OIL, lw=0.5, alpha=0.6, zorder=2)
    for log, pose in zip(outcome["logs"], poses, strict=True):
        x, y, yaw = pose
        half = 0.5 * log["size_m"][0]
        dx, dy = half * math.cos(yaw), half * math.sin(yaw)
        colour = (TIMBER if log["in_bunk"] else RUST) if log["detected"] else "black"
        axis.plot([x - dx, x + dx], [y - dy, y + dy], color=colour, lw=LOG_WIDTH, solid_capstyle="butt", zorder=3)
    if outcome["stands"]:
        axis.plot(*np.array(outcome["stands"]).T[:2], "s", color=MOSS, ms=4, zorder=4)
    loaded, count = sum(log["in_bunk"] for log in outcome["logs"]), len(outcome["logs"])
    axis.set(title=f"{title}: {loaded} of {count} logs loaded", xlabel="east [m]", ylabel="north [m]", aspect="equal")


def _lying(outcome: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    """Return the original place of every log; those of later laps are drawn outside of the first lap's."""
    logs, places = outcome["logs"], outcome["places"] or len(outcome["logs"])
    middle = float(np.mean([log["place_m"][1] for log in logs[:places]]))
    at = []
    for i, log in enumerate(logs):
        x, y, _ = logs[i % places]["place_m"]
        at.append((x, y + (i // places) * math.copysign(LAP_M, y - middle), log["place_m"][2]))
    return at


def _offsets(outcomes: Sequence[Mapping[str, Any]], path: Path) -> None:
    off = CM * np.array([v for o in outcomes for _, v in offsets(o)]).reshape(-1, 3)
    far = np.linalg.norm(off, axis=1)
    with sheet(path, 2, width=9.0, height=3.2) as (left, right):
        left.axhline(0.0, color=STEEL, lw=0.6)
        left.axvline(0.0, color=STEEL, lw=0.6)
        left.plot(off[:, 0], off[:, 1], "o", color=OIL, ms=3, alpha=0.6, mew=0)
        left.set(title="From above", xlabel="across the machine [cm]", ylabel="along it [cm]", aspect="equal")
        widest = max(5.0, float(np.max(np.abs(off[:, :2]), initial=0.0)) * 1.1)
        left.set(xlim=(-widest, widest), ylim=(-widest, widest))
        bins = np.arange(0.0, 80.0, 2.0)
        paper = np.array(PAPER_MM) / 10.0
        right.hist(
            paper, bins=bins, weights=np.full(len(paper), 100.0 / len(paper)), color=TIMBER, alpha=0.5, label="paper B"
        )
        if len(far):
            right.hist(
                np.minimum(far, 79.0), bins=bins, weights=np.full(len(far), 100.0 / len(far)), color=OIL, label="ours"
            )
        right.axvline(8.0, color=RUST, lw=0.8, ls="--")
        right.set(title="Distance", xlabel="grapple to log [cm]", ylabel="share of grasps [%]")
        right.legend()
