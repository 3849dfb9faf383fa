"""The forwarding-mission experiment: paper B's trial both ways, then ours on other machines and fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.mission_trial import MISSION_SOURCES
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import ROOT, Result, judged
from experiments.common.result_page import tell
from experiments.common.trials import check_truth, checkpoint, individuals, tell_failures
from experiments.common.worlds import carrier_profile
from experiments.forwarding_mission.metrics import CM, FIGURES, INTRODUCTION, PAPER, SEEN_BY, gather, sections
from experiments.forwarding_mission.plots import draw
from experiments.forwarding_mission.trial import ACROSS_M, ALONG_M, TURN_DEG, perform

TRIALS: Final = 20
"""Missions on sampled machines; each is a quarter of an hour of the machine's time."""
MACHINES: Final = 5
"""Individuals that drive them in turn."""
FIRST_SEED: Final = 60_000
SEEDS_PER_RUN: Final = 1000
EYES: Final = {"ours": "ours", "paper-b": "faithful"}
"""What sees the logs, each way."""
NOMINAL: Final = "machine/nominal"
LIMIT_S: Final = 5400.0
FILE: Final = ROOT / "docs" / "examples" / "paper_b.geojson"
RAW: Final = "results/forwarding-mission/trials.jsonl.xz"
"""What became of every log, way and grasp of all missions, in the docs."""


def run(options: Options, console: Console) -> Result:
    """Measure everything; writes ``options.out`` and, when asked, the docs.

    Raises:
        Stopped: the truth file cannot be used.
    """
    name, truth = carrier_profile(options.profile), individuals(options.truth)
    check_truth(name, truth)
    trials = 0 if options.quick else options.trials or TRIALS
    machines = calibrations(options, name, truth, MACHINES if trials else 0)
    with checkpoint(options, machines, [name], truth, MISSION_SOURCES, RAW) as kept:  # more missions go on from fewer
        outcomes = pool.run(perform, machines, kept, options.workers, "calibrations", console)
        jobs = [*trial(options, name, outcomes), *missions(options, name, truth, trials, outcomes)]
        outcomes |= pool.run(perform, jobs, kept, options.workers, "missions", console)
        result = judged(
            "forwarding-mission", FIGURES, gather(outcomes), profile=name, seed=options.seed, trials=trials,
            more={"truth": truth, "eyes": EYES["ours"], "machines": str(max(0, len(machines) - 1))}, paper=PAPER,
        )  # fmt: skip
        draw(outcomes, options.out)
        tell_failures(outcomes, console)
        words = INTRODUCTION.format(
            machines=len(machines) - 1, along=CM * ALONG_M, across=CM * ACROSS_M, turn=TURN_DEG, eyes=SEEN_BY
        )
        tell(result, "The forwarding mission", words, sections(outcomes), options, console)
        kept.publish()
    return result


def trial(options: Options, profile: str, machines: Mapping[str, Any]) -> list[Job]:
    """The trial on the field of the file with the nominal machine, each way."""
    what: dict[str, Any] = {
        "profile": profile, "truth": "nominal", "file": str(FILE), "shuffled": False, "short": options.quick,
        "text": machines[NOMINAL]["profile"] if NOMINAL in machines else None, "limit_s": LIMIT_S,
    }  # fmt: skip
    ways = ("ours",) if options.quick else ("ours", "paper-b")
    return [Job(f"first/{way}", "mission", options.seed, what | {"way": way, "eyes": EYES[way]}) for way in ways]


def calibrations(options: Options, profile: str, truth: str, count: int) -> list[Job]:
    """The nominal machine and the individuals, to be calibrated first; a quick look does without."""
    first = FIRST_SEED + SEEDS_PER_RUN * options.seed
    what = {"profile": profile, "truth": truth}
    nominal = Job(NOMINAL, "calibration", options.seed, what | {"truth": "nominal"})
    return [nominal, *(Job(f"machine/{i}", "calibration", first + i, what) for i in range(count))] if count else []


def missions(options: Options, profile: str, truth: str, trials: int, machines: Mapping[str, Any]) -> list[Job]:
    """Missions of ours on the individuals in turn, each on its own field.

    The seed makes the individual; the field has one of its own.
    """
    first = FIRST_SEED + SEEDS_PER_RUN * options.seed
    jobs = []
    for i in range(trials):
        text = machines[f"machine/{i % MACHINES}"]["profile"]
        if text is None:
            continue
        what: dict[str, Any] = {
            "profile": profile, "truth": truth, "file": str(FILE), "shuffled": True, "text": text, "way": "ours",
            "eyes": EYES["ours"], "field": first + MACHINES + i, "limit_s": LIMIT_S,
        }  # fmt: skip
        jobs.append(Job(f"mission/{i}", "mission", first + i % MACHINES, what))
    return jobs
