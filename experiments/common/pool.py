"""Runs independent trials on all cores in spawned processes, with a checkpoint on disk.

A job is plain data.  ``function(job)`` runs in a worker and returns plain (JSON) data that depends on the job alone, so
the number of workers does not change a result.  Outcomes come back in the order of the jobs.  Every finished job is
written to the checkpoint at once; after an interruption the same call continues from there.  Workers ignore Ctrl-C: the
parent ends them.
"""

from __future__ import annotations

import json
import lzma
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from experiments.common.errors import ExperimentError
from runtime.allocator import keep_memory

WAITING_PER_WORKER: Final = 2
ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Job:
    """One trial: a name unique in the run, the kind of trial, its seed and further plain arguments."""

    name: str
    kind: str
    seed: int
    options: dict[str, Any]


class Checkpoint:
    """Finished jobs in a file of JSON lines; the first line holds the fingerprint of the run they belong to.

    If the file holds no jobs of this run, those in ``published`` are used: the same lines in an xz file.  Jobs of
    another fingerprint are ignored, so that the run starts anew.
    """

    def __init__(self, path: Path, fingerprint: str, published: Path | None = None) -> None:
        self._path, self._published = path, published
        self.done = _read(path, fingerprint)
        if not self.done and published is not None:
            self.done = _read(published, fingerprint)
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [json.dumps({"run": fingerprint}), *(json.dumps([k, v]) for k, v in self.done.items())]
        path.write_text("\n".join(lines) + "\n")
        self._file = path.open("a")

    def add(self, name: str, outcome: Any) -> None:
        """Store a finished job."""
        line = json.dumps([name, outcome])
        self._file.write(line + "\n")
        self._file.flush()
        self.done[name] = json.loads(line)[1]

    def publish(self) -> None:
        """Write the finished jobs to the published file, if there is one."""
        if self._published is not None:
            self._published.parent.mkdir(parents=True, exist_ok=True)
            with lzma.open(self._published, "wb") as file:
                file.write(self._path.read_bytes())

    def close(self) -> None:
        """Close the file; it stays on disk for the next run."""
        self._file.close()

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        """Remove the file after a complete run; an interrupted run leaves it."""
        self.close()
        if failure is None:
            self._path.unlink()


def read_published(path: Path) -> dict[str, Any]:
    """The outcomes of a published file by the names of their jobs, whichever run made them.

    Raises:
        ExperimentError: the file is missing or damaged.
    """
    try:
        _, *lines = lzma.decompress(path.read_bytes()).decode().splitlines()
    except (OSError, lzma.LZMAError) as error:
        raise ExperimentError("experiment.published-trials", f"{path} cannot be read: {error}") from None
    return _outcomes(lines)


def _read(path: Path, fingerprint: str) -> dict[str, Any]:
    """The finished jobs in a file, by name; none if it belongs to another run or cannot be read."""
    try:
        data = path.read_bytes()
        head, *lines = (lzma.decompress(data) if path.suffix == ".xz" else data).decode().splitlines()
        if json.loads(head) != {"run": fingerprint}:
            return {}
    except (OSError, ValueError, lzma.LZMAError):
        return {}
    return _outcomes(lines)


def _outcomes(lines: Sequence[str]) -> dict[str, Any]:
    done = {}
    for line in lines:
        try:
            name, outcome = json.loads(line)
        except ValueError:
            break  # the run was interrupted while it wrote this line
        done[name] = outcome
    return done


def run(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    checkpoint: Checkpoint,
    workers: int,
    title: str,
    console: Console,
) -> dict[str, Any]:
    """Outcome of every job by name, in the order of ``jobs``; an exception in a trial names the trial in a note."""
    todo = [job for job in jobs if job.name not in checkpoint.done]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(title, total=len(jobs), completed=len(jobs) - len(todo))
        if workers <= 1:
            keep_memory()
            for job in todo:
                checkpoint.add(job.name, _named(function, job))
                progress.advance(task)
        else:
            _run_parallel(function, todo, checkpoint, workers, lambda: progress.advance(task))
    return {job.name: checkpoint.done[job.name] for job in jobs}


def _run_parallel(
    function: Callable[[Job], Any],
    todo: Sequence[Job],
    checkpoint: Checkpoint,
    workers: int,
    advance: Callable[[], None],
) -> None:
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin)
    waiting: dict[Future[Any], Job] = {}
    queue = iter(todo)
    try:
        while True:
            while len(waiting) < WAITING_PER_WORKER * workers and (job := next(queue, None)):
                waiting[pool.submit(_named, function, job)] = job
            if not waiting:
                break
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                checkpoint.add(waiting.pop(future).name, future.result())
                advance()
    except BaseException:
        for process in list(pool._processes.values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_memory()  # as the detector process of the machine does, whose time is measured


def _named(function: Callable[[Job], Any], job: Job) -> Any:
    try:
        return function(job)
    except BaseException as error:
        error.add_note(f"in trial {job.name}")
        raise
