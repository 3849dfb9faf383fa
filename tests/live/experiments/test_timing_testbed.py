"""The timing testbed: emulated machine and setpoint source with the real controller in virtual time, observer, soak."""

from __future__ import annotations

import json
import os

import pytest
from typer.testing import CliRunner

from experiments.timing.measurement import missing_tools
from host.exit_codes import ExitCode
from timberhand.cli import app


def test_a_short_soak_loses_no_frame_and_does_not_grow(tmp_path):
    result = CliRunner().invoke(app, ["experiment", "soak", "--quick", "--profile", "aoro_fc8", "--out", str(tmp_path)])
    document = json.loads((tmp_path / "result.json").read_text())
    assert result.exit_code == 0, (document["missed"], result.output[-2000:])
    metrics = document["metrics"]
    assert metrics["received"] > 40_000 and metrics["gaps"] == metrics["frames_lost"] == metrics["unanswered"] == 0


@pytest.mark.timeout(300)
def test_a_quick_measurement_writes_everything_and_leaves_undecided_limits_inconclusive(tmp_path):
    if missing := missing_tools():
        pytest.skip(f"not installed here: {', '.join(missing.values())}")
    if os.geteuid():
        pytest.skip("cyclictest gets SCHED_FIFO as root only")
    command = ["experiment", "timing", "--quick", "--out", str(tmp_path / "out"), "--docs", str(tmp_path / "docs")]
    result = CliRunner().invoke(app, command)
    assert getattr(result.exception, "exit_code", 0) in (ExitCode.OK, ExitCode.FIGURE_MISSED), result.output[-2000:]
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    open_ = {"wakeup_p50_ratio", "wakeup_p99_ratio", "missed", "page_faults", "gc_runs"}
    assert open_ <= {*document["inconclusive"], *document["missed"]}
    metrics = document["metrics"]
    assert metrics["ticks"] > 600 and metrics["ticks_1k"] > 2000 and metrics["frames_per_s"] > 3000
    assert metrics["cyclictest_p50_us"] > 0 and metrics["rx_decode_us"] > 0 and metrics["syscalls_per_tick"] > 4
