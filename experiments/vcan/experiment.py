"""The vcan experiment: ten demos and ten missions on SocketCAN in a row, with what the host took meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from rich.console import Console

from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Workers
from experiments.common.worlds import profile_named
from experiments.vcan.metrics import CONCLUSION, INTRODUCTION, KINDS, METRICS, SECTIONS, gather, seed_table
from experiments.vcan.trial import perform

TRIALS: Final = 10
QUICK_TRIALS: Final = 1
MAX_LOST_SHARE: Final = 0.01
"""Of the time of the runs, by the probe: a host that takes more is not quiet."""
MAX_LONGEST_MS: Final = 25.0
"""Half of a motion input's time-out."""


def run(options: Options, console: Console) -> Result:
    """Run all seeds one after the other; write ``options.out`` and, if requested, the docs.  Quick: one demo."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    kinds = list(KINDS)[: 1 if options.quick else None]
    common = {"out": str(options.out.resolve())}
    jobs = [Job(f"{kind}-{options.seed + i}", kind, options.seed + i, common) for kind in kinds for i in range(trials)]
    with checkpoint(options, (), ["palms_471", "aoro_fc8"], options.truth, (*LOCKSTEP_SOURCES, "host")) as kept:
        outcomes = pool.run(perform, jobs, kept, Workers(1), "vcan runs", console)
        result = make_result(
            "vcan", METRICS, gather(outcomes), profile=profile_named(options.profile).name, seed=options.seed,
            trials=trials, more=environment_of(outcomes), noisy=noisy(outcomes),
        )  # fmt: skip
        publish(result, page_of(result, {}), options, console)
    return result


def noisy(outcomes: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether the host took too much: by the probe beside the runs, or by the measurement that chose the clock."""
    wall_ms = sum(o["wall_s"] for o in outcomes.values()) * 1e3
    lost = sum(o["lost_ms"] for o in outcomes.values()) > MAX_LOST_SHARE * wall_ms
    long = any(o["longest_ms"] > MAX_LONGEST_MS for o in outcomes.values())
    return lost or long or any(o["clock"] == "simulated" for o in outcomes.values())


def environment_of(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Reasons of the chosen clocks and of the stops, by run."""
    clocks = {name: f"{o['clock']}: {o['clock_reason']}" for name, o in outcomes.items()}
    stops = {name: "; ".join(o["stop_reasons"]) for name, o in outcomes.items() if o["stop_reasons"]}
    probe = all(o["probe_real_time"] for o in outcomes.values())
    return {
        **{f"clock {name}": words for name, words in clocks.items()},
        **{f"stops {name}": words for name, words in stops.items()},
        "probe": "FIFO 99: the hypervisor alone delays it" if probe else "ordinary priority: other processes delay it",
    }


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """The result page."""
    *kinds, host = SECTIONS
    sections = (*kinds, replace(host, text=f"Seed by seed:\n\n{seed_table(result)}"))
    e = result.environment
    setting = (
        f"Commit `{result.commit}`. Host: {e['processor']}, {e['cpus']} cores, {e['machine']}, Python {e['python']}; "
        f"probe at {e['probe']}."
    )
    return Page("Live runs on SocketCAN", CONCLUSION, INTRODUCTION, sections, setting)
