"""The result page of an experiment in docs/: conclusion and one plot first, then the method, then the tables.

Input: a saved `Result` and the `Page` that its experiment makes from it.  Output: Markdown, result.json and the plots.
No number on a page is typed: a conclusion is a template whose names are metrics.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Final

from rich.console import Console

from experiments.common import overview
from experiments.common.checkpoint import read_published
from experiments.common.registry import EXPERIMENTS, Options
from experiments.common.result import Metric, Result, sealed_seed
from experiments.common.standing import judge, marked

MAX_TITLES: Final = 4
"""Of metrics that are measured alike, on one line."""
_FIELD: Final = re.compile(r"\{(paper:)?([^{}]+)\}")
_RELATIVE: Final = re.compile("The (same|other)|As above|Half of")
"""Begins what tells how a metric is measured by the line before it."""


@dataclass(frozen=True, slots=True)
class Section:
    """A heading of the page: a text, its metrics as a table, and plots (file name, caption)."""

    title: str
    text: str
    metrics: tuple[Metric, ...]
    plots: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Page:
    """The text of a result page.

    ``conclusion``: templates of sentences in which ``{name}`` stands for the value of a metric with its unit, and
    ``{paper:name}`` for the value of the paper.  A sentence with a metric that the result lacks is left out.
    ``setting``: what was measured where, instead of the usual sentence on profile, truth and packages.
    """

    title: str
    conclusion: tuple[str, ...]
    introduction: str
    sections: tuple[Section, ...]
    setting: str = ""
    command: str = ""
    """What repeats the measurement, if not ``timberhand experiment NAME --docs docs``."""

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Those of all sections, in their order."""
        return tuple(m for section in self.sections for m in section.metrics)


def publish(result: Result, page: Page, options: Options, console: Console) -> None:
    """Save the result beside its plots in ``options.out``, print it, and write the docs if requested."""
    if selection := options.selection():
        result = replace(result, environment={**result.environment, "selection": selection})
    result.save(options.out / "result.json")
    show(result, page.sections, console)
    if options.docs is not None:
        write(result, page, options.out, options.docs)


def write(result: Result, page: Page, plots: Path, docs: Path) -> None:
    """Write ``docs/NAME.md``, ``docs/results/NAME.json``, its plots in ``docs/results/NAME``, and the overview page."""
    name = result.experiment
    result.save(docs / "results" / f"{name}.json")
    folder = docs / "results" / name
    folder.mkdir(parents=True, exist_ok=True)
    for section in page.sections:
        for file, _ in section.plots:
            shutil.copyfile(plots / file, folder / file)
    (docs / f"{name}.md").write_text(marked(markdown(result, page), judge(result.commit, EXPERIMENTS[name])))
    overview.write(docs)


def markdown(result: Result, page: Page) -> str:
    """Write the page as Markdown."""
    first = next((plot for section in page.sections for plot in section.plots), None)
    out = [f"# {page.title}", "", conclusion(result, page), ""]
    out += [*_plot(result, *first), ""] if first else []
    numbers = f"[results/{result.experiment}.json](results/{result.experiment}.json) holds all numbers."
    selection = result.environment.get("selection", "")
    default_command = f"timberhand experiment {result.experiment}{selection} --docs docs"
    command = f"`{page.command or default_command}` repeats the measurement."
    out += ["## Method", "", page.introduction, "", f"{page.setting or _setting(result)} {command} {numbers}", ""]
    for section in page.sections:
        out += [f"## {section.title}", ""]
        out += [section.text, ""] if section.text else []
        shown = [result.as_judged(m) for m in section.metrics if m.name in result.metrics]
        out += ["| metric | measured | limit | |", "|---|---|---|---|"] if shown else []
        for m in shown:
            value = m.text(result.metrics[m.name]) + result.interval_text(m)
            paper = f" (paper: {m.text(result.paper[m.name])})" if m.name in result.paper else ""
            out.append(f"| {m.title} | {value}{paper} | {m.limit_text()} | {_state(m, result)} |")
        out += _measured(shown)
        for plot in section.plots:
            out += [*_plot(result, *plot), ""] if plot != first else []
    return "\n".join(out).rstrip() + "\n"


def _measured(metrics: Sequence[Metric]) -> list[str]:
    """Tell how the metrics are measured.  Those that are measured alike share a line, also if others stand between."""
    alike: list[list[Metric]] = []
    for m in metrics:
        known = alike[-1:] if _RELATIVE.match(m.how) else alike
        group = next((group for group in known if group[0].how == m.how), None)
        if group is None:
            alike.append([m])
        else:
            group.append(m)
    lines = [f"- {_titles(group, metrics)}: {group[0].how}" for group in alike if group[0].how]
    return ["", "How each is measured:", "", *lines, ""] if lines else [""] if metrics else []


def _titles(group: Sequence[Metric], metrics: Sequence[Metric]) -> str:
    """List a few titles; of many, say what they share before or after their colon, or name the first and the last."""
    titles = [m.title for m in group]
    if len(titles) <= MAX_TITLES:
        return "; ".join(f"*{title}*" for title in titles)
    before, _, after = map(set, zip(*(title.partition(": ") for title in titles), strict=True))
    if len(before) == 1:
        return f"*{before.pop()}: ...*"
    if len(after) == 1 and after != {""}:
        return f"*...: {after.pop()}*"
    begin = metrics.index(group[0])
    neighbours = list(metrics[begin : begin + len(group)]) == list(group)
    return f"*{titles[0]}* to *{titles[-1]}*" if neighbours else f"*{titles[0]}* and {len(titles) - 1} more"


def conclusion(result: Result, page: Page) -> str:
    """Write the conclusion in one paragraph: the page's sentences, the number of limits met and those that are not."""
    by_name = {m.name: m for m in page.metrics}
    sentences = [_sentence(result, by_name, template) for template in page.conclusion]
    return " ".join(s for s in (*sentences, limits_sentence(result, page.metrics)) if s)


def _sentence(result: Result, metrics: dict[str, Metric], template: str) -> str:
    """Fill the template with its values; return nothing when one of them is missing."""
    for paper, name in _FIELD.findall(template):
        value = (result.paper if paper else result.metrics).get(name, math.nan)
        if name not in metrics or math.isnan(value):
            return ""
    return _FIELD.sub(
        lambda m: metrics[m.group(2)].text((result.paper if m.group(1) else result.metrics)[m.group(2)]), template
    )


def limits_sentence(result: Result, metrics: Iterable[Metric]) -> str:
    """Tell how many limits are met, and every metric that is missed, inconclusive or not measured."""
    total = len(result.limits)
    if not total:
        return ""
    by_name = {m.name: result.as_judged(m) for m in metrics}
    parts = [{1: "The limit is met.", 2: "Both limits are met."}.get(total, f"All {total} limits are met.")]
    if result.met < total:
        parts = [f"{result.met} of {total} limits are met."]
    for word, names in (
        ("Missed", result.missed),
        ("Inconclusive", result.inconclusive),
        ("Not measured", result.unmeasured),
    ):
        named = [by_name[n] for n in names if n in by_name]
        listed = "; ".join(f"{m.title} ({_figure(m, result)}limit {m.limit_text()})" for m in named)
        parts += [f"{word}: {listed}."] if listed else []
    return " ".join(parts)


def _figure(metric: Metric, result: Result) -> str:
    return f"{metric.text(result.metrics[metric.name])}, " if metric.name in result.metrics else ""


def _plot(result: Result, file: str, caption: str) -> tuple[str, ...]:
    return f"![{caption}](results/{result.experiment}/{file})", "", f"*{caption}*"


def _setting(result: Result) -> str:
    e = result.environment
    drawn = " (sealed: drawn from the commit)" if result.seed == sealed_seed(result.commit, result.experiment) else ""
    return (
        f"Profile `{result.profile}`, ground truth `{e.get('truth', '')}`, seed {result.seed}{drawn}, "
        f"{result.trials} {'trial' if result.trials == 1 else 'trials'}, commit `{result.commit}`. "
        f"Host: {e['processor']}, {e['cpus']} cores, {e['machine']}, Python "
        f"{e['python']}, pybullet {e['pybullet']}, numba {e['numba']}."
    )


def _state(metric: Metric, result: Result) -> str:
    if not metric.limit_text():
        return ""
    if metric.name in result.missed:
        return "**missed**"
    return "inconclusive" if metric.name in result.inconclusive else "met"


def show(result: Result, sections: Sequence[Section], console: Console) -> None:
    """Print the metrics as a list."""
    for section in sections:
        shown = [result.as_judged(m) for m in section.metrics if m.name in result.metrics]
        if shown:
            console.print(f"\n[bold]{section.title}[/bold]", highlight=False)
        for m in shown:
            console.print(_line(m, result), highlight=False, soft_wrap=True)


def _line(metric: Metric, result: Result) -> str:
    mark = "[dim]·[/dim]" if not metric.limit_text() else "[green]✔[/green]"
    if metric.name in result.missed:
        mark = "[red]✘[/red]"
    elif metric.name in result.inconclusive:
        mark = "[yellow]?[/yellow]"
    interval = result.interval_text(metric)
    limit = f"[dim]({metric.limit_text()})[/dim]" if metric.limit_text() else ""
    note = " [yellow]inconclusive[/yellow]" if metric.name in result.inconclusive else ""
    return f"{mark} {metric.title}: {metric.text(result.metrics[metric.name])}{interval} {limit}{note}"


def rewrite(docs: Path) -> list[Path]:
    """Write every ``docs/NAME.md`` that exists from ``docs/results``, and the overview page; returns their paths.

    Measurements, plots and the commit that a page names stay as they are.  Where all outcomes are published, they are
    read again by the criteria of today.

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
