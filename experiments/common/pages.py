"""Writes the result pages again from saved results: for new words on a page, without a new measurement.

Measurements, plots and the commit that a page names stay as they are.  Where all outcomes are published, they are read
again by the criteria of today.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from experiments.common import overview
from experiments.common.checkpoint import read_published
from experiments.common.registry import EXPERIMENTS
from experiments.common.result_page import markdown
from experiments.common.standing import judge, marked


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
        if trials and hasattr(module, "evaluated_again"):
            result = module.evaluated_again(result, trials)
            result.save(docs / "results" / f"{name}.json")
        path.write_text(
            marked(markdown(result, module.page_of(result, trials)), judge(result.commit, EXPERIMENTS[name]))
        )
        written.append(path)
    return [*written, overview.write(docs)]
