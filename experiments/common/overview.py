"""The page of all experiments, ``docs/results.md``: questions, limits, and comparison with the papers.

Input: the saved results in ``docs/results``.  It is written whenever one of them is refreshed; nothing is measured.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Final

import msgspec

from experiments.common.registry import EXPERIMENTS
from experiments.common.result import Metric, Result

TITLE: Final = "Results at a glance"
INTRODUCTION: Final = (
    "This page lists every experiment, the question it answers, and how many of its limits are met. The limits were "
    "set before the measurement. Each linked page states how every metric is measured, with which command and on which "
    "machine. `timberhand report` writes this page from the saved results."
)


def write(docs: Path) -> Path:
    """Write ``results.md`` from ``results/*.json`` in the folder; returns its path."""
    path = docs / "results.md"
    path.write_text(page(results_in(docs), {p.stem for p in docs.glob("*.md")}))
    return path


def results_in(docs: Path) -> dict[str, Result]:
    """The saved results of the folder by name, in the order of the registry."""
    paths = {name: docs / "results" / f"{name}.json" for name in EXPERIMENTS}
    return {name: read(path) for name, path in paths.items() if path.exists()}


def read(path: Path) -> Result:
    """A saved result; a metric without a number is NaN.

    Raises:
        ValueError: the file is not a result.
    """
    document = msgspec.json.decode(path.read_bytes())
    document["metrics"] = {k: float("nan") if v is None else v for k, v in document["metrics"].items()}
    return msgspec.convert(document, Result)


def page(results: Mapping[str, Result], pages: Collection[str]) -> str:
    """The page as Markdown; an experiment without one of the ``pages`` is linked to its numbers."""
    links = {n: f"[{n}]({f'{n}.md' if n in pages else f'results/{n}.json'})" for n in results}
    lines = [f"# {TITLE}", "", _conclusion(results), "", INTRODUCTION, ""]
    lines += ["| experiment | question | limits met | commit |", "|---|---|---|---|"]
    for name, result in results.items():
        met = len(result.limits) - len(result.missed) - len(result.inconclusive)
        unsure = f", {len(result.inconclusive)} inconclusive" if result.inconclusive else ""
        lines.append(
            f"| {links[name]} | {EXPERIMENTS[name].sentence} | {met} of {len(result.limits)}{unsure} "
            f"| `{result.commit}` |"
        )
    lines += ["", "## Compared with the papers", "", "| | metric | paper | here |", "|---|---|---|---|"]
    for name, result, metric in metrics_of(results):
        if metric.name in result.paper:
            here = metric.text(result.metrics[metric.name]) + result.interval_text(metric)
            lines.append(f"| {links[name]} | {metric.title} | {metric.text(result.paper[metric.name])} | {here} |")
    lines += ["", "## Missed limits", "", "| | metric | measured | limit |", "|---|---|---|---|"]
    for name, result, metric in metrics_of(results):
        if metric.name in result.missed:
            here = metric.text(result.metrics[metric.name]) + result.interval_text(metric)
            lines.append(f"| {links[name]} | {metric.title} | {here} | {metric.limit_text()} |")
    return "\n".join(lines) + "\n"


def _conclusion(results: Mapping[str, Result]) -> str:
    total = sum(len(r.limits) for r in results.values())
    missed = sum(len(r.missed) for r in results.values())
    unsure = sum(len(r.inconclusive) for r in results.values())
    return (
        f"{len(results)} experiments set {total} limits: {total - missed - unsure} are met, {missed} are missed and "
        f"{unsure} are inconclusive."
    )


def metrics_of(results: Mapping[str, Result]) -> Iterator[tuple[str, Result, Metric]]:
    """All metrics that are in a result, in the order of their pages."""
    for name, result in results.items():
        module = import_module(EXPERIMENTS[name].module)
        for metric in module.page_of(result, {}).metrics:
            if metric.name in result.metrics:
                yield name, result, result.as_judged(metric)
