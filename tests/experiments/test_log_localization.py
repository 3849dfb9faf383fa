"""The log-localization experiment: its site, its metrics, its page, and a quick run."""

import math
from pathlib import Path

import numpy as np
import pytest

from experiments.common.registry import Options
from experiments.common.worlds import profile_named
from experiments.log_localization.experiment import plan
from experiments.log_localization.metrics import gather, sections
from experiments.log_localization.site import APART_M, STOP_M, Site
from experiments.log_localization.trial import detected, peak_error_m, true_masks
from tests.experiments.quick_runs import quick_result


def row(error: float, faithful: float = 0.2) -> dict:
    names = ("axis_deg", "diameter_m", "length_m")
    return dict.fromkeys(("nees", *names, *(f"faithful_{name}" for name in names)), 0.5) | {
        "error_m": error,
        "faithful_error_m": faithful,
        "faithful_centred_m": faithful - 0.1,
        "faithful_peak_m": 0.03,
        "parts_m": [0.0] * 3,
    }


def test_medians_are_of_all_logs_and_a_missed_log_counts_as_far_off() -> None:
    outcomes = {
        "approach/0/0": {"logs": [row(0.01), row(0.02)]},
        "approach/0/1": {"logs": [row(0.03), row(math.nan)]},
        "approach/45/0": {"logs": [row(0.04)]},
        "approach/90/0": {"logs": [row(0.05)]},
        "curve/0/0": {"ours": [0.0] * 6, "faithful": [0.0] * 6},
    }
    metrics = gather(outcomes)
    assert metrics["deg0.median_m"] == pytest.approx(0.025) and metrics["deg45.median_m"] == 0.04
    assert metrics["p95_m"] == math.inf and metrics["found"] == pytest.approx(5 / 6)
    assert metrics["faithful.deg90.median_m"] == 0.2 and metrics["axis_median_deg"] == 0.5


def test_the_paper_s_error_is_that_of_the_peak_of_the_distances() -> None:
    """Ten observations are 5.08 m from the origin, three 5.3 m; one is of another log."""
    origin, center = np.array([1.0, 0.0, 0.3]), np.array([6.2, 0.0, 0.1])
    near, far = np.add(origin, (5.08, 0.0, 0.4)), np.add(origin, (5.3, 0.0, 0.0))
    observations = [near] * 10 + [far] * 3 + [origin] * 20
    assert peak_error_m(observations, center, origin) == pytest.approx(5.2 - 5.075)
    assert math.isnan(peak_error_m([], center, origin))


def test_every_metric_is_computed() -> None:
    metrics = gather({f"approach/{d}/0": {"logs": [row(0.01)] * 2} for d in (0, 45, 90)})
    assert [metrics[f"faithful.deg{d}.peak_m"] for d in (0, 45, 90)] == [0.03] * 3
    shown = {f.name for masks in ("true", "network") for s in sections(masks) for f in s.metrics}
    assert {"p95_m", "deg45.median_m", "length_median_m", "faithful.p95_m", "faithful.axis_median_deg"} <= shown
    assert shown <= set(metrics) and not [name for name in shown if not math.isfinite(metrics[name])]


def test_jobs_are_paired_over_angles_and_named_once() -> None:
    options = Options(seed=0, truth="nominal", profile="aoro_fc8", out=Path("out"))
    jobs = plan(options, "aoro_fc8", "sampled", 4, "true")
    assert len({j.name for j in jobs}) == len(jobs) == 3 * 4 + 7 * 2
    assert {j.seed for j in jobs if j.name.startswith("approach/0/")} == {
        j.seed for j in jobs if j.name.startswith("approach/90/")
    }


@pytest.mark.long
def test_the_site_is_as_paper_b_describes_it_and_the_survey_finds_the_camera() -> None:
    site = Site(profile_named("aoro_fc8"), "sampled", 5, 45.0)
    try:
        first, second = site.logs
        assert second.center_m[0] - first.center_m[0] == pytest.approx(APART_M, abs=0.1)
        heading = math.degrees(math.acos(abs(float(first.axis[:2] @ (1.0, 0.0))) / np.linalg.norm(first.axis[:2])))
        assert heading == pytest.approx(45.0, abs=2.5)
        shot = site.shot(-STOP_M)
        assert np.linalg.norm(shot.view.position_m - first.center_m) == pytest.approx(5.2, abs=0.35)
        estimated_pose = site.estimated_pose(shot)
        assert np.linalg.norm(estimated_pose.position_m - shot.view.position_m) < 0.08
        assert np.abs(estimated_pose.rotation - shot.view.rotation).max() < 0.02
        frame = site.frame(shot, 1)
        (mask, *_) = true_masks(frame, shot)
        known = np.isfinite(frame.depth_m) & np.isfinite(shot.picture.depth_m) & (shot.picture.depth_m < 7.0)
        ratio = np.median(frame.depth_m[known] / shot.picture.depth_m[known])
        assert ratio == pytest.approx(1.0, abs=0.003)
        left, top, right, bottom = detected(frame, mask.mask)
        rows, columns = np.nonzero(mask.mask)
        assert abs(left - columns.min()) < 1.2 and abs(bottom - rows.max() - 1) < 1.2
        assert (right - left) * (bottom - top) > 400
    finally:
        site.close()


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_command_evaluates_draws_and_writes_the_page(tmp_path: Path) -> None:
    document = quick_result("log-localization", tmp_path / "out", "--seed", "3", "--docs", str(tmp_path / "docs"))
    metrics = document["metrics"]
    assert document["experiment"] == "log-localization" and document["environment"]["masks"] in ("true", "network")
    for degrees in (0, 45, 90):
        assert metrics[f"deg{degrees}.median_m"] < 0.12 < metrics["faithful.deg90.median_m"]
    assert metrics["faithful.deg90.median_m"] > metrics["faithful.deg0.median_m"]
