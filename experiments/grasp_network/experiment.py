"""The grasp-network experiment: counts parameters, cross-validates if data are available, measures latency."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from autonomy.grasp.network import PAPER as NETWORK
from autonomy.grasp.network import WEIGHTS, GraspNet, normalized_relief
from autonomy.networks import load
from experiments.common import pool
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import ROOT, Result, make_result, rate
from experiments.common.result_page import Page, publish
from experiments.grasp_network import folds, latency
from experiments.grasp_network.metrics import CONCLUSION, INTRODUCTION, METRICS, PAPER, SECTIONS
from experiments.grasp_network.plots import draw
from host.exit_codes import CommandFailed, ExitCode

ROUNDS: Final = 80
QUICK_ROUNDS: Final = 15
CORNELL: Final = "cornell_rgbd_01"


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    With ``options.data`` the shipped weights are evaluated on that folder instead of a cross-validation.

    Raises:
        CommandFailed: no torch, no usable weights, or a folder without samples.
    """
    try:
        import torch
    except ImportError:
        raise CommandFailed(
            "grasp-network.no-torch",
            "the experiment compares with torch: pip install 'timberhand[train]'",
            ExitCode.CONFIGURATION,
        ) from None
    from runtime.errors import InputRefused
    from training.common.weight_file import parameter_count
    from training.grasp.network_training import GraspNetwork

    metrics = {"parameters": float(parameter_count(GraspNetwork()))}
    try:
        weights = load(WEIGHTS, NETWORK)
        skipped, pictures = _cornell(options, metrics, console)
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    scenes = [picture for _, picture in latency.log_scenes(options.seed)]
    with console.status("timing"):
        paths = latency.inference_paths(weights)
        times = latency.times_ms(paths, scenes, QUICK_ROUNDS if options.quick else ROUNDS)
        metrics |= latency.metrics(times, latency.agreement(paths, [*scenes, *pictures]))
    metrics["prepare_ms"] = _prepare_ms(options.seed)
    result = make_result(
        "grasp-network",
        METRICS,
        metrics,
        profile="",
        seed=options.seed,
        trials=len(pictures),
        more={"torch": torch.__version__, "skipped": skipped},
        paper=PAPER,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    draw(metrics, times, GraspNet(), options.seed, options.out)
    publish(result, page_of(result, {}), options, console)
    (options.out / "folds.jsonl").unlink(missing_ok=True)
    if skipped:
        console.print(f"[yellow]skipped:[/yellow] {skipped}", highlight=False)
    return result


def _cornell(options: Options, metrics: dict[str, float], console: Console) -> tuple[str, list[np.ndarray]]:
    """Add to ``metrics``; returns what was skipped and why, and the available pictures as network inputs."""
    from training.grasp.cornell import load as load_samples
    from training.grasp.cornell_weights import on_samples
    from training.grasp.network_training import central_view, view_depth

    folder = options.data or data_root() / CORNELL
    if options.data is None and not folder.is_dir():
        return f"both cross-validations (no Cornell samples under {CORNELL} in TIMBERHAND_DATA)", []
    samples = load_samples(folder)
    pictures = [
        normalized_relief(view_depth(s.depth_m, central_view(s.depth_m)))[None, None]
        for s in samples[:: 8 if options.quick else 1]
    ]
    if options.data is not None:
        net = GraspNet()
        evaluations = on_samples(net, samples, net.facts)
        metrics |= rate("data_right", sum(f["right"] for f in evaluations), len(evaluations))
        metrics |= rate("data_own_size", sum(f["own_size"] for f in evaluations), len(evaluations))
        metrics["data_trained_on"] = float(sum(f["trained_on"] for f in evaluations))
        return "both cross-validations (--data evaluates the shipped weights)", pictures
    if options.quick:
        return "both cross-validations (--quick)", pictures
    metrics |= cross_validated(options, folder, samples, console)
    return "", pictures


def cross_validated(options: Options, folder: Path, samples: Any, console: Console) -> dict[str, float]:
    """Run both cross-validations; finished folds are kept until the whole run is done."""
    from training.grasp.network_training import EPOCHS

    plain = {"data": str(folder), "epochs": EPOCHS}
    jobs = [
        Job(f"{kind}-{i}", kind, options.seed, {**plain, "fold": i}) for kind in folds.KINDS for i in range(folds.FOLDS)
    ]
    checkpoint = pool.Checkpoint(options.out / "folds.jsonl", folds.identity(samples, options.seed, EPOCHS))
    with closing(checkpoint):
        return gather(pool.run(folds.perform, jobs, checkpoint, options.workers, "folds", console))


def gather(outcomes: dict[str, list[dict[str, Any]]]) -> dict[str, float]:
    """Compute the success rates of both cross-validations."""
    metrics: dict[str, float] = {}
    for kind, name in zip(folds.KINDS, ("cornell_grouped", "cornell_paper_split"), strict=True):
        trials = [t for job, results in outcomes.items() if job.startswith(f"{kind}-") for t in results]
        metrics |= rate(name, sum(t["right"] for t in trials), len(trials))
        metrics |= rate(f"{name}_own_size", sum(t["own_size"] for t in trials), len(trials))
    return metrics


def data_root() -> Path:
    """Return the folder of the third-party data: TIMBERHAND_DATA, otherwise beside the checkout."""
    return Path(os.environ.get("TIMBERHAND_DATA", ROOT.parent / "shared" / "data"))


def _prepare_ms(seed: int) -> float:
    times_ms = []
    for depth, _ in latency.log_scenes(seed):
        start_ns = time.process_time_ns()
        normalized_relief(depth)
        times_ms.append((time.process_time_ns() - start_ns) / 1e6)
    return float(np.median(times_ms))


def _setting(result: Result) -> str:
    from training.grasp.network_training import BATCH, EPOCHS, LEARNING_RATE, VIEWS_PER_SAMPLE

    e = result.environment
    return (
        f"Seed {result.seed}, commit `{result.commit}`. Training of every fold: {EPOCHS} epochs of {VIEWS_PER_SAMPLE} "
        f"views a sample, batches of {BATCH}, AdamW with {LEARNING_RATE} and a cosine; one schedule, set before the "
        "folds were evaluated; preprocessing and views were chosen on some of these samples, so both rates may be "
        f"slightly too high. Host: {e['processor']}, {e['cpus']} cores, {e['machine']}, Python {e['python']}, "
        f"torch {e['torch']}."
    )


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    return Page("Grasp network", CONCLUSION, INTRODUCTION, SECTIONS, _setting(result))
