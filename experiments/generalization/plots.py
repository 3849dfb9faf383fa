"""Plot of the generalization experiment: where the machine works and where it does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.generalization.matrix import title_of
from runtime.plot_style import MOSS, STEEL, sheet


def draw(path: Path, truths: Sequence[str], metrics: Mapping[str, float]) -> None:
    """A bar for every truth: the share of its logs in the bunk, hollow where no profile was written."""
    with sheet(path, 1, 8.0, 0.6 + 0.28 * len(truths)) as axis:
        for y, name in enumerate(truths):
            if metrics.get(f"{name}.calibrated", 0.0) > 0.0:
                axis.barh(y, 100.0 * metrics.get(f"{name}.success", 0.0), color=MOSS)
            else:
                axis.barh(y, 100.0, fill=False, edgecolor=STEEL, hatch="//")
        axis.set(yticks=range(len(truths)), yticklabels=[title_of(n) for n in truths], xlim=(0.0, 100.0))
        axis.set(xlabel="logs in the bunk [%]")
        axis.margins(y=0.01)
        axis.invert_yaxis()
