"""Writes the result pages again from saved results: for new words on a page, without a new measurement.

Numbers, plots and the commit that a page names stay as they are.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from experiments.common import overview
from experiments.common.pool import read_published
from experiments.common.registry import EXPERIMENTS
from experiments.common.result_page import markdown


def rewrite(docs: Path) -> list[Path]:
    """Write every ``docs/NAME.md`` that exists from ``docs/results``, and the overview page; returns their paths.

    Raises:
        ValueError: a saved result or its published trials cannot be read.
    """
    written = []
    for name, result in overview.results_in(docs).items():
        path = docs / f"{name}.md"
        if not path.exists():
            continue
        module = import_module(EXPERIMENTS[name].module)
        trials = read_published(docs / module.PUBLISHED_TRIALS) if hasattr(module, "PUBLISHED_TRIALS") else {}
        path.write_text(markdown(result, module.page_of(result, trials)))
        written.append(path)
    return [*written, overview.write(docs)]
