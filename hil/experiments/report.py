"""The page of an experiment in docs/: written from its result and pictures, never by hand."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from hil.experiments.result import Figure, Result


class Section(Protocol):
    """A heading of the page."""

    @property
    def title(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def figures(self) -> tuple[Figure, ...]: ...
    @property
    def pictures(self) -> tuple[tuple[str, str], ...]: ...


def refresh(
    result: Result, title: str, introduction: str, sections: Sequence[Section], pictures: Path, docs: Path
) -> None:
    """Write ``docs/NAME.md``, ``docs/results/NAME.json`` and the pictures beside it in ``docs/results/NAME``."""
    name = result.experiment
    result.save(docs / "results" / f"{name}.json")
    folder = docs / "results" / name
    folder.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for file, _ in section.pictures:
            shutil.copyfile(pictures / file, folder / file)
    (docs / f"{name}.md").write_text(page(result, title, introduction, sections))


def page(result: Result, title: str, introduction: str, sections: Sequence[Section]) -> str:
    """The page as Markdown."""
    e = result.environment
    out = [
        f"# {title}",
        "",
        introduction,
        "",
        f"Profile `{result.profile}`, truth `{e.get('truth', '')}`, seed {result.seed}, {result.trials} trials of each "
        f"kind, commit `{result.commit}`. Host: {e['processor']}, {e['cpus']} cores, {e['machine']}, Python "
        f"{e['python']}, pybullet {e['pybullet']}, numba {e['numba']}. All numbers, with the ones that have no row "
        f"here: [results/{result.experiment}.json](results/{result.experiment}.json).",
        "",
    ]
    for section in sections:
        out += [f"## {section.title}", "", section.text, "", "| what | measured | limit | |", "|---|---|---|---|"]
        shown = [f for f in section.figures if f.name in result.metrics]
        for f in shown:
            value = f.text(result.metrics[f.name]) + result.interval_text(f)
            paper = f" (paper: {f.text(result.paper[f.name])})" if f.name in result.paper else ""
            out.append(f"| {f.title} | {value}{paper} | {f.limit_text()} | {_verdict(f, result)} |")
        out += ["", "How:", ""]
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
