"""The vcan experiment: ten demos and ten missions on SocketCAN in a row, with what the host took meanwhile.

A run is the command that a user types; its outcome is what its output, its summary and the host say about it.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common import host_activity, pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Metric, Result, make_result, mean, rate
from experiments.common.result_page import Page, Section, publish
from experiments.common.stall_witness import Witness
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint
from experiments.common.workers import Workers
from experiments.common.worlds import profile_named
from machine.status.explanation import describe
from machine.status.reasons import Reason

TRIALS: Final = 10
QUICK_TRIALS: Final = 1
MAX_LOST_SHARE: Final = 0.01
"""Of the time of the runs, by the witness: a host that takes more is not quiet."""
MAX_LONGEST_MS: Final = 25.0
"""Half of a motion input's time-out."""
MISSION: Final = "docs/examples/paper_b.geojson"
MISSION_LOGS: Final = 3
LIMIT_S: Final = 1800.0
"""Of the host; a run that takes longer is ended and counts as not done."""
PROBE_PRIORITY: Final = 99
LATE_US: Final = 500
"""Ordinary wake-ups are earlier."""
_CLOCK: Final = re.compile(r"^vcan lab: (real|simulated) time: (.*)$", re.MULTILINE)
_MODE: Final = re.compile(r"^ *[0-9.]+ s +(STOP|FAULT): (.*)$", re.MULTILINE)
KINDS: Final = {"demo": "one log into the bunk", "mission": "mission with three logs"}
CLOCKS: Final = ("real", "simulated", "native")
RUN_FIGURES: Final = ("done", "stops", "leases_lost", "refused", "missed_ticks", "seconds")
HOST_FIGURES: Final = ("wall_s", "steal_ms", "lost_ms", "longest_ms")
CONCLUSION: Final = tuple(
    f"{title}: {{{kind}_runs}} runs, {{{kind}_done}} done, {{{kind}_stops}} stops; {{{kind}_real}} in real time, "
    f"{{{kind}_simulated}} in simulated time."
    for kind, title in (("demo", "One log into the bunk"), ("mission", "Missions"))
)
INTRODUCTION: Final = (
    "Every run is the command that a user types, with a seed of its own: all processes of the machine on SocketCAN. "
    "Where the kernel has no vcan, they share user-mode Linux on one processor. Before such a run the command measures "
    "the processor time that the host takes, and chooses simulated time when too little is left; it says which. "
    "**Runs in simulated time show that the processes do their job and never that they do it in real time**, so they "
    "are counted apart, and the limit on real time is then inconclusive and never met."
)


_REAL: Final = "In user-mode Linux or natively; simulated only where the host's lost time leaves no other choice."


def _metrics(kind: str, title: str) -> Iterator[Metric]:
    yield Metric(f"{kind}_runs", f"Runs: {title}", "", "One seed each, one after the other.")
    yield Metric(f"{kind}_done", f"Done: {title}", "%", "By the plant's physics.", least=1.0)
    yield Metric(f"{kind}_stops", f"Stops: {title}", "", "All runs, whatever their clock.", most=0.0, clocked=True)
    yield Metric(f"{kind}_leases_lost", f"Ended leases among them: {title}", "", "Setpoints that came too late.")
    yield Metric(f"{kind}_refused", f"Refused setpoints: {title}", "", "By the controller, at the end of each run.")
    for clock, clock_text in (("real", "real time"), ("simulated", "simulated time")):
        yield Metric(f"{kind}_{clock}", f"Runs in {clock_text}: {title}", "", "As announced.")
        yield Metric(f"{kind}_{clock}_stops", f"Stops in {clock_text}: {title}", "", "Of these runs alone.")
    share = f"Share of runs in real time: {title}"
    yield Metric(f"{kind}_real_share", share, "%", _REAL, least=1.0, clocked=True)
    yield Metric(f"{kind}_wall_s", f"Duration on the host: {title}", "s", "Mean, with the start of every process.")


HOST: Final = (
    Metric("steal_ms", "Steal during the runs", "ms", "/proc/stat, all processors."),
    Metric("lost_ms", "Time lost by the witness", "ms", "It sleeps beside the run on the lab's processor at FIFO 99."),
    Metric("longest_ms", "Longest delay of the witness", "ms", "In all runs."),
)
SECTIONS: Final = (
    *(Section(title.capitalize(), "", tuple(_metrics(kind, title))) for kind, title in KINDS.items()),
    Section("The host", "", HOST),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


def run(options: Options, console: Console) -> Result:
    """Run all seeds one after the other; write ``options.out`` and, if requested, the docs.  Quick: one demo."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    kinds = list(KINDS)[: 1 if options.quick else None]
    common = {"out": str(options.out.resolve())}
    jobs = [Job(f"{kind}-{options.seed + i}", kind, options.seed + i, common) for kind in kinds for i in range(trials)]
    with checkpoint(options, (), ["palms_471", "aoro_fc8"], options.truth, (*LOCKSTEP_SOURCES, "host")) as trial_store:
        outcomes = pool.run(perform, jobs, trial_store, Workers(1), "vcan runs", console)
        result = make_result(
            "vcan",
            METRICS,
            gather(outcomes),
            profile=profile_named(options.profile).name,
            seed=options.seed,
            trials=trials,
            more=environment_of(outcomes),
            noisy=noisy(outcomes),
        )
        publish(result, page_of(result, {}), options, console)
    return result


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Compute all metrics, and the figures of every seed as KIND_SEED_FIGURE."""
    metrics: dict[str, float] = {}
    for kind in KINDS:
        runs = [o for o in outcomes.values() if o["kind"] == kind]
        if not runs:
            continue
        metrics |= {f"{kind}_runs": float(len(runs)), f"{kind}_wall_s": mean([o["wall_s"] for o in runs])}
        metrics |= rate(f"{kind}_done", sum(o["done"] and o["exit"] == 0 for o in runs), len(runs))
        for name in ("stops", "leases_lost", "refused"):
            metrics[f"{kind}_{name}"] = float(sum(o[name] for o in runs))
        for clock, these in (("real", ("real", "native")), ("simulated", ("simulated",))):
            chosen = [o for o in runs if o["clock"] in these]
            metrics[f"{kind}_{clock}"] = float(len(chosen))
            metrics[f"{kind}_{clock}_stops"] = float(sum(o["stops"] for o in chosen))
        metrics[f"{kind}_real_share"] = metrics[f"{kind}_real"] / len(runs)
        for o in runs:
            metrics |= {f"{kind}_{o['seed']}_{name}": float(o[name]) for name in (*RUN_FIGURES, *HOST_FIGURES)}
            metrics[f"{kind}_{o['seed']}_clock"] = float(CLOCKS.index(o["clock"]))
    runs = list(outcomes.values())
    metrics |= {name: sum(o[name] for o in runs) for name in ("steal_ms", "lost_ms")}
    return metrics | {"longest_ms": max((o["longest_ms"] for o in runs), default=0.0)}


def noisy(outcomes: Mapping[str, Mapping[str, Any]]) -> bool:
    """Tell whether the host took too much: by the witness beside the runs, or the measurement that chose the clock."""
    runs = outcomes.values()
    lost = sum(o["lost_ms"] for o in runs) > MAX_LOST_SHARE * 1e3 * sum(o["wall_s"] for o in runs)
    return lost or any(o["longest_ms"] > MAX_LONGEST_MS or o["clock"] == "simulated" for o in runs)


def environment_of(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Give the reasons of the chosen clocks and of the stops, by run."""
    clocks = {f"clock {name}": f"{o['clock']}: {o['clock_reason']}" for name, o in outcomes.items()}
    stops = {f"stops {name}": "; ".join(o["stop_reasons"]) for name, o in outcomes.items() if o["stop_reasons"]}
    probe = all(o["probe_real_time"] for o in outcomes.values())
    probe_text = "FIFO 99: the hypervisor alone delays it" if probe else "ordinary priority: other processes delay it"
    return {**clocks, **stops, "probe": probe_text}


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    host, probe = host_activity.sentence(result.environment), result.environment["probe"]
    setting = f"Commit `{result.commit}`. {host} The witness ran at {probe}."
    return Page("Live runs on SocketCAN", CONCLUSION, INTRODUCTION, SECTIONS, setting)


def command(kind: str, seed: int, out: Path) -> list[str]:
    """Write the user's command line for one run."""
    job = f"mission run {MISSION} --logs {MISSION_LOGS}" if kind == "mission" else "demo"
    arguments = f"{job} --detector perfect --bus vcan --seed {seed} --no-console --out"
    return [sys.executable, "-m", "timberhand", *arguments.split(), str(out)]


def perform(job: Job) -> dict[str, Any]:
    """Run it; the outcome as plain data.

    A witness beside it on the lab's processor, which is the last one, tells what the hypervisor took, also where
    /proc/stat reports none; without real-time priority other processes delay it, too.
    """
    out = Path(job.options["out"]) / job.name
    first_sample = host_activity.sample()
    with Witness(max(os.sched_getaffinity(0)), PROBE_PRIORITY, LATE_US) as witness:
        standard_output, standard_error, code = run_command(command(job.kind, job.seed, out))
    host = host_activity.between(first_sample, host_activity.sample())
    late_ms = [stall.stall_ns * 1e-6 for stall in witness.stalls()]
    summary = out / "summary.json"
    return {
        "kind": job.kind,
        "seed": job.seed,
        "exit": code,
        "wall_s": host.seconds,
        "steal_ms": host.steal_ms,
        "lost_ms": sum(late_ms),
        "longest_ms": max(late_ms, default=0.0),
        "probe_real_time": witness.real_time,
        **read_output(standard_output, standard_error),
        **read_summary(json.loads(summary.read_text()) if summary.exists() else {}),
    }


def run_command(words: Sequence[str]) -> tuple[str, str, int]:
    """Run a command; return its standard output, standard error and exit code, 124 when it took too long."""
    with subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            return *process.communicate(timeout=LIMIT_S), process.returncode
        except subprocess.TimeoutExpired:
            process.terminate()  # the lab forwards it; killed, the lab would go on beside the next run
            return *process.communicate(), 124
        finally:
            process.terminate()  # after Ctrl-C that reached this process alone


def read_output(told: str, said: str) -> dict[str, Any]:
    """Read the clock with its reason, reasons of the stops, ended leases."""
    clock = _CLOCK.search(said)
    reasons = [reason for _, reason in _MODE.findall(told)]
    return {
        "clock": clock[1] if clock else "native",
        "clock_reason": clock[2] if clock else "",
        "stop_reasons": reasons,
        "leases_lost": reasons.count(describe(Reason.LEASE_LOST)),
    }


def read_summary(summary: dict[str, Any]) -> dict[str, Any]:
    """Read whether the job is done by the plant's physics, stops, refused setpoints, missed ticks, machine time [s]."""
    missions = summary.get("finished", False) and summary.get("in_bunk") == summary.get("loaded")
    return {
        "done": bool(missions if "finished" in summary else summary.get("in_bunk", False)),
        "stops": int(summary.get("stops", 0)),
        "refused": int(summary.get("refused_setpoints", summary.get("refused", 0))),
        "missed_ticks": int(summary.get("missed_ticks", 0)),
        "seconds": float(summary.get("seconds", 0.0)),
    }
