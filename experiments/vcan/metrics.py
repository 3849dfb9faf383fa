"""Metrics of the vcan experiment with their limits, and the page that shows them, with one line per seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from experiments.common.result import Metric, Result, mean, rate
from experiments.common.result_page import Section

KINDS: Final = {"demo": "one log into the bunk", "mission": "mission with three logs"}
CLOCKS: Final = ("real", "simulated", "native")
SEED_FIGURES: Final = (
    "done", "stops", "leases_lost", "refused", "missed_ticks", "seconds", "wall_s", "steal_ms", "lost_ms", "longest_ms",
)  # fmt: skip
CONCLUSION: Final = (
    "One log into the bunk: {demo_runs} runs, {demo_done} done, {demo_stops} stops; {demo_real} in real time, "
    "{demo_simulated} in simulated time.",
    "Missions: {mission_runs} runs, {mission_done} done, {mission_stops} stops; {mission_real} in real time, "
    "{mission_simulated} in simulated time.",
)
INTRODUCTION: Final = (
    "Every run is the command that a user types, with a seed of its own: all processes of the machine on SocketCAN. "
    "Where the kernel has no vcan, they share user-mode Linux on one processor. Before such a run the command measures "
    "the processor time that the host takes, and chooses simulated time when too little is left; it says which. "
    "**Runs in simulated time show that the processes do their job and never that they do it in real time**, so they "
    "are counted apart, and the limit on real time is then inconclusive and never met."
)


def _metrics(kind: str, title: str) -> Iterator[Metric]:
    yield Metric(f"{kind}_runs", f"Runs: {title}", "", "One seed each, one after the other.")
    yield Metric(f"{kind}_done", f"Done: {title}", "%", "By the plant's physics.", least=1.0, scale=100.0)
    yield Metric(f"{kind}_stops", f"Stops: {title}", "", "All runs, whatever their clock.", most=0.0, clocked=True)
    yield Metric(f"{kind}_leases_lost", f"Ended leases among them: {title}", "", "Setpoints that came too late.")
    yield Metric(f"{kind}_refused", f"Refused setpoints: {title}", "", "By the controller, at the end of each run.")
    for clock, words in (("real", "real time"), ("simulated", "simulated time")):
        yield Metric(f"{kind}_{clock}", f"Runs in {words}: {title}", "", "As announced.")
        yield Metric(f"{kind}_{clock}_stops", f"Stops in {words}: {title}", "", "Of these runs alone.")
    yield Metric(
        f"{kind}_real_share", f"Share of runs in real time: {title}", "%",
        "In user-mode Linux or natively; simulated only where the host's lost time leaves no other choice.",
        least=1.0, scale=100.0, clocked=True,
    )  # fmt: skip
    yield Metric(f"{kind}_wall_s", f"Duration on the host: {title}", "s", "Mean, with the start of every process.")


HOST: Final = (
    Metric("steal_ms", "Steal during the runs", "ms", "/proc/stat, all processors."),
    Metric("lost_ms", "Time lost by the probe", "ms", "It sleeps beside the run on the lab's processor at FIFO 99."),
    Metric("longest_ms", "Longest delay of the probe", "ms", "In all runs."),
)
SECTIONS: Final = (
    *(Section(title.capitalize(), "", tuple(_metrics(kind, title))) for kind, title in KINDS.items()),
    Section("The host", "", HOST),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


def gather(outcomes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """All metrics, and the figures of every seed as KIND_SEED_FIGURE."""
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
            metrics |= {f"{kind}_{o['seed']}_{name}": float(o[name]) for name in SEED_FIGURES}
            metrics[f"{kind}_{o['seed']}_clock"] = float(CLOCKS.index(o["clock"]))
    runs = list(outcomes.values())
    metrics |= {name: sum(o[name] for o in runs) for name in ("steal_ms", "lost_ms")}
    return metrics | {"longest_ms": max((o["longest_ms"] for o in runs), default=0.0)}


def seed_table(result: Result) -> str:
    """One line per run, as Markdown."""
    head = "| run | seed | clock | done | stops | leases lost | refused | machine time | wall time | steal | lost |"
    lines = [head, "|---|---|---|---|---|---|---|---|---|---|---|"]
    for kind in KINDS:
        seeds = sorted(int(name.split("_")[1]) for name in result.metrics if is_seed_clock(name, kind))
        for seed in seeds:
            value = {name: result.metrics[f"{kind}_{seed}_{name}"] for name in (*SEED_FIGURES, "clock")}
            lines.append(
                f"| {kind} | {seed} | {CLOCKS[int(value['clock'])]} | {'yes' if value['done'] else 'no'} | "
                f"{value['stops']:.0f} | {value['leases_lost']:.0f} | {value['refused']:.0f} | "
                f"{value['seconds']:.1f} s | {value['wall_s']:.1f} s | {value['steal_ms']:.0f} ms | "
                f"{value['lost_ms']:.0f} ms |"
            )
    return "\n".join(lines)


def is_seed_clock(name: str, kind: str) -> bool:
    """Whether a metric is the clock of one run of a kind."""
    words = name.split("_")
    return len(words) == 3 and words[0] == kind and words[1].isdigit() and words[2] == "clock"
