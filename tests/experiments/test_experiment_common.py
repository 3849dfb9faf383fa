"""What every experiment shares: figures and their limits, Wilson intervals, the pool with its checkpoint, the page."""

from __future__ import annotations

import json
import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Checkpoint, Job
from experiments.common.registry import Options
from experiments.common.result import Figure, Result, judge, rate, wilson
from experiments.common.result_page import page
from experiments.common.trials import check_truth, checkpoint
from experiments.plant.signals import ringing
from host.exit_codes import CommandFailed

QUIET = Console(quiet=True)
SPEED = Figure("speed", "How fast", "m/s", "With a watch.", least=2.0, clocked=True)
SHARE = Figure("share", "How often", "%", "By counting.", most=0.02, scale=100.0)


def square(job: Job) -> dict[str, int]:
    """A trial."""
    return {"square": job.seed**2, "process": os.getpid()}


def interrupted(job: Job) -> dict[str, int]:
    """A trial during which somebody presses Ctrl-C."""
    if job.seed == 3:
        raise KeyboardInterrupt
    return square(job)


def failing(job: Job) -> None:
    """A trial with a defect."""
    raise ZeroDivisionError


def jobs(n: int) -> list[Job]:
    return [Job(f"square/{i}", "square", i, {}) for i in range(n)]


def test_wilson_agrees_with_published_values():
    assert wilson(39, 40) == pytest.approx((0.871, 0.996), abs=1e-3)
    assert wilson(0, 20) == pytest.approx((0.0, 0.161), abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


@given(st.integers(1, 500), st.data())
def test_a_wilson_interval_holds_the_rate(n, data):
    hits = data.draw(st.integers(0, n))
    low, high = wilson(hits, n)
    assert 0.0 <= low <= hits / n + 1e-12 and hits / n - 1e-12 <= high <= 1.0


def test_figures_are_judged_against_their_limits():
    figures = (SPEED, SHARE)
    assert judge(figures, {"speed": 2.0, "share": 0.02}, noisy=False) == ((), ())
    assert judge(figures, {"speed": 1.9, "share": 0.03}, noisy=False) == (("speed", "share"), ())
    assert judge(figures, {"speed": math.nan}, noisy=False) == (("speed",), ())


def test_a_noisy_host_leaves_only_clocked_figures_open():
    assert judge((SPEED, SHARE), {"speed": 1.9, "share": 0.03}, noisy=True) == (("share",), ("speed",))


def test_no_trials_make_no_rate():
    assert math.isnan(rate("share", 0, 0)["share"])


def test_the_number_of_workers_changes_nothing(tmp_path):
    outcomes = []
    for workers in (1, 2):
        with Checkpoint(tmp_path / f"{workers}.jsonl", "run") as checkpoint:
            outcomes.append(pool.run(square, jobs(7), checkpoint, workers, "trials", QUIET))
    one, two = outcomes
    assert list(one) == list(two) == [job.name for job in jobs(7)]
    assert [o["square"] for o in one.values()] == [o["square"] for o in two.values()]
    assert {o["process"] for o in one.values()} == {os.getpid()}
    assert os.getpid() not in {o["process"] for o in two.values()}


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path):
    path = tmp_path / "trials.jsonl"
    with pytest.raises(KeyboardInterrupt), Checkpoint(path, "run") as checkpoint:
        pool.run(interrupted, jobs(6), checkpoint, 1, "trials", QUIET)
    path.write_text(path.read_text() + '["square/5", {"squ')  # cut off while writing
    ran = []
    with Checkpoint(path, "run") as again:
        assert sorted(again.done) == ["square/0", "square/1", "square/2"]
        outcomes = pool.run(lambda job: ran.append(job.seed) or square(job), jobs(6), again, 1, "trials", QUIET)
    assert ran == [3, 4, 5] and [o["square"] for o in outcomes.values()] == [0, 1, 4, 9, 16, 25]
    assert not path.exists()


def test_a_checkpoint_of_another_run_is_not_taken(tmp_path):
    path = tmp_path / "trials.jsonl"
    first = Checkpoint(path, "one")
    first.add("square/0", 0)
    first.close()
    assert Checkpoint(path, "one").done == {"square/0": 0}
    assert Checkpoint(path, "two").done == {}


def test_what_was_published_is_gone_on_from_where_nothing_else_is_left(tmp_path):
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


def test_a_run_with_another_truth_begins_anew(tmp_path):
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


def test_a_truth_that_is_none_stops_before_any_trial(tmp_path):
    with pytest.raises(CommandFailed, match=r"none\.toml"):
        check_truth("palms_471", str(tmp_path / "none.toml"))


def test_an_error_says_which_trial(tmp_path):
    checkpoint = Checkpoint(tmp_path / "trials.jsonl", "run")
    with pytest.raises(ZeroDivisionError) as caught:
        pool.run(failing, jobs(1), checkpoint, 1, "trials", QUIET)
    assert "in trial square/0" in caught.value.__notes__


@given(st.floats(0.4, 5.0), st.floats(0.005, 0.15))
def test_a_known_oscillation_is_read_back(hz, zeta):
    w = 2.0 * math.pi * hz
    seen = ringing(
        [0.3 + math.exp(-zeta * w * t) * math.cos(w * t) for t in (0.005 * i for i in range(3000))], 0.005, 0.01, 0.3
    )
    assert seen.hz == pytest.approx(hz, rel=0.02)
    assert seen.zeta == pytest.approx(zeta, abs=0.01)


def test_what_does_not_oscillate_has_no_frequency():
    assert math.isnan(ringing([math.exp(-0.01 * i) for i in range(1000)], 0.01, 1e-3).hz)


def made(metrics: dict[str, float], missed: tuple[str, ...] = ()) -> Result:
    environment = dict.fromkeys(("processor", "cpus", "machine", "python", "pybullet", "numba", "truth"), "x")
    return Result("thing", "abc", "palms_471", 1, 5, metrics, {"speed": 3.0}, environment, missed=missed)


def test_result_json_is_flat_and_holds_no_nan(tmp_path):
    made({"speed": 2.5, "broken": math.nan}).save(tmp_path / "deep" / "result.json")
    document = json.loads((tmp_path / "deep" / "result.json").read_text())
    assert document["metrics"] == {"speed": 2.5, "broken": None}
    assert {"experiment", "commit", "profile", "seed", "trials", "paper", "environment"} <= document.keys()


def test_the_page_says_what_was_measured_and_what_was_missed():
    class Heading:
        title, text, figures, pictures = "Motion", "It moves.", (SPEED, SHARE), (("a.png", "A picture."),)

    text = page(made({"speed": 2.5, **rate("share", 1, 20)}, ("share",)), "Thing", "About it.", [Heading()])
    assert "| How fast | 2.5 m/s (paper: 3 m/s) | at least 2 | reached |" in text
    assert "| How often | 5% (0.9 to 23.6, n = 20) | at most 2 | **missed** |" in text
    assert "![A picture.](results/thing/a.png)" in text
