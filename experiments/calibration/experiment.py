"""The calibration experiment: calibrates many individual machines and compares them with their truth.

Without ``--profile`` these are machines of both shipped kinds; with a profile of one's own, machines of that kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.calibration.metrics import (
    DEADBAND_PCT,
    DELAY_MS,
    GAIN,
    INTRODUCTION,
    conclusion,
    machines_of,
    metrics_in,
    metrics_of,
    sections,
)
from experiments.calibration.trial import calibrated
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.common.trials import LOCKSTEP_SOURCES, checkpoint, sampled_unless_given
from runtime.plot_style import MOSS, OIL, STEEL, limit_band, sheet

TRIALS: Final = 20
QUICK_TRIALS: Final = 1
FIRST_SEED: Final = 1000
"""These machines were not looked at while the procedure was developed."""
SEEDS_PER_RUN: Final = 1000


def run(options: Options, console: Console) -> Result:
    """Calibrate every machine; write ``options.out`` and, if requested, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    truth, machines = sampled_unless_given(options.truth), machines_of(options.profile)
    first_seed = FIRST_SEED + SEEDS_PER_RUN * options.seed
    jobs = [
        Job(f"{short}/{i}", "calibration", first_seed + i, {"profile": name, "truth": truth})
        for i in range(trials)
        for short, name in machines.items()
    ]
    with checkpoint(options, (), machines.values(), truth, LOCKSTEP_SOURCES) as trial_store:
        outcomes = pool.run(calibrated, jobs, trial_store, options.workers, "calibrations", console)
        by_machine = {m: [o for n, o in outcomes.items() if n.startswith(f"{m}/")] for m in machines}
        metrics: dict[str, float] = {}
        for short, machine_outcomes in by_machine.items():
            metrics |= metrics_of(short, machines[short], machine_outcomes)
            draw(options.out / f"errors_{short}.png", machine_outcomes)
        result = make_result(
            "calibration",
            metrics_in(metrics),
            metrics,
            profile=" and ".join(machines.values()),
            seed=options.seed,
            trials=trials,
            more={"truth": truth},
        )
        for short, machine_outcomes in by_machine.items():
            for outcome in machine_outcomes:
                if outcome["failure"] or outcome.get("implausible"):
                    why = outcome["failure"] or "; ".join(outcome["implausible"])
                    console.print(f"{machines[short]} seed {outcome['seed']}: {why}", highlight=False)
        publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Calibration experiment", conclusion(result.metrics), INTRODUCTION, sections(result.metrics))


def draw(path: Path, outcomes: Sequence[dict[str, Any]]) -> None:
    """Plot the errors of every joint: dead-band, full speed, dead time."""
    ended = [o for o in outcomes if not o["failure"]]
    names = list(dict.fromkeys(n for o in ended for n in o["joints"]))
    with sheet(path, 3, 9.0, 3.0) as (deadband, gain, delay):
        for x, name in enumerate(names):
            joint_errors = [o["joints"][name] for o in ended]
            for axis, values in (
                (deadband, [r["deadband_pct"] for r in joint_errors]),
                (gain, [[100.0 * e for e in r["gain"]] for r in joint_errors]),
                (delay, [[r["delay_ms"]] for r in joint_errors]),
            ):
                for i, color in ((0, OIL), (-1, MOSS)):
                    axis.plot(
                        [x + 0.12 * (1 if i else -1)] * len(values), [v[i] for v in values], ".", ms=4, color=color
                    )
        for axis, title, bound in (
            (deadband, "dead-band error [% of spool]", DEADBAND_PCT),
            (gain, "full speed error [%]", 100.0 * GAIN),
            (delay, "dead time error [ms]", DELAY_MS),
        ):
            axis.set(title=title, xticks=range(len(names)), xticklabels=names, ylim=(-1.4 * bound, 1.4 * bound))
            limit_band(axis, -bound, bound)
            axis.axhline(0.0, color=STEEL, lw=0.6)
