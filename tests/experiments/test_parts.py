"""The parts experiment: its measures on outcomes with known answers, its plan, and a quick run."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.parts.experiment import METRICS, SLOPES, gather, plan, settled_s
from experiments.parts.trial import demonstrations
from tests.experiments.quick_runs import quick_result

TILT = math.radians(5.0)


def test_every_demonstration_is_left_out_once_and_variants_share_a_machine() -> None:
    jobs = plan(SimpleNamespace(seed=1, quick=False), "aoro_fc8", "sampled", ["one", None, "three"])
    assert len(jobs) == len({job.name for job in jobs})
    shown = [job for job in jobs if job.kind == "primitive"]
    assert sorted(job.options["number"] for job in shown) == list(range(len(demonstrations("aoro_fc8"))))
    driven = [job for job in jobs if job.kind == "ground"]
    assert len(driven) == 6 and {job.options["floats"] for job in driven} == {True, False}
    assert len({job.seed for job in driven}) == 3
    assert {job.seed: job.options["text"] for job in jobs} == {job.seed: job.options["text"] for job in driven}
    assert {job.name.split("/")[1] for job in jobs if job.kind == "level"} == set(SLOPES)


def test_a_tilt_has_settled_from_its_last_second_above_a_degree() -> None:
    assert settled_s([[1, TILT], [2, 0.0], [3, TILT], [4, 0.0], [5, 0.0]]) == 4.0
    assert settled_s([[1, 0.0], [2, 0.0]]) == 0.0
    assert settled_s([[1, TILT], [2, TILT]]) == 2.0, "not within the time"


def test_figures_of_drives_with_known_loads() -> None:
    loads = [[1.0, 1.0, 1.0, 1.0], [2.0, 0.0, 2.0, 0.0]]
    drive = {"heights_m": [[0.03, -0.04]] * 2, "loads": loads, "roll_rad": [0.1, 0.1], "stops": 1, "arrived": False}
    metrics = gather({"ground/float/0": drive})
    assert metrics["float.height_rms_m"] == pytest.approx(math.hypot(0.03, 0.04) / math.sqrt(2.0))
    assert metrics["float.lifted"] == 0.5 and metrics["float.arrived"] == 0.0
    assert metrics["float.roll_deg"] == pytest.approx(0.0)
    assert metrics["stops"] == 1.0 and math.isnan(metrics["estimates_hz"])


def test_a_primitive_out_of_reach_is_counted_and_leaves_no_other_figure() -> None:
    made = {"shape_rms_m": 0.1, "shape_max_m": 0.2, "time_share": 1.0, "tip_rms_m": 0.03, "true_rms_m": 0.05}
    made |= {"rest_m": 0.01, "stops": 0}
    metrics = gather({"primitive/own/0": made, "primitive/own/1": {"failure": "out of reach", "stops": 0}})
    assert metrics["refused"] == 1.0 and metrics["shape_rms_m"] == 0.1


@pytest.mark.long
def test_the_quick_run_measures_every_part(tmp_path: Path) -> None:
    metrics = quick_result("parts", tmp_path)["metrics"]
    assert all(math.isfinite(metrics[metric.name]) for metric in METRICS), metrics
    assert metrics["stops"] == metrics["refused"] == 0.0
    assert metrics["side.after_deg"] < 0.5 * metrics["side.before_deg"]
