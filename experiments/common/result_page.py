"""The page of an experiment in docs/: written from its result and pictures, never by hand."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from experiments.common import overview
from experiments.common.registry import Options
from experiments.common.result import Figure, Result


@dataclass(frozen=True, slots=True)
class Section:
    """A heading of the page: an introduction, its figures, and pictures (file name, caption)."""

    title: str
    text: str
    figures: tuple[Figure, ...]
    pictures: tuple[tuple[str, str], ...] = ()


def tell(
    result: Result,
    title: str,
    introduction: str,
    sections: Sequence[Section],
    options: Options,
    console: Console,
    setting: str | None = None,
) -> None:
    """Save the result beside its pictures in ``options.out``, show it, and refresh the docs when asked."""
    result.save(options.out / "result.json")
    show(result, sections, console)
    if options.docs is not None:
        refresh(result, title, introduction, sections, options.out, options.docs, setting)


def refresh(
    result: Result,
    title: str,
    introduction: str,
    sections: Sequence[Section],
    pictures: Path,
    docs: Path,
    setting: str | None = None,
) -> None:
    """Write ``docs/NAME.md``, ``docs/results/NAME.json``, the pictures beside it in ``docs/results/NAME``, and the page
    of all experiments anew.

    ``setting`` says what was measured where, in place of the usual sentence on profile, truth and packages.
    """
    name = result.experiment
    result.save(docs / "results" / f"{name}.json")
    folder = docs / "results" / name
    folder.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for file, _ in section.pictures:
            shutil.copyfile(pictures / file, folder / file)
    (docs / f"{name}.md").write_text(page(result, title, introduction, sections, setting))
    overview.write(docs)


def _setting(result: Result) -> str:
    e = result.environment
    return (
        f"Profile `{result.profile}`, truth `{e.get('truth', '')}`, seed {result.seed}, {result.trials} trials of each "
        f"kind, commit `{result.commit}`. Host: {e['processor']}, {e['cpus']} cores, {e['machine']}, Python "
        f"{e['python']}, pybullet {e['pybullet']}, numba {e['numba']}."
    )


def page(result: Result, title: str, introduction: str, sections: Sequence[Section], setting: str | None = None) -> str:
    """The page as Markdown."""
    numbers = (
        "All numbers, with the ones that have no row "
        f"here: [results/{result.experiment}.json](results/{result.experiment}.json)."
    )
    out = [f"# {title}", "", introduction, "", f"{setting or _setting(result)} {numbers}", ""]
    for section in sections:
        out += [f"## {section.title}", "", section.text]
        shown = [f for f in section.figures if f.name in result.metrics]
        out += ["", "| what | measured | limit | |", "|---|---|---|---|"] if shown else []
        for f in shown:
            value = f.text(result.metrics[f.name]) + result.interval_text(f)
            paper = f" (paper: {f.text(result.paper[f.name])})" if f.name in result.paper else ""
            out.append(f"| {f.title} | {value}{paper} | {f.limit_text()} | {_verdict(f, result)} |")
        out += ["", "How:", ""] if shown else []
        out += [f"- *{f.title}.* {f.how}" for f in shown]
        for file, caption in section.pictures:
            out += ["", f"![{caption}](results/{result.experiment}/{file})", "", f"*{caption}*"]
        out.append("")
    return "\n".join(out).rstrip() + "\n"


def _verdict(figure: Figure, result: Result) -> str:
    if not figure.limit_text():
        return ""
    if figure.name in result.missed:
        return "**missed**"
    return "inconclusive" if figure.name in result.inconclusive else "reached"


def show(result: Result, sections: Sequence[Section], console: Console) -> None:
    """The figures as a list for a person."""
    for section in sections:
        shown = [f for f in section.figures if f.name in result.metrics]
        if shown:
            console.print(f"\n[bold]{section.title}[/bold]", highlight=False)
        for f in shown:
            console.print(_line(f, result), highlight=False, soft_wrap=True)


def _line(f: Figure, result: Result) -> str:
    mark = "[dim]·[/dim]" if not f.limit_text() else "[green]✔[/green]"
    if f.name in result.missed:
        mark = "[red]✘[/red]"
    elif f.name in result.inconclusive:
        mark = "[yellow]?[/yellow]"
    interval = result.interval_text(f)
    limit = f"[dim]({f.limit_text()})[/dim]" if f.limit_text() else ""
    note = " [yellow]inconclusive: this run cannot tell[/yellow]" if f.name in result.inconclusive else ""
    return f"{mark} {f.title}: {f.text(result.metrics[f.name])}{interval} {limit}{note}"
