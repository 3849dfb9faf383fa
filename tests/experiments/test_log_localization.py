"""The log-localization experiment: its site, its metrics, its page, and a quick run."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from experiments.common.registry import Options
from experiments.common.worlds import profile_named
from experiments.log_localization.experiment import plan
from experiments.log_localization.metrics import gather, sections
from experiments.log_localization.site import APART_M, STOP_M, Site
from experiments.log_localization.trial import detected, peak_error_m, true_masks
from host.exit_codes import CommandFailed, ExitCode
from timberhand.cli import app


def row(error: float, faithful: float = 0.2) -> dict:
    keys = (
        "axis_deg",
        "diameter_m",
        "length_m",
        "nees",
        "faithful_axis_deg",
        "faithful_diameter_m",
        "faithful_length_m",
    )
    return dict.fromkeys(keys, 0.5) | {
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
    for prefix in ("", "faithful."):
        for name in (
            "deg0.median_m",
            "deg45.median_m",
            "deg90.median_m",
            "p95_m",
            "axis_median_deg",
            "diameter_median_m",
            "length_median_m",
        ):
            assert math.isfinite(metrics[prefix + name])
    for masks in ("true", "network"):
        assert {f.name for s in sections(masks) for f in s.metrics} <= set(metrics)


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
    arguments = ["--quick", "--seed", "3", "--out", str(tmp_path / "out"), "--docs", str(tmp_path / "docs")]
    done = CliRunner().invoke(app, ["experiment", "log-localization", *arguments])
    missed = (
        isinstance(done.exception, CommandFailed) and done.exception.exit_code is ExitCode.FIGURE_MISSED
    )  # two trials are few
    assert done.exit_code == 0 or missed, done.output
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    metrics = document["metrics"]
    assert document["experiment"] == "log-localization" and document["environment"]["masks"] in ("true", "network")
    for degrees in (0, 45, 90):
        assert metrics[f"deg{degrees}.median_m"] < 0.12 < metrics["faithful.deg90.median_m"]
    assert metrics["faithful.deg90.median_m"] > metrics["faithful.deg0.median_m"]
