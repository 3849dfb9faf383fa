"""The overview page and the result pages: they agree with the saved results."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

from experiments.common.overview import compared, page, read, summary
from experiments.common.published import COMPARISONS
from experiments.common.registry import EXPERIMENTS, Options
from experiments.common.result_page import Page, conclusion, markdown
from experiments.common.standing import Standing
from tests.codes import numbers_in

DOCS = Path(__file__).parents[2] / "docs"


NAVIGATION = read(DOCS / "results" / "navigation.json")
PAGE = import_module(EXPERIMENTS["navigation"].module).page_of(NAVIGATION, {})


def row_of(text: str) -> list[list[float]]:
    """The numbers in the cells of the experiment's row of the overview."""
    (row,) = [line for line in text.split("## ")[0].splitlines() if line.startswith("| [nav")]
    return [numbers_in(cell) for cell in row.split("|")]


def test_missed_and_inconclusive_limits_are_not_met_and_paper_values_are_shown() -> None:
    broken = {**NAVIGATION.metrics, "lateral_p95_m": 0.5, "stop_max_m": float("nan")}
    bad = replace(NAVIGATION, metrics=broken, missed=("lateral_p95_m",), inconclusive=("stops",))
    text = page({"navigation": bad}, (), {"navigation": Standing.STALE})
    limits = len(NAVIGATION.limits)
    assert [limits - 2, limits, 1] in row_of(text)
    _, papers, later, missed, _ = text.split("## ")
    assert "9 deg/m" in papers and "50 cm" not in papers
    assert "50 cm" in missed and 8 in numbers_in(missed) and missed.count("\n| [") == 1
    assert "| [" not in later, "without our figure there is nothing to compare with"
    ((_, (*_, kept, _, _)),) = compared({"navigation": replace(NAVIGATION, missed=())})
    ((_, (*_, worse, _, _)),) = compared({"navigation": replace(NAVIGATION, missed=("heading_deg_per_m",))})
    assert worse != kept and numbers_in(worse) == numbers_in(kept), "and so it is said beside the paper's"


def test_without_saved_results_the_overview_says_so() -> None:
    """`report --docs` with an empty folder ended in a traceback."""
    text = page({}, (), {})
    assert summary({}, {}) in text and not numbers_in(summary({}, {})) and "\n| [" not in text


def test_a_limit_without_a_figure_is_not_met_and_its_sentence_is_left_out() -> None:
    figures = {name: value for name, value in NAVIGATION.metrics.items() if name != "lateral_p95_m"}
    without = replace(NAVIGATION, metrics=figures)
    assert without.unmeasured == ("lateral_p95_m",) and without.met == NAVIGATION.met - 1
    lateral = f"{100.0 * NAVIGATION.metrics['lateral_p95_m']:.4g} cm"
    whole, shown = conclusion(NAVIGATION, PAGE), conclusion(without, PAGE)
    assert lateral in whole and lateral not in shown
    assert "6 of 7" in shown and "Not measured" in shown and "Not measured" not in whole
    assert [6, 7, 1] in row_of(page({"navigation": without}, (), {"navigation": Standing.CURRENT}))


def test_a_paper_s_figure_stands_beside_its_method_here_ours_under_its_rules_and_ours_with_everything() -> None:
    results = {n: read(DOCS / "results" / f"{n}.json") for n in ("grasp-configs", "forwarding-mission")}
    metrics = results["forwarding-mission"].metrics
    rows = {entry.paper_metric: cells for entry, cells in compared(results)}
    assert set(rows) == {"paper60_success", "optimal", "loaded", "detected", "grasp_offset_mean_m"}
    question, paper, method, rules, everything = rows["loaded"]
    assert question and numbers_in(paper) == [87.5, 69.0, 95.7, 24], "Wilson's interval of 21 of 24"
    for cell, name in ((method, "faithful.loaded"), (rules, "first.loaded"), (everything, "loaded")):
        shown = numbers_in(cell)
        assert shown[0] == pytest.approx(100.0 * metrics[name], abs=0.01) and shown[-1] == metrics[f"{name}_n"]
    assert not numbers_in(rows["optimal"][4]), "not measured so"


def test_the_command_on_a_page_selects_the_trials_that_were_measured() -> None:
    assert Options(1, "nominal", "palms_471", Path()).selection() == ""
    said = Options(7, "nominal", "palms_471", Path(), trials=30, quick=True).selection()
    assert said == " --seed 7 --trials 30 --quick"
    result = read(DOCS / "results" / "grasp-configs.json")
    shown = markdown(replace(result, environment=result.environment | {"selection": said}), Page("", (), "", ()))
    assert "`timberhand experiment grasp-configs --seed 7 --trials 30 --quick --docs docs`" in shown


def test_every_comparison_names_metrics_that_its_experiment_has_and_limits_ours() -> None:
    for entry in COMPARISONS:
        module = import_module(EXPERIMENTS[entry.experiment].module)
        result = read(DOCS / "results" / f"{entry.experiment}.json")
        metrics = {metric.name: metric for metric in module.page_of(result, {}).metrics}
        ours = {entry.method, entry.rules, entry.everything} - {""}
        assert ours | {entry.paper_metric} <= set(metrics), entry.question
        assert all(metrics[name].limit_text() for name in ours), entry.question
