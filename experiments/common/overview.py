"""The page that holds all experiments at a glance: what was asked, what was reached, what was missed, what papers have.

Written from the committed results alone, whenever one of them is refreshed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Final

import msgspec

from experiments.common.registry import EXPERIMENTS
from experiments.common.result import Figure, Result

TITLE: Final = "Figures at a glance"
INTRODUCTION: Final = (
    "What the experiments ask, and whether what they measured is within the limits that were set before. Each page "
    "says how every figure is measured, by which command, on which machine. This one is written whenever an experiment "
    "is run with `--docs docs`; no number is typed."
)


def write(docs: Path) -> Path:
    """Write ``figures.md`` from ``results/*.json`` in the folder; the page."""
    path = docs / "figures.md"
    path.write_text(page(results_in(docs), {p.stem for p in docs.glob("*.md")}))
    return path


def results_in(docs: Path) -> dict[str, Result]:
    """The saved results of the folder by name, in the order of the registry."""
    paths = {name: docs / "results" / f"{name}.json" for name in EXPERIMENTS}
    return {name: read(path) for name, path in paths.items() if path.exists()}


def read(path: Path) -> Result:
    """A saved result; a figure that is no number is NaN."""
    document = msgspec.json.decode(path.read_bytes())
    document["metrics"] = {k: float("nan") if v is None else v for k, v in document["metrics"].items()}
    return msgspec.convert(document, Result)


def page(results: Mapping[str, Result], pages: Collection[str]) -> str:
    """The page as Markdown; an experiment that is none of the ``pages`` is linked to its numbers."""
    links = {n: f"[{n}]({f'{n}.md' if n in pages else f'results/{n}.json'})" for n in results}
    lines = [f"# {TITLE}", "", INTRODUCTION, "", "| experiment | asks | limits held | commit |", "|---|---|---|---|"]
    for name, result in results.items():
        held = len(result.limits) - len(result.missed) - len(result.inconclusive)
        unsure = f", {len(result.inconclusive)} inconclusive" if result.inconclusive else ""
        lines.append(
            f"| {links[name]} | {EXPERIMENTS[name].sentence} | {held} of {len(result.limits)}{unsure} "
            f"| `{result.commit}` |"
        )
    lines += ["", "## Beside the papers", "", "| | figure | paper | here |", "|---|---|---|---|"]
    for name, result, figure in _figures(results):
        if figure.name in result.paper:
            here = figure.text(result.metrics[figure.name]) + result.interval_text(figure)
            lines.append(f"| {links[name]} | {figure.title} | {figure.text(result.paper[figure.name])} | {here} |")
    lines += ["", "## Missed", "", "| | figure | measured | limit |", "|---|---|---|---|"]
    for name, result, figure in _figures(results):
        if figure.name in result.missed:
            here = figure.text(result.metrics[figure.name]) + result.interval_text(figure)
            lines.append(f"| {links[name]} | {figure.title} | {here} | {figure.limit_text()} |")
    return "\n".join(lines) + "\n"


def _figures(results: Mapping[str, Result]) -> Iterator[tuple[str, Result, Figure]]:
    """All figures that are in a result, in the order of their pages; "the same" says of what."""
    for name, result in results.items():
        module = import_module(EXPERIMENTS[name].module)
        known = module.FIGURES if hasattr(module, "FIGURES") else module.figures(result.metrics)
        of = ""
        for figure in known:
            same = figure.title.startswith("The same")
            of = of if same else figure.title
            if figure.name in result.metrics:
                title = f"{of}: t{figure.title[1:]}" if same else figure.title
                yield name, result, replace(figure, title=title)
