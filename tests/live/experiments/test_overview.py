"""The overview page and the result pages: they agree with the saved results."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest

from experiments.common.overview import page, read, results_in, write
from experiments.common.registry import EXPERIMENTS
from experiments.common.result_page import rewrite
from experiments.common.standing import Standing, has_history, judge
from experiments.loop_design import page as loop_design

DOCS = Path(__file__).parents[3] / "docs"
needs_history = pytest.mark.skipif(not has_history(), reason="the checkout has no git history, or a part of it only")


def standings(names: Iterable[str]) -> dict[str, Standing]:
    results = results_in(DOCS)
    return {name: judge(results[name].commit, EXPERIMENTS[name]).standing for name in names}


@needs_history
def test_the_committed_overview_is_that_of_the_saved_results() -> None:
    pages, results = {p.stem for p in DOCS.glob("*.md")}, results_in(DOCS)
    assert (DOCS / "results.md").read_text() == page(results, pages, standings(results)), "timberhand report writes it"


def test_the_overview_links_to_the_pages_that_exist(tmp_path: Path) -> None:
    result = read(DOCS / "results" / "navigation.json")
    result.save(tmp_path / "results" / "navigation.json")
    assert "[navigation](results/navigation.json)" in write(tmp_path).read_text()
    (tmp_path / "navigation.md").touch()
    text = write(tmp_path).read_text()
    assert "[navigation](navigation.md)" in text and EXPERIMENTS["navigation"].sentence in text
    assert all(f"[{name}]" not in text for name in EXPERIMENTS if name != "navigation")


@needs_history
def test_the_committed_pages_are_those_of_the_saved_results(tmp_path: Path) -> None:
    shutil.copytree(DOCS / "results", tmp_path / "results", ignore=shutil.ignore_patterns("*.png"))
    pages = [p for p in DOCS.glob("*.md") if (DOCS / "results" / f"{p.stem}.json").exists()]
    for page_path in pages:
        (tmp_path / page_path.name).touch()
    rewrite(tmp_path)
    loop_design.rewrite(tmp_path)
    assert len(pages) > 12
    different = [p.name for p in pages if p.read_text() != (tmp_path / p.name).read_text()]
    assert not different, "timberhand report writes them"
