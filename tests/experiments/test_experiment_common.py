"""Shared parts of the experiments: metrics and limits, Wilson intervals, the pool with its checkpoint."""

from __future__ import annotations

import json
import math
import os

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
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Workers
from experiments.plant.runs import ringing
from tests.experiments.mortal_trials import square_jobs

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


@pytest.mark.parametrize(
    ("metrics", "noisy", "verdict"),
    [
        ({"speed": 2.0, "share": 0.02}, False, ((), ())),
        ({"speed": 1.9, "share": 0.03}, False, (("speed", "share"), ())),
        ({"speed": math.nan}, False, (("speed",), ())),
        pytest.param({"speed": 1.9, "share": 0.03}, True, (("share",), ("speed",)), id="only clocked ones are open"),
    ],
)
def test_metrics_are_compared_with_their_limits(metrics, noisy, verdict):
    assert evaluate((SPEED, SHARE), metrics, noisy=noisy) == verdict


def test_no_trials_make_no_rate():
    assert math.isnan(rate("share", 0, 0)["share"])


def test_an_interrupted_run_continues_where_it_stopped(tmp_path):
    path = tmp_path / "trials.jsonl"
    with pytest.raises(KeyboardInterrupt), Checkpoint(path, "run") as checkpoint:
        pool.run(interrupted, square_jobs(6), checkpoint, Workers(), "trials", QUIET)
    path.write_text(path.read_text() + '["square/5", {"squ')  # cut off while writing
    ran = []
    with Checkpoint(path, "run") as again:
        assert sorted(again.done) == ["square/0", "square/1", "square/2"]
        outcomes = pool.run(
            lambda job: ran.append(job.seed) or square(job), square_jobs(6), again, Workers(), "trials", QUIET
        )
    assert ran == [3, 4, 5] and [o["square"] for o in outcomes.values()] == [0, 1, 4, 9, 16, 25]
    assert not path.exists()


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
        return checkpoint(options, square_jobs(2), ["palms_471"], options.truth)

    first = begun()
    first.add("square/0", 0)
    first.close()
    assert begun().done == {"square/0": 0}
    truth.write_text("a = 2")
    assert begun().done == {}


def test_an_error_names_the_trial(tmp_path):
    checkpoint = Checkpoint(tmp_path / "trials.jsonl", "run")
    with pytest.raises(ZeroDivisionError) as caught:
        pool.run(failing, square_jobs(1), checkpoint, Workers(), "trials", QUIET)
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


def test_a_saved_result_is_flat_without_nan_and_tells_never_from_not_measured(tmp_path):
    path = tmp_path / "deep" / "result.json"
    made({"speed": math.inf, "broken": math.nan, "share": 0.5}).save(path)
    document = json.loads(path.read_text())
    assert document["metrics"].keys() == {"speed", "broken", "share"} and document["metrics"]["broken"] is None
    assert {"experiment", "commit", "profile", "seed", "trials", "paper", "environment"} <= document.keys()
    metrics = read(path).metrics
    assert metrics["speed"] == math.inf and math.isnan(metrics["broken"]) and metrics["share"] == 0.5


def test_metrics_that_are_measured_alike_share_a_line_unless_it_refers_to_the_one_before():
    how = {"a: x": "By eye.", "a: y": "The same eye.", "b: x": "By eye.", "b: z": "By ear.", "b: y": "The same eye."}
    metrics = tuple(Metric(title, title, "", text) for title, text in how.items())
    page = markdown(made(dict.fromkeys(how, 1.0)), Page("Thing", (), "", (Section("All", "", metrics),)))
    listed = [line for line in page.splitlines() if line.startswith("- ")]
    assert listed == [
        "- *a: x*; *b: x*: By eye.",
        "- *a: y*: The same eye.",
        "- *b: z*: By ear.",
        "- *b: y*: The same eye.",
    ]


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"metrics": [1]}', '{"metrics": {"speed": [1]}}'])
def test_a_file_that_is_no_result_is_refused_by_its_name(text, tmp_path):
    path = tmp_path / "plant.json"
    path.write_text(text)
    with pytest.raises(ValueError) as refused:
        read(path)
    assert str(path) in str(refused.value)


def test_every_source_of_a_fingerprint_exists_and_a_missing_one_does_not_fail():
    assert all((ROOT / folder).is_dir() for folder in (*SOURCES, *ALL_SOURCES, *LOCKSTEP_SOURCES))
    assert source_hash("moved/elsewhere") == source_hash() != source_hash("controller")
