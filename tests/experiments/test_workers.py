"""Where trials run changes nothing: one process, two, two nodes of a cluster, a worker that is killed on the way."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from experiments.common import pool, ray_workers
from experiments.common.checkpoint import Checkpoint
from experiments.common.pool import Job
from experiments.common.workers import TrialCost, Workers, overhead_s
from runtime.errors import InputRefused
from tests.codes import coded
from tests.experiments.mortal_trials import (
    QUIET,
    mortal,
    plant_jobs,
    square_jobs,
    table,
    table_of_one_process,
)


@pytest.mark.long
def test_two_processes_of_which_one_is_killed_give_the_same_table(tmp_path: Path) -> None:
    there = table(tmp_path / "trials.jsonl", mortal(tmp_path / "marker"), Workers(2), plant_jobs())
    assert (tmp_path / "marker").exists() and there == table_of_one_process(tmp_path)


def test_a_run_with_more_trials_or_sources_changed_back_loses_none(tmp_path: Path) -> None:
    path, ran = tmp_path / "trials.jsonl", []

    def run(fingerprint: str, jobs: list[Job]) -> dict[str, Any]:
        with Checkpoint(path, fingerprint, stays=True) as kept:
            return pool.run(lambda job: ran.append(job.name) or job.seed, jobs, kept, Workers(), "trials", QUIET)

    assert len(run("one", square_jobs(2))) == 2 and len(ran) == 2
    run("other sources", square_jobs(2))
    assert len(ran) == 4
    assert run("one", square_jobs(3)) == {"square/0": 0, "square/1": 1, "square/2": 2}
    assert ran[4:] == ["square/2"]
    again = [Job("square/0", "square", 5, {})]  # the same name, another seed
    assert run("one", again) == {"square/0": 5} and ran[5:] == ["square/0"]


def test_two_runs_do_not_write_the_same_trials(tmp_path: Path) -> None:
    with (
        Checkpoint(tmp_path / "trials.jsonl", "one"),
        pytest.raises(InputRefused, check=coded("experiment.in-use")),
    ):
        Checkpoint(tmp_path / "trials.jsonl", "one")
    (tmp_path / "file").touch()
    with pytest.raises(InputRefused, check=coded("experiment.trials-unwritable")):
        Checkpoint(tmp_path / "file" / "trials.jsonl", "one")


def test_the_overhead_is_the_time_between_two_trials_of_a_worker() -> None:
    costs = [TrialCost("a", 0.0, 1.0, 0), TrialCost("b", 0.5, 9.0, 0), TrialCost("a", 1.25, 1.0, 0)]
    assert overhead_s(costs) == pytest.approx(0.25)
    assert overhead_s(costs[:2]) != overhead_s(costs[:2])


class StandInRay:
    """What `ray_workers` uses of Ray, in this process: tasks that run when they are waited for."""

    def __init__(self, fate: dict[str, Exception]) -> None:
        self.fate, self.cancelled, self.most_waiting = fate, [], 0

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **options: Any) -> Any:
        assert options == {"num_cpus": 1, "max_retries": ray_workers.RETRIES}
        return lambda function: SimpleNamespace(remote=lambda *given: (function, given))

    def wait(self, references: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        self.most_waiting = max(self.most_waiting, len(references))
        return references[-num_returns:], references[:-num_returns]

    def get(self, reference: Any) -> Any:
        function, given = reference
        if given[0] in self.fate:
            raise self.fate[given[0]]
        return function(*given)

    def cancel(self, reference: Any, force: bool) -> None:
        self.cancelled.append(reference)


class Died(Exception):
    """A process of the cluster died too often."""


class TaskError(Exception):
    """What a task raised, as Ray passes it on."""

    def __init__(self, cause: BaseException) -> None:
        self.cause = cause


def on_stand_in(monkeypatch: pytest.MonkeyPatch, fate: dict[Any, Exception]) -> StandInRay:
    made = StandInRay(fate)
    exceptions = SimpleNamespace(
        NodeDiedError=Died, OutOfMemoryError=Died, WorkerCrashedError=Died, RayTaskError=TaskError
    )
    monkeypatch.setattr(ray_workers, "connected", lambda _: made)
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(exceptions=exceptions))
    monkeypatch.setitem(sys.modules, "ray.exceptions", exceptions)
    return made


def pieces(count: int) -> dict[str, Any]:
    return {job.name: partial(pow, job.seed, 2) for job in square_jobs(count)}


def test_every_piece_of_work_comes_back_from_a_cluster_and_few_wait_there(monkeypatch: pytest.MonkeyPatch) -> None:
    made = on_stand_in(monkeypatch, {})
    found = dict(ray_workers.completed(pieces(20), "auto", lambda: "ours"))
    assert found == {f"square/{i}": i * i for i in range(20)} and made.most_waiting == 4 and not made.cancelled


def test_a_trial_that_fails_on_a_cluster_raises_its_own_error_and_the_others_are_cancelled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    work = pieces(9)
    made = on_stand_in(monkeypatch, {work["square/3"]: TaskError(ZeroDivisionError("in trial"))})
    with pytest.raises(ZeroDivisionError, match="in trial"):
        list(ray_workers.completed(work, "auto", lambda: "ours"))
    assert len(made.cancelled) == 3
    on_stand_in(monkeypatch, {work["square/3"]: Died()})
    with pytest.raises(InputRefused, match="square/3", check=coded("experiment.worker-killed")):
        list(ray_workers.completed(work, "auto", lambda: "ours"))


def test_a_worker_with_other_sources_refuses_its_trial() -> None:
    with pytest.raises(InputRefused, match="theirs", check=coded("experiment.node-differs")):
        ray_workers._on_node(lambda: 1, lambda: "theirs", "ours")
