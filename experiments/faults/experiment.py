"""The fault campaign: 45 catalogue entries at random moments, and hours of nominal work (docs/reference/safety.md 5).

``--trials`` is the number of injections of each entry, spread over its scenes; ``--minutes`` bounds the run: finished
jobs stay in the checkpoint and, with ``--docs``, in the docs, and the same command continues.  The page is written once
all injections are done, with the hours of work that there are by then.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Checkpoint, Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.faults import files, nominal, trial
from experiments.faults.metrics import METRICS, gather
from experiments.faults.pages import CONCLUSION, INTRODUCTION, sections, write_evidence
from hil.faults.catalogue import CASES, Case, Where, Work
from runtime.errors import InputRefused

TRIALS: Final = 100
QUICK_TRIALS: Final = 2
NOMINAL_S: Final = 10.05 * 3600.0
QUICK_NOMINAL_S: Final = 120.0
PROFILES: Final = ("palms_471", "aoro_fc8")
BATCH: Final = 25
"""Injections of one job: a checkpoint keeps whole jobs."""
TRIALS_FILE: Final = "results/faults/trials.jsonl.xz"
PHYSICS: Final = " physics"
TIME_OVER: Final = "experiment.time-over"


def run(options: Options, console: Console) -> Result:
    """Run the campaign; write ``options.out`` and, if requested, the docs.

    Raises:
        InputRefused: the time given by ``--minutes`` is over; the same command continues.
    """
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    injections = plan(options.seed, trials)
    jobs = [*injections, *nominal_plan(options.seed, QUICK_NOMINAL_S if options.quick else NOMINAL_S)]
    with checkpoint(options, jobs, PROFILES, options.truth, LOCKSTEP_SOURCES, TRIALS_FILE) as trial_store:
        over: InputRefused | None = None
        try:
            with _limited(options.minutes, trial_store, len(jobs)):
                pool.run(perform, jobs, trial_store, options.workers, "faults", console)
        except InputRefused as error:
            if error.code != TIME_OVER or any(job.name not in trial_store.done for job in injections):
                raise
            over = error
        outcomes = {job.name: trial_store.done[job.name] for job in jobs if job.name in trial_store.done}
        metrics = gather(outcomes)
        result = make_result(
            "faults",
            METRICS,
            metrics,
            profile=", ".join(PROFILES),
            seed=options.seed,
            trials=trials,
            more={"truth": options.truth},
        )
        publish(result, page_of(result, {}), options, console)
        write_evidence(outcomes, metrics, options.out / "evidence")
        if options.docs is not None:
            write_evidence(outcomes, metrics, options.docs / "results" / "faults")
            if over is None:
                trial_store.publish()
        if over is not None:
            raise over  # which keeps the checkpoint
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Fault campaign", CONCLUSION, INTRODUCTION, sections(result))


def perform(job: Job) -> dict[str, Any]:
    """Run one job of any kind."""
    by_kind = {"case": trial.perform, "files": files.perform, "nominal": nominal.perform}
    return by_kind[job.kind](job)


def scenes_of(case: Case) -> list[str]:
    """List the scenes in which a case happens."""
    physics = PHYSICS if case.physics else ""
    by_work = {
        Work.CRANE: [f"crane palms_471{physics}", f"crane aoro_fc8{physics}"],
        Work.HOLD: [f"hold palms_471{physics}", f"hold aoro_fc8{physics}"],
        Work.CARRY: ["carry palms_471", "carry aoro_fc8"],
        Work.DRIVE: ["drive aoro_fc8"],
        Work.PLC: ["plc valves palms_471", "plc references palms_471"],
    }
    return [scene for work in case.works for scene in by_work[work]]


def plan(seed: int, trials: int) -> list[Job]:
    """Plan every job with injections, by scene, so that a worker builds a machine once."""
    jobs = []
    for case in CASES:
        match case.where:
            case Where.RUN | Where.START:
                scenes = scenes_of(case)
                for i, scene in enumerate(scenes):
                    count = trials // len(scenes) + (i < trials % len(scenes))
                    jobs += list(_batches(case, "case", scene, seed, count))
            case Where.FILES:
                jobs += list(_batches(case, "files", "files", seed, trials))
    return sorted(jobs, key=lambda job: str(job.options["scene"]))


def _batches(case: Case, kind: str, scene: str, seed: int, count: int) -> Iterator[Job]:
    for first in range(0, count, BATCH):
        options = {"case": case.number, "scene": scene, "count": min(BATCH, count - first)}
        yield Job(f"{case.label}/{scene}/{first}", kind, 1000 * seed + first, options)


def nominal_plan(seed: int, seconds: float) -> list[Job]:
    """Plan stretches of nominal work that add up to ``seconds``."""
    shares = {scene: share for scene, (_, _, share) in nominal.SETTINGS.items()}
    jobs = []
    for scene, share in shares.items():
        left_s, number = seconds * share / sum(shares.values()), 0
        stretch_s = nominal.STRETCHES_S.get(scene.split()[0], nominal.STRETCH_S)
        while left_s > 0.0:
            options = {"scene": scene, "seconds": min(left_s, stretch_s)}
            jobs.append(Job(f"nominal/{scene}/{number}", "nominal", 5000 + 1000 * seed + number, options))
            left_s, number = left_s - stretch_s, number + 1
    return jobs


@contextmanager
def _limited(minutes: float | None, kept: Checkpoint, total: int) -> Iterator[None]:
    """End what runs inside when the time is over; finished jobs are kept.

    Raises:
        InputRefused: the time is over.
    """
    if minutes is None:
        yield
        return

    def over(number: int, frame: object) -> None:
        raise InputRefused(
            "experiment.time-over",
            f"the time is over with {len(kept.done)} of {total} jobs done; the same command continues",
        )

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, 60.0 * minutes)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
