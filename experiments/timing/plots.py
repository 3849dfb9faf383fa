"""Plots of the timing experiment, one function per plot; all show the testbed at 200 Hz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from can_dbc.timing.durations import BINS, Durations
from can_dbc.timing.page import STAGES, InputAge
from experiments.timing.measurement import MeasurementWindow
from experiments.timing.metrics import EDGES_NS, loops, pooled, quantile_us
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

WHOLE: Final = {
    "tick": "whole tick, by the clock",
    "cpu": "whole tick, CPU time",
    "sample_to_command": "from the encoders' sample to the command",
}
WITHIN: Final = tuple(name for name in STAGES if name not in (*WHOLE, "wake", "sync"))
COLOURS: Final = {"controller": OIL, "cyclictest": MOSS, "time.sleep loop": RUST}
PERIOD_NS: Final = 5_000_000


def draw(quiet: Sequence[MeasurementWindow], loaded: Sequence[MeasurementWindow], out: Path) -> None:
    """Write every plot into ``out``: stages and inputs in the quiet windows, wake-ups in both."""
    with sheet(out / "wakeups.png", 2, height=3.4) as axes:
        for axis, windows, title in zip(axes, (quiet, loaded), ("Quiet", "Every core loaded"), strict=True):
            draw_exceeded(axis, dict(zip(COLOURS, loops(windows), strict=True)), PERIOD_NS)
            axis.set_title(title)
        axes[0].legend()
    stages({name: pooled([w.durations[name] for w in quiet]) for name in quiet[0].durations}, out / "stages.png")
    ages(quiet[-1].end.inputs, out / "ages.png")


def draw_exceeded(axis: Any, histograms: Mapping[str, Durations], period_ns: int) -> None:
    """Draw the share of wake-ups later than x for each loop, a point per filled bin, and the period dashed."""
    for name, histogram in histograms.items():
        bins = np.array(histogram.bins, float)
        filled = np.flatnonzero(bins)
        tops = np.where(filled < BINS - 1, np.minimum(EDGES_NS[filled + 1], histogram.longest_ns), histogram.longest_ns)
        later = np.maximum(1.0 - np.cumsum(bins)[filled] / max(1.0, bins.sum()), 0.5 / max(1.0, bins.sum()))
        axis.step(tops / 1e3, later, where="post", color=COLOURS[name], label=name)
    axis.axvline(period_ns / 1e3, color=STEEL, ls="--", lw=0.8)
    axis.set(xscale="log", yscale="log", xlabel="lateness [us]", ylabel="share of later wake-ups")


def stages(durations: Mapping[str, Durations], path: Path) -> None:
    """Draw median, p99 and longest of every stage, of the tick by the clock and CPU time, and of the whole latency."""
    names = [n for n in (*WITHIN, *WHOLE) if n in durations and durations[n].longest_ns]
    with sheet(path, height=0.5 + 0.34 * len(names)) as axis:
        for y, name in enumerate(reversed(names)):
            h = durations[name]
            p50, p99 = (max(0.3, quantile_us(h, share)) for share in (0.5, 0.99))
            colour = TIMBER if name in WITHIN else OIL
            axis.barh(y, p50, color=colour, height=0.6)
            axis.plot([p50, p99], [y, y], color=colour, lw=3, alpha=0.55, solid_capstyle="butt")
            axis.plot(h.longest_ns / 1e3, y, "|", color=RUST, ms=9, mew=1.6)
            axis.text(max(p99, h.longest_ns / 1e3) * 1.08, y, f"{p50:.0f} / {p99:.0f} us", va="center", fontsize=8)
        axis.set_yticks(range(len(names)), [WHOLE.get(n, n) for n in reversed(names)])
        axis.set(xscale="log", xlabel="us: bar median, line p99, tick longest", title="Stages of a tick at 200 Hz")
        axis.set_xlim(right=2.0 * max(durations[name].longest_ns for name in names) / 1e3)


def ages(inputs: Mapping[str, InputAge], path: Path) -> None:
    """Draw newest and longest age of every input used."""
    used = sorted((n, a) for n, a in inputs.items() if a.count)
    with sheet(path, height=0.6 + 0.2 * max(1, len(used))) as axis:
        for y, (_, age) in enumerate(reversed(used)):
            newest, longest = max(1e-3, age.newest_ns / 1e6), max(1e-3, age.longest_ns / 1e6)
            axis.plot([newest, longest], [y, y], color=TIMBER, lw=2)
            axis.plot(newest, y, "o", color=OIL, ms=4)
            axis.plot(longest, y, "|", color=RUST, ms=8, mew=1.6)
        axis.set_yticks(range(len(used)), [n for n, _ in reversed(used)], fontsize=7)
        axis.set(xscale="log", xlabel="age when used [ms]: dot newest, tick longest", title="Inputs of a tick")
