"""The page of all experiments at a glance: as the saved results have it, and what it says of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from experiments.common.overview import page, read, results_in, write
from experiments.common.registry import EXPERIMENTS

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_is_as_the_results_have_it(tmp_path: Path) -> None:
    pages = {p.stem for p in DOCS.glob("*.md")}
    assert (DOCS / "figures.md").read_text() == page(results_in(DOCS), pages), "overview.write(Path('docs')) writes it"


def test_it_is_written_from_a_folder_and_links_to_what_is_there(tmp_path: Path) -> None:
    result = read(DOCS / "results" / "navigation.json")
    result.save(tmp_path / "results" / "navigation.json")
    assert "[navigation](results/navigation.json)" in write(tmp_path).read_text()
    (tmp_path / "navigation.md").touch()
    text = write(tmp_path).read_text()
    assert "[navigation](navigation.md)" in text and EXPERIMENTS["navigation"].sentence in text
    assert all(f"[{name}]" not in text for name in EXPERIMENTS if name != "navigation")


def test_what_is_missed_or_unsure_is_not_held_and_what_the_paper_has_stands_beside_it() -> None:
    result = read(DOCS / "results" / "navigation.json")
    broken = {**result.metrics, "lateral_p95_m": 0.5, "stop_max_m": float("nan")}
    text = page({"navigation": replace(result, metrics=broken, missed=("lateral_p95_m",), inconclusive=("stops",))}, ())
    asks, papers, missed = text.split("## ")
    assert f"| {len(result.limits) - 2} of {len(result.limits)}, 1 inconclusive |" in asks
    assert "9 deg/m" in papers and "50 cm" not in papers
    assert "50 cm" in missed and "at most 8" in missed and missed.count("\n| [") == 1
