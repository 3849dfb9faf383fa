"""The overview page and the result pages: they agree with the saved results."""

from __future__ import annotations

import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from experiments.common.overview import page, read, results_in, write
from experiments.common.pages import rewrite
from experiments.common.registry import EXPERIMENTS
from experiments.common.result_page import conclusion
from experiments.loop_design import page as loop_design

DOCS = Path(__file__).parents[2] / "docs"


def test_the_committed_overview_is_that_of_the_saved_results() -> None:
    pages = {p.stem for p in DOCS.glob("*.md")}
    assert (DOCS / "results.md").read_text() == page(results_in(DOCS), pages), "timberhand report writes it"


def test_the_overview_links_to_the_pages_that_exist(tmp_path: Path) -> None:
    result = read(DOCS / "results" / "navigation.json")
    result.save(tmp_path / "results" / "navigation.json")
    assert "[navigation](results/navigation.json)" in write(tmp_path).read_text()
    (tmp_path / "navigation.md").touch()
    text = write(tmp_path).read_text()
    assert "[navigation](navigation.md)" in text and EXPERIMENTS["navigation"].sentence in text
    assert all(f"[{name}]" not in text for name in EXPERIMENTS if name != "navigation")


def test_missed_and_inconclusive_limits_are_not_met_and_paper_values_are_shown() -> None:
    result = read(DOCS / "results" / "navigation.json")
    broken = {**result.metrics, "lateral_p95_m": 0.5, "stop_max_m": float("nan")}
    text = page({"navigation": replace(result, metrics=broken, missed=("lateral_p95_m",), inconclusive=("stops",))}, ())
    asks, papers, missed = text.split("## ")
    assert f"| {len(result.limits) - 2} of {len(result.limits)}, 1 inconclusive |" in asks
    assert "9 deg/m" in papers and "50 cm" not in papers
    assert "50 cm" in missed and "at most 8" in missed and missed.count("\n| [") == 1


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


def test_a_conclusion_leaves_out_a_sentence_without_a_value() -> None:
    result = read(DOCS / "results" / "navigation.json")
    module = import_module(EXPERIMENTS["navigation"].module)
    shown = conclusion(result, module.page_of(result, {}))
    assert "1.851 cm" in shown and "All 7 limits are met." in shown
    without = replace(result, metrics={k: v for k, v in result.metrics.items() if k != "lateral_p95_m"})
    assert "1.851 cm" not in conclusion(without, module.page_of(without, {}))
