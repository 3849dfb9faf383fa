"""Plots of the grasp-network experiment; none shows anything of the Cornell data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from autonomy.grasp.network import GraspNet, best_pixel, normalized_relief
from experiments.grasp_network.latency import PATHS, log_scenes
from experiments.grasp_network.metrics import MAX_LATENCY_RATIO, PAPER
from runtime.plot_style import OIL, RUST, STEEL, TIMBER, sheet

BARS = {
    "cornell_paper_split": "views at random\n(as in the paper)",
    "cornell_grouped": "objects apart",
    "cornell_paper_split_own_size": "views at random,\nlabel's size",
    "cornell_grouped_own_size": "objects apart,\nlabel's size",
}
SHOWN = (0, 1, 3, 6, 10)
CHOSEN = "#35d04a"


def draw(metrics: Mapping[str, float], times: Mapping[str, list[float]], net: GraspNet, seed: int, out: Path) -> None:
    """Write every plot into ``out``."""
    _cornell(metrics, out / "cornell.png")
    _latency(times, out / "latency.png")
    _logs(net, seed, out / "logs.png")


def _cornell(m: Mapping[str, float], path: Path) -> None:
    with sheet(path) as axis:
        shown = {name: label for name, label in BARS.items() if name in m}
        for i, name in enumerate(shown):
            low, high = (100.0 * m[f"{name}_{end}"] for end in ("low", "high"))
            colour = OIL if "own" not in name else STEEL
            axis.bar(i, 100.0 * m[name], 0.55, color=colour, alpha=0.85)
            axis.plot([i, i], [low, high], color="black", lw=1.4)
            axis.text(i, 5.0, f"{100.0 * m[name]:.1f} %", ha="center", color="white", weight="bold")
        axis.axhline(100.0 * PAPER["cornell_paper_split"], color=RUST, ls="--", lw=0.9, label="paper A, 885 samples")
        axis.set_xticks(range(len(shown)), list(shown.values()))
        axis.set_xlim(-0.5, len(BARS) - 0.5)
        axis.set_ylim(0, 100)
        axis.set_ylabel("correct grasps [%]")
        axis.set_title("Cornell samples, 10 folds" if shown else "Cornell samples: none available")
        axis.legend(loc="upper right")


def _latency(times: Mapping[str, list[float]], path: Path) -> None:
    with sheet(path, height=2.6) as axis:
        base = float(np.median(times["torch"]))
        for i, name in enumerate(PATHS):
            low, middle, high = np.percentile(times[name], [25, 50, 75]) / base
            axis.barh(-i, middle, 0.6, color=STEEL if name == "torch" else TIMBER)
            axis.plot([low, high], [-i, -i], color="black", lw=1.2)
            axis.text(max(middle, high) + 0.015, -i, f"{middle:.2f}", va="center")
        axis.axvline(MAX_LATENCY_RATIO, color=RUST, ls="--", lw=0.9)
        axis.set_yticks([-i for i in range(len(PATHS))], list(PATHS.values()))
        axis.set_xlabel("time of a picture, PyTorch eager = 1")
        axis.set_title("One thread")


def _logs(net: GraspNet, seed: int, path: Path) -> None:
    scenes = log_scenes(seed)
    with sheet(path, 2 * len(SHOWN), 11.0, 4.6) as axes:
        figure = axes[0].get_figure()
        for axis in axes:
            axis.remove()
        grid = figure.subplots(2, len(SHOWN))
        for column, i in enumerate(SHOWN):
            depth, _ = scenes[i]
            maps = net.maps(depth)
            g = best_pixel(maps)
            top, bottom = grid[:, column]
            top.imshow(normalized_relief(depth), cmap="gray", vmin=-1.0)
            quality = bottom.imshow(maps.q, cmap="inferno", vmin=0.0, vmax=1.0)
            for axis in (top, bottom):
                along = 26.0 * np.array([math.cos(g.theta_rad), math.sin(g.theta_rad)])
                ends = np.array([g.u_px, g.v_px]) + np.array([[-1.0], [1.0]]) * along
                axis.plot(*ends.T, color=CHOSEN, lw=2.2)
                axis.plot(g.u_px, g.v_px, "o", color=CHOSEN, ms=4)
                axis.set_axis_off()
        grid[0, 0].set_title("Height above ground")
        grid[1, 0].set_title("Grasp quality Q")
        figure.colorbar(quality, ax=list(grid[1]), shrink=0.8)
