"""Plots of the timing experiment, one function per plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from can_dbc.timing.durations import BINS, Durations
from can_dbc.timing.page import STAGES, InputAge
from experiments.timing.evaluation import EDGES_NS, quantile_us
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

OUTSIDE: Final = ("wake", "sync", "tick", "cpu", "sample_to_command")
"""Durations of the timing page that are not a stage of the tick."""
WITHIN: Final = tuple(name for name in STAGES if name not in OUTSIDE)
COLOURS: Final = {"controller": OIL, "cyclictest": MOSS, "time.sleep loop": RUST}
PERIOD_NS: Final = 5_000_000
POINTS: Final = 60
Loops = tuple[Durations, Durations, Durations]


def draw(
    quiet: Loops, loaded: Loops, durations: Mapping[str, Durations], inputs: Mapping[str, InputAge], out: Path
) -> None:
    """Write every plot into ``out``; all show the testbed at 200 Hz."""
    out.mkdir(parents=True, exist_ok=True)
    wakeups(quiet, loaded, out / "wakeups.png")
    stages(durations, out / "stages.png")
    sample_to_command(durations["sample_to_command"], out / "sample-to-command.png")
    ages(inputs, out / "ages.png")


def exceeded(histogram: Durations) -> tuple[np.ndarray, np.ndarray]:
    """Lateness [us] and the share of later wake-ups, one point per filled bin."""
    bins = np.array(histogram.bins, float)
    total = bins.sum()
    if not total:
        return np.array([]), np.array([])
    filled = np.flatnonzero(bins)
    tops = np.where(filled < BINS - 1, EDGES_NS[np.minimum(filled + 1, BINS - 1)], histogram.longest_ns) / 1e3
    later = 1.0 - np.cumsum(bins)[filled] / total
    return np.minimum(tops, histogram.longest_ns / 1e3), np.maximum(later, 0.5 / total)


def draw_exceeded(axis: Any, histograms: Mapping[str, Durations], period_ns: int) -> None:
    """Share of wake-ups later than x for each loop, and the period as a dashed line."""
    for name, histogram in histograms.items():
        axis.step(*exceeded(histogram), where="post", color=COLOURS[name], label=name)
    axis.axvline(period_ns / 1e3, color=STEEL, ls="--", lw=0.8)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("lateness [us]")
    axis.set_ylabel("share of later wake-ups")


def wakeups(quiet: Loops, loaded: Loops, path: Path) -> None:
    """Share of wake-ups later than x, for the three loops."""
    with sheet(path, 2, height=3.4) as axes:
        for axis, loops, title in zip(axes, (quiet, loaded), ("Quiet", "Every core loaded"), strict=True):
            draw_exceeded(axis, dict(zip(COLOURS, loops, strict=True)), PERIOD_NS)
            axis.set_title(title)
        axes[0].legend()


def stages(durations: Mapping[str, Durations], path: Path) -> None:
    """Median, p99 and longest of every stage, of the tick by the clock and by CPU time."""
    names = [n for n in (*WITHIN, "tick", "cpu") if n in durations and durations[n].longest_ns]
    with sheet(path, height=0.5 + 0.34 * len(names)) as axis:
        for y, name in enumerate(reversed(names)):
            h = durations[name]
            bins = np.array(h.bins, float)
            p50, p99 = (max(0.3, quantile_us(bins, share, h.longest_ns)) for share in (0.5, 0.99))
            colour = TIMBER if name in WITHIN else OIL
            axis.barh(y, p50, color=colour, height=0.6)
            axis.plot([p50, p99], [y, y], color=colour, lw=3, alpha=0.55, solid_capstyle="butt")
            axis.plot(h.longest_ns / 1e3, y, "|", color=RUST, ms=9, mew=1.6)
            axis.text(max(p99, h.longest_ns / 1e3) * 1.08, y, f"{p50:.0f} / {p99:.0f} us", va="center", fontsize=8)
        axis.set_yticks(range(len(names)), [_label(n) for n in reversed(names)])
        axis.set_xscale("log")
        axis.set_xlim(right=2.0 * max(durations[name].longest_ns for name in names) / 1e3)
        axis.set_xlabel("us: bar median, line p99, tick longest")
        axis.set_title("Stages of a tick at 200 Hz")


def _label(name: str) -> str:
    return {"tick": "whole tick, by the clock", "cpu": "whole tick, CPU time"}.get(name, name)


def sample_to_command(histogram: Durations, path: Path) -> None:
    """Histogram over the whole range of values."""
    bins = np.array(histogram.bins, float)
    filled = np.flatnonzero(bins)
    with sheet(path) as axis:
        if len(filled):
            top = EDGES_NS[min(filled[-1] + 1, BINS - 1)] / 1e3
            edges = np.linspace(0.0, top, POINTS + 1)
            middles = (EDGES_NS[:-1] + EDGES_NS[1:])[: BINS - 1] / 2e3
            counts, _ = np.histogram(middles, edges, weights=bins[: BINS - 1])
            axis.stairs(counts / bins.sum(), edges, fill=True, color=OIL)
            axis.axvline(PERIOD_NS / 1e3, color=STEEL, ls="--", lw=0.8)
            axis.set_yscale("log")
        axis.set_xlabel("from the encoders' sample to the valve command [us]")
        axis.set_ylabel("share of ticks")
        axis.set_title("Sample to command at 200 Hz")


def ages(inputs: Mapping[str, InputAge], path: Path) -> None:
    """Newest and longest age of every input used."""
    used: Sequence[tuple[str, Any]] = sorted((n, a) for n, a in inputs.items() if a.count)
    with sheet(path, height=0.6 + 0.2 * max(1, len(used))) as axis:
        for y, (_, age) in enumerate(reversed(used)):
            newest, longest = max(1e-3, age.newest_ns / 1e6), max(1e-3, age.longest_ns / 1e6)
            axis.plot([newest, longest], [y, y], color=TIMBER, lw=2)
            axis.plot(newest, y, "o", color=OIL, ms=4)
            axis.plot(longest, y, "|", color=RUST, ms=8, mew=1.6)
        axis.set_yticks(range(len(used)), [n for n, _ in reversed(used)], fontsize=7)
        axis.set_xscale("log")
        axis.set_xlabel("age when used [ms]: dot newest, tick longest")
        axis.set_title("Inputs of a tick")
