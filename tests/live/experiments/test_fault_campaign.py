"""The fault campaign: its verdicts, its metrics, and a machine that is forked at a moment and continues the same."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from experiments.common.pool import Checkpoint, Job
from experiments.common.registry import Options
from experiments.faults import experiment, files
from experiments.faults.experiment import _limited, plan
from experiments.faults.trial import in_child
from hil.faults.catalogue import BY_NAME
from runtime.errors import InputRefused
from tests.codes import coded
from tests.experiments.fault_outcomes import outcome


def test_the_time_limit_ends_a_run_and_keeps_what_is_done(tmp_path: Path) -> None:
    with Checkpoint(tmp_path / "trials.jsonl", "run") as kept, _limited(None, kept, 2):
        kept.add("a", {})
    over = pytest.raises(InputRefused, check=coded("experiment.time-over"))
    with over, Checkpoint(tmp_path / "trials.jsonl", "run") as kept, _limited(0.002, kept, 2):
        kept.add("a", {"x": 1})
        time.sleep(10.0)
    assert Checkpoint(tmp_path / "trials.jsonl", "run").done == {"a": {"x": 1}}


def test_injections_without_all_hours_of_work_give_a_page_and_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def over(_f: Any, jobs: Any, kept: Checkpoint, *_: Any) -> None:
        for job in jobs[:done]:
            kept.add(job.name, {"case": job.options["case"], "scene": job.options["scene"], "outcomes": [outcome()]})
        raise InputRefused(experiment.TIME_OVER, "over")

    monkeypatch.setattr(experiment.pool, "run", over)
    options, console = Options(3, "nominal", "palms_471", tmp_path, quick=True), Console(quiet=True)
    done = len(plan(3, experiment.QUICK_TRIALS)) - 1
    for pages in (0, 1):
        with pytest.raises(InputRefused, check=coded("experiment.time-over")):
            experiment.run(options, console)
        assert len(list(tmp_path.glob("result.json"))) == pages and (tmp_path / "trials.jsonl").is_file()
        done += 1


def test_a_child_answers_and_its_failure_is_told() -> None:
    assert in_child(lambda: {"a": 1}) == {"a": 1}
    with pytest.raises(InputRefused, check=coded("experiment.injection-failed")):
        in_child(lambda: {"a": 1 // 0})


@pytest.mark.parametrize("name", sorted(files.CHECKS))
def test_files_and_clocks_keep_their_promise(name: str) -> None:
    found = files.perform(Job("j", "files", 1, {"case": BY_NAME[name].number, "count": 3}))
    assert [o["verdict"] for o in found["outcomes"]] == ["ok"] * 3, found["outcomes"]
