"""The page of all experiments, ``docs/results.md``: questions, limits, and comparison with the papers.

Input: the saved results in ``docs/results``.  It is written whenever one of them is refreshed; nothing is measured.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Final

import msgspec

from experiments.common.published import COMPARISONS, LATER, UNSEEN, Comparison
from experiments.common.registry import EXPERIMENTS
from experiments.common.result import Metric, Result, wilson
from experiments.common.standing import Standing, judge

TITLE: Final = "Results at a glance"
INTRODUCTION: Final = (
    "This page lists every experiment, the question it answers, and how many of its limits are met. A limit stands "
    "in the code that measures; where all outcomes of a run are published, they are evaluated anew by the limits of "
    "today. Each linked page states how every metric is measured, with which command and on which machine. "
    "`timberhand report` writes this page from the saved results; `timberhand report --check` names the files that "
    "make a result stale."
)


COLUMNS: Final = ("", "the paper", "its method here", "ours, its rules", "ours, everything")
"""Columns of a comparison: the question, and four answers."""
LIKE_FOR_LIKE: Final = (
    "The paper's own figure (paper A's grasps in its simulator, all others on a real machine), its method rebuilt "
    "here, our method under the paper's rules, and ours with everything that it has. A dash: not measured; *missed*: "
    "outside its limit. Rates have 95 % intervals and their number of trials; an interval takes the trials for "
    "independent, which logs of one mission and attempts of one machine are not."
)


def write(docs: Path) -> Path:
    """Write ``results.md`` from ``results/*.json`` in the folder; returns its path."""
    path = docs / "results.md"
    results = results_in(docs)
    standings = {name: judge(result.commit, EXPERIMENTS[name]).standing for name, result in results.items()}
    path.write_text(page(results, {p.stem for p in docs.glob("*.md")}, standings))
    return path


def results_in(docs: Path) -> dict[str, Result]:
    """Read the saved results of the folder by name, in the order of the registry."""
    paths = {name: docs / "results" / f"{name}.json" for name in EXPERIMENTS}
    return {name: read(path) for name, path in paths.items() if path.exists()}


def read(path: Path) -> Result:
    """Read a saved result; a metric without a number is NaN, and "inf" is infinite.

    Raises:
        ValueError: the file is not a result.
    """
    try:
        document = msgspec.json.decode(path.read_bytes())
        document["metrics"] = {k: float("nan" if v is None else v) for k, v in document["metrics"].items()}
        return msgspec.convert(document, Result)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no result ({type(error).__name__}: {error})") from None


def page(results: Mapping[str, Result], pages: Collection[str], standings: Mapping[str, Standing]) -> str:
    """Write the page as Markdown; an experiment without one of the ``pages`` is linked to its numbers."""
    links = {n: f"[{n}]({f'{n}.md' if n in pages else f'results/{n}.json'})" for n in results}
    lines = [f"# {TITLE}", "", summary(results, standings), "", INTRODUCTION, ""]
    lines += ["| experiment | question | limits met | commit | |", "|---|---|---|---|---|"]
    for name, result in results.items():
        open_limits = ((result.inconclusive, "inconclusive"), (result.unmeasured, "not measured"))
        unsure = "".join(f", {len(names)} {word}" for names, word in open_limits if names)
        lines.append(
            f"| {links[name]} | {EXPERIMENTS[name].sentence} | {result.met} of {len(result.limits)}{unsure} "
            f"| `{result.commit}` | {standings[name]} |"
        )
    lines += ["", "## Compared with the papers", "", LIKE_FOR_LIKE, ""]
    lines += [f"| {' | '.join((*COLUMNS, 'what differs', 'command'))} |", "|---" * (len(COLUMNS) + 2) + "|"]
    for entry, cells in compared(results):
        lines.append(f"| {' | '.join((*cells, entry.differs, _command(entry.experiment)))} |")
    lines += ["", *_later(results, links)]
    lines += ["", "## Missed limits", "", "| | metric | measured | limit |", "|---|---|---|---|"]
    for name, result, metric in metrics_of(results):
        if metric.name in result.missed:
            lines.append(f"| {links[name]} | {metric.title} | {_here(result, metric)} | {metric.limit_text()} |")
    lines += ["", "## What a plant cannot show", "", *(f"- {sentence}" for sentence in UNSEEN)]
    return "\n".join(lines) + "\n"


def compared(results: Mapping[str, Result]) -> Iterator[tuple[Comparison, tuple[str, ...]]]:
    """List the comparisons with papers A and B to which there is a result, each with its cells of `COLUMNS`."""
    metrics = {(name, metric.name): metric for name, _, metric in metrics_of(results)}
    for entry in COMPARISONS:
        result = results.get(entry.experiment)
        paper_metric = metrics.get((entry.experiment, entry.paper_metric))
        if result is None or paper_metric is None or entry.paper_metric not in result.paper:
            continue
        value = result.paper[entry.paper_metric]
        paper = f"{paper_metric.text(value)} (paper {entry.paper}{_interval(value, entry.trials)})"
        method, *ours = (
            "–" if metric is None else _judged(result, metric)
            for metric in (metrics.get((entry.experiment, n)) for n in (entry.method, entry.rules, entry.everything))
        )
        yield entry, (entry.question, paper, method, *ours)


def _interval(value: float, trials: int) -> str:
    if not trials:
        return ""
    low, high = wilson(round(value * trials), trials)
    return f", {100.0 * low:.1f} to {100.0 * high:.1f}, n = {trials}"


def _here(result: Result, metric: Metric) -> str:
    return metric.text(result.metrics[metric.name]) + result.interval_text(metric)


def _judged(result: Result, metric: Metric) -> str:
    """Write a figure, and after it that it misses its limit."""
    return _here(result, metric) + (", *missed*" if metric.name in result.missed else "")


def _command(name: str) -> str:
    return f"`timberhand experiment {name} --docs docs`"


def _later(results: Mapping[str, Result], links: Mapping[str, str]) -> list[str]:
    """Write the section on later published systems, with our figure that comes nearest to each."""
    by_name = {(name, metric.name): metric for name, _, metric in metrics_of(results)}
    lines = [
        "## Later published systems",
        "",
        "Settings differ, so a row compares questions, not machines. Here everything runs on the bus through "
        "controller and guard, with our own detector and depth camera. `timberhand experiment grasp-configs --planner "
        "NAME` compares another method with ours on the same scenes ([campaigns](how-to/campaigns.md)).",
        "",
        "| system | setting | measure | published | nearest here | command |",
        "|---|---|---|---|---|---|",
    ]
    for entry in LATER:
        name, metric = entry.nearest[0], by_name.get(entry.nearest)
        if metric is not None:
            figure = f"{links[name]}: {metric.title}, {_here(results[name], metric)}"
            lines.append(
                f"| [{entry.system}]({entry.source}) | {entry.setting} | {entry.measure} | {entry.text()} | {figure} "
                f"| {_command(name)} |"
            )
    return [*lines, ""]


def summary(results: Mapping[str, Result], standings: Mapping[str, Standing]) -> str:
    """Tell how many limits all experiments set, meet and miss, and how many results are of today's sources."""
    if not results:
        return "No experiment has a saved result."
    judged = [(len(r.limits), r.met, len(r.missed), len(r.inconclusive), len(r.unmeasured)) for r in results.values()]
    total, met, missed, unsure, unmeasured = map(sum, zip(*judged, strict=True))
    return (
        f"{len(results)} experiments set {total} limits: {met} are met, {missed} are missed, {unsure} are inconclusive "
        f"and {unmeasured} are not measured. {_currency(standings)}"
    )


def _currency(standings: Mapping[str, Standing]) -> str:
    """Tell how many results are of today's sources."""
    old, unsure = (sum(s is each for s in standings.values()) for each in (Standing.STALE, Standing.UNVERIFIABLE))
    if not old and not unsure:
        return "All results are of the present sources."
    return (
        f"Current results: {len(standings) - old - unsure} of {len(standings)}; stale, because their sources have "
        f"changed since: {old}; unverifiable, because their commit is not in the history or had changes: {unsure}."
    )


def metrics_of(results: Mapping[str, Result]) -> Iterator[tuple[str, Result, Metric]]:
    """List all metrics that are in a result, in the order of their pages."""
    for name, result in results.items():
        module = import_module(EXPERIMENTS[name].module)
        for metric in module.page_of(result, {}).metrics:
            if metric.name in result.metrics:
                yield name, result, result.as_judged(metric)
