"""Shared parts of the experiments: metrics and limits, Wilson intervals, the pool with its checkpoint, the page."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.common import pool
from experiments.common.checkpoint import ALL_SOURCES, SOURCES, read_published, source_hash
from experiments.common.overview import read
from experiments.common.pool import Checkpoint, Job
from experiments.common.registry import Options
from experiments.common.result import ROOT, Metric, Result, evaluate, limits_of, rate, wilson
from experiments.common.result_page import Page, Section, markdown
from experiments.common.trials import LOCKSTEP_SOURCES, check_truth, checkpoint
from experiments.common.workers import Workers
from experiments.plant.runs import ringing
from host.exit_codes import CommandFailed
from tests.codes import numbers_in

QUIET = Console(quiet=True)
SPEED = Metric("speed", "How fast", "m/s", "With a watch.", least=2.0, clocked=True)
SHARE = Metric("share", "How often", "%", "By counting.", most=0.02)


def square(job: Job) -> dict[str, int]:
    """A trial."""
    return {"square": job.seed**2, "process": os.getpid()}


def interrupted(job: Job) -> dict[str, int]:
    """A trial interrupted by Ctrl-C."""
    if job.seed == 3:
        raise KeyboardInterrupt
    return square(job)


def failing(job: Job) -> None:
    """A trial with a defect."""
    raise ZeroDivisionError


def jobs(n: int) -> list[Job]:
    return [Job(f"square/{i}", "square", i, {}) for i in range(n)]


@pytest.mark.parametrize(
    ("name", "unit", "factor"),
    [
        ("rest_m_max", "mm", 1e3),
        ("deg0.median_m", "cm", 100.0),
        ("rest_mm", "mm", 1.0),
        ("swing_rad", "deg", math.degrees(1.0)),
        ("swing_deg", "deg", 1.0),
        ("share", "%", 100.0),
        ("mean_s", "min", 1 / 60),
        ("mean_s", "s", 1.0),
    ],
)
def test_a_number_is_printed_in_its_unit_by_the_unit_in_its_name(name, unit, factor):
    assert Metric(name, "", unit).factor == factor
    assert Metric(name, "", unit, scale=7.0).factor == 7.0


def test_wilson_agrees_with_published_values():
    assert wilson(39, 40) == pytest.approx((0.871, 0.996), abs=1e-3)
    assert wilson(0, 20) == pytest.approx((0.0, 0.161), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


@given(st.integers(1, 500), st.data())
def test_a_wilson_interval_holds_the_rate(n, data):
    hits = data.draw(st.integers(0, n))
    low, high = wilson(hits, n)
    assert 0.0 <= low <= hits / n + 1e-12 and hits / n - 1e-12 <= high <= 1.0


def test_metrics_are_compared_with_their_limits():
    definitions = (SPEED, SHARE)
    assert evaluate(definitions, {"speed": 2.0, "share": 0.02}, noisy=False) == ((), ())
    assert evaluate(definitions, {"speed": 1.9, "share": 0.03}, noisy=False) == (("speed", "share"), ())
    assert evaluate(definitions, {"speed": math.nan}, noisy=False) == (("speed",), ())


def test_a_noisy_host_leaves_only_clocked_metrics_inconclusive():
    assert evaluate((SPEED, SHARE), {"speed": 1.9, "share": 0.03}, noisy=True) == (("share",), ("speed",))


def test_no_trials_make_no_rate():
    assert math.isnan(rate("share", 0, 0)["share"])


def test_an_interrupted_run_continues_where_it_stopped(tmp_path):
    path = tmp_path / "trials.jsonl"
    with pytest.raises(KeyboardInterrupt), Checkpoint(path, "run") as checkpoint:
        pool.run(interrupted, jobs(6), checkpoint, Workers(), "trials", QUIET)
    path.write_text(path.read_text() + '["square/5", {"squ')  # cut off while writing
    ran = []
    with Checkpoint(path, "run") as again:
        assert sorted(again.done) == ["square/0", "square/1", "square/2"]
        outcomes = pool.run(lambda job: ran.append(job.seed) or square(job), jobs(6), again, Workers(), "trials", QUIET)
    assert ran == [3, 4, 5] and [o["square"] for o in outcomes.values()] == [0, 1, 4, 9, 16, 25]
    assert not path.exists()


def test_a_checkpoint_of_another_run_is_ignored(tmp_path):
    path = tmp_path / "trials.jsonl"
    first = Checkpoint(path, "one")
    first.add("square/0", 0)
    first.close()
    assert Checkpoint(path, "one").done == {"square/0": 0}
    assert Checkpoint(path, "two").done == {}


def test_a_run_continues_from_published_trials_if_it_has_no_checkpoint(tmp_path):
    path, published = tmp_path / "run" / "trials.jsonl", tmp_path / "docs" / "trials.jsonl.xz"
    with Checkpoint(path, "run", published) as checkpoint:
        checkpoint.add("square/0", 0)
        checkpoint.publish()
    assert not path.exists() and published.exists()
    assert Checkpoint(tmp_path / "other.jsonl", "another", published).done == {}
    again = Checkpoint(path, "run", published)
    assert again.done == {"square/0": 0}
    again.add("square/1", 1)
    again.close()
    assert Checkpoint(path, "run", published).done == {"square/0": 0, "square/1": 1}
    published.write_bytes(b"no xz")
    assert Checkpoint(tmp_path / "third.jsonl", "run", published).done == {}


def test_an_interrupted_run_goes_on_in_another_checkout(tmp_path):
    docs = tmp_path / "docs" / "trials.jsonl.xz"
    with pytest.raises(KeyboardInterrupt), Checkpoint(tmp_path / "one.jsonl", "run", docs) as checkpoint:
        checkpoint.add("square/0", 0)
        raise KeyboardInterrupt
    assert not docs.exists()
    with Checkpoint(tmp_path / "two.jsonl", "run", docs) as checkpoint:
        assert checkpoint.done == {"square/0": 0}
        checkpoint.add("square/1", 1)
        checkpoint.publish()
    assert read_published(docs) == {"square/0": 0, "square/1": 1}
    assert list(docs.parent.iterdir()) == [docs]


def test_a_run_with_another_truth_starts_anew(tmp_path):
    truth = tmp_path / "truth.toml"
    truth.write_text("a = 1")
    options = Options(seed=1, truth=str(truth), profile="palms_471", out=tmp_path / "run")

    def begun() -> Checkpoint:
        return checkpoint(options, jobs(2), ["palms_471"], options.truth)

    first = begun()
    first.add("square/0", 0)
    first.close()
    assert begun().done == {"square/0": 0}
    truth.write_text("a = 2")
    assert begun().done == {}


def test_an_unusable_truth_stops_before_any_trial(tmp_path):
    with pytest.raises(CommandFailed) as caught:
        check_truth("palms_471", str(tmp_path / "none.toml"))
    assert "none.toml" in str(caught.value)


def test_an_error_names_the_trial(tmp_path):
    checkpoint = Checkpoint(tmp_path / "trials.jsonl", "run")
    with pytest.raises(ZeroDivisionError) as caught:
        pool.run(failing, jobs(1), checkpoint, Workers(), "trials", QUIET)
    assert "in trial square/0" in caught.value.__notes__


@given(st.floats(0.4, 5.0), st.floats(0.005, 0.15))
def test_a_known_oscillation_is_read_back(hz, zeta):
    w = 2.0 * math.pi * hz
    seen = ringing(
        [0.3 + math.exp(-zeta * w * t) * math.cos(w * t) for t in (0.005 * i for i in range(3000))], 0.005, 0.01, 0.3
    )
    assert seen.hz == pytest.approx(hz, rel=0.02)
    assert seen.zeta == pytest.approx(zeta, abs=0.01)


def test_a_decay_without_oscillation_has_no_frequency():
    assert math.isnan(ringing([math.exp(-0.01 * i) for i in range(1000)], 0.01, 1e-3).hz)


def made(metrics: dict[str, float], missed: tuple[str, ...] = ()) -> Result:
    environment = dict.fromkeys(("processor", "cpus", "machine", "python", "pybullet", "numba", "truth"), "x")
    return Result(
        "thing", "abc", "palms_471", 1, 5, metrics, {"speed": 3.0}, environment, limits_of((SPEED, SHARE)), missed
    )


def test_a_saved_result_tells_never_from_not_measured(tmp_path):
    made({"speed": math.inf, "broken": math.nan}).save(tmp_path / "result.json")
    metrics = read(tmp_path / "result.json").metrics
    assert metrics["speed"] == math.inf and math.isnan(metrics["broken"])


def test_result_json_is_flat_and_without_nan(tmp_path):
    made({"speed": 2.5, "broken": math.nan}).save(tmp_path / "deep" / "result.json")
    document = json.loads((tmp_path / "deep" / "result.json").read_text())
    assert document["metrics"] == {"speed": 2.5, "broken": None}
    assert {"experiment", "commit", "profile", "seed", "trials", "paper", "environment"} <= document.keys()


def row_of(text: str, title: str) -> list[str]:
    """The cells of a metric's row."""
    (row,) = [line for line in text.splitlines() if line.startswith(f"| {title} |")]
    return [cell.strip() for cell in row.split("|")[1:-1]]


def test_the_page_shows_conclusion_and_plot_first_and_then_the_table():
    sections = (Section("Motion", "It moves.", (SPEED, SHARE), (("a.png", "A plot."), ("b.png", "Another."))),)
    page = Page("Thing", ("It moves at {speed} (paper: {paper:speed}).", "Never {missing}."), "About it.", sections)
    text = markdown(made({"speed": 2.5, **rate("share", 1, 20)}, ("share",)), page)
    fast, often = row_of(text, "How fast"), row_of(text, "How often")
    assert numbers_in(text[: text.index("a.png")])[:2] == [2.5, 3] and "Never" not in text
    assert [numbers_in(cell) for cell in fast[1:3]] == [[2.5, 3], [2]]
    assert [numbers_in(cell) for cell in often[1:3]] == [[5, 0.9, 23.6, 20], [2]]
    assert fast[3] and often[3] and fast[3] != often[3], "one limit is met, one is missed"
    places = [text.index(part) for part in ("It moves at", "A plot.", "About it.", "How fast", "Another.")]
    assert places == sorted(places) and text.count("a.png") == 1


def test_a_page_shows_the_limits_against_which_its_result_was_judged():
    result = replace(made({"x": 3.0, "y": 4.0}), limits={"x": (None, 5.0)})
    today = (Metric("x", "X", "us", "", most=2.0), Metric("y", "Y", "us", "", most=1.0))
    text = markdown(result, Page("T", (), "", (Section("S", "", today),)))
    assert [numbers_in(cell) for cell in row_of(text, "X")[1:3]] == [[3], [5]]
    later = row_of(text, "Y")
    assert numbers_in(later[1]) == [4] and later[2:] == ["", ""], "a limit that came later has not judged this result"


def test_every_source_of_a_fingerprint_exists_and_a_missing_one_does_not_fail():
    assert all((ROOT / folder).is_dir() for folder in (*SOURCES, *ALL_SOURCES, *LOCKSTEP_SOURCES))
    assert source_hash("moved/elsewhere") == source_hash() != source_hash("controller")
