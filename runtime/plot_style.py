"""The style of every plot, drawn without a display; the same data give the same PNG bytes.

The only module of this package that needs more than the standard library (matplotlib).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib
from cycler import cycler

matplotlib.use("Agg")
from matplotlib import pyplot

TIMBER, OIL, STEEL, MOSS, RUST = "#9a6a38", "#1f5f8b", "#5b6670", "#4d7c4a", "#b5452c"
STYLE: Final[dict[Any, Any]] = {
    "figure.dpi": 110,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e6e8",
    "axes.axisbelow": True,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "axes.prop_cycle": cycler(ls=["-", "--"]) * cycler(color=[OIL, TIMBER, MOSS, RUST, STEEL]),
}


@contextmanager
def sheet(path: Path, columns: int = 1, width: float = 8.0, height: float = 3.2) -> Iterator[Any]:
    """Yield a row of axes (one Axes for a single column) and save it to ``path`` at the end; sizes in inches."""
    with pyplot.rc_context(STYLE):
        figure, axes = pyplot.subplots(1, columns, figsize=(width, height))
        try:
            yield axes
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, metadata={"Software": None})
        finally:
            pyplot.close(figure)


def limit_band(axis: Any, least: float | None, most: float | None) -> None:
    """Shade the y values below ``least`` and above ``most``, which a result must not have."""
    low, high = axis.get_ylim()
    if least is not None:
        axis.axhspan(min(low, least), least, color=RUST, alpha=0.08, lw=0)
        axis.axhline(least, color=RUST, lw=0.8, ls="--")
    if most is not None:
        axis.axhspan(most, max(high, most), color=RUST, alpha=0.08, lw=0)
        axis.axhline(most, color=RUST, lw=0.8, ls="--")


@contextmanager
def stack(path: Path, heights: Sequence[float], width: float = 8.0, height: float = 6.0) -> Iterator[Any]:
    """Yield axes one below the other with a common x axis and save them to ``path`` at the end.

    ``heights`` are the axes' shares of the figure; ``width`` and ``height`` are in inches.
    """
    with pyplot.rc_context(STYLE):
        figure, axes = pyplot.subplots(
            len(heights), 1, figsize=(width, height), sharex=True, height_ratios=list(heights), squeeze=False
        )
        try:
            yield axes[:, 0]
            figure.align_ylabels(axes)
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, metadata={"Software": None})
        finally:
            pyplot.close(figure)
