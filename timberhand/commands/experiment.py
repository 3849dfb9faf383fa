"""``timberhand experiment NAME``: measure, write result.json and plots, fail when a figure is missed.

``timberhand campaign NAME``: many trials of an experiment on this computer or on a cluster, kept and counted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from experiments.common.registry import EXPERIMENTS
from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import (
    ForeignDetectorOption,
    ForeignPlannerOption,
    ProfileOption,
    TruthOption,
    check_foreign,
    refuse_without_effect,
    truth_of,
)

ALL: Final = "all"

if TYPE_CHECKING:
    from experiments.common.campaign import Campaign

    Name = StrEnum("Name", "NAME")
    CampaignName = StrEnum("CampaignName", "NAME")
else:

    def _names(*names: str) -> type[StrEnum]:
        return StrEnum("Name", {name.upper().replace("-", "_"): name for name in names})

    Name = _names(*EXPERIMENTS, ALL)
    CampaignName = _names(*(name for name, entry in EXPERIMENTS.items() if not entry.live))


class Bus(StrEnum):
    """The bus of a live experiment."""

    WIRE = "wire"
    VCAN = "vcan"


READERS: Final = {
    "minutes": ("soak", "faults"),
    "repetitions": ("crane-accuracy",),
    "bus": ("soak",),
    "data": ("grasp-network", "detector"),
}
"""The experiments that read a parameter which the others have no use for."""


def experiment(
    context: typer.Context,
    name: Annotated[
        Name,
        typer.Argument(
            metavar="NAME",
            help="; ".join(
                (*(f"{n}: {e.sentence}" for n, e in EXPERIMENTS.items()), "all: every experiment, after an estimate.")
            ),
        ),
    ],
    trials: Annotated[
        int | None, typer.Option(min=1, help="Trials of each kind (default: as in the experiment).")
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same figures, except timings.")] = 1,
    sealed: Annotated[
        bool,
        typer.Option("--sealed", help="Draw the seed from the commit's hash, so that nobody can have tuned on it."),
    ] = False,
    truth: TruthOption = "nominal",
    profile: ProfileOption = "palms_471",
    out: Annotated[Path | None, typer.Option(help="Directory of the results (default: runs/NAME).")] = None,
    quick: Annotated[bool, typer.Option(help="A few trials of each kind, in less than a minute.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes (default: one per core).")] = None,
    docs: Annotated[
        Path | None, typer.Option(help="Folder in which to update the page, its plots and results/NAME.json.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="soak: duration in minutes (default: 30); faults: time limit, the same command continues."
        ),
    ] = None,
    repetitions: Annotated[
        int | None, typer.Option(min=1, help="crane-accuracy: motions to every goal (default: 20).")
    ] = None,
    bus: Annotated[Bus, typer.Option(help="soak: vcan (in user-mode Linux if necessary) or wire.")] = Bus.WIRE,
    data: Annotated[
        Path | None,
        typer.Option(
            help="grasp-network: folder of Cornell samples on which to evaluate the shipped weights; detector: folder "
            "of photographs."
        ),
    ] = None,
    planner: ForeignPlannerOption = "",
    detector: ForeignDetectorOption = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print result.json on stdout.")] = False,
) -> None:
    """Run an experiment, evaluate its figures, and write result.json and plots.

    Exit code 6 when a figure is missed. Ctrl-C keeps the finished trials; the
    same command continues from there.

    [bold]Examples[/bold]

      timberhand experiment plant --quick

      timberhand experiment plant --docs docs

      timberhand experiment plant --truth sampled --seed 7

      timberhand experiment navigation --sealed       trials that nobody has seen

      timberhand experiment all --quick               everything once, those in real time left out

      sudo timberhand experiment timing       on a quiet computer, 15 minutes

      timberhand experiment soak --bus vcan --minutes 30
    """
    from rich.console import Console

    from experiments.common.registry import Options, load
    from experiments.common.result import ROOT, commit, sealed_seed
    from experiments.common.standing import CHANGES, UNKNOWN
    from experiments.common.workers import Workers

    if name.value != ALL:
        useless = [parameter for parameter, readers in READERS.items() if name.value not in readers]
        refuse_without_effect(context, useless, f"on {name.value}")
    if bus is Bus.VCAN and "TIMBERHAND_LAB" not in os.environ:
        from host.vcan_lab.__main__ import vcan

        vcan([sys.executable, "-m", "timberhand", *sys.argv[1:]])
    truth = truth_of(profile, truth)
    into_checkout = docs is not None and docs.resolve().is_relative_to(ROOT)
    if (into_checkout or sealed) and (commit().endswith(CHANGES) or commit() == UNKNOWN):
        raise CommandFailed(
            "experiment.uncommitted",
            "the sources are not those of a commit; a page must name one, and a sealed seed is drawn from one: commit "
            "the changes first, or leave out --sealed and write to a folder outside the checkout with --docs",
        )
    if name.value == ALL:
        if any((sealed, as_json, planner, detector, trials, minutes, repetitions, data)) or bus is not Bus.WIRE:
            raise typer.BadParameter("all takes --quick, --seed, --truth, --profile, --workers, --docs and --out only")
        common = ["--seed", str(seed), "--truth", truth, "--profile", profile]
        _all(quick, workers, common, docs, out or Path("runs") / ALL)
        return
    check_foreign(name.value, planner, detector)
    options = Options(
        seed=sealed_seed(commit(), name.value) if sealed else seed,
        truth=truth,
        profile=profile,
        out=out or Path("runs") / name.value,
        trials=trials,
        quick=quick,
        workers=Workers(workers or len(os.sched_getaffinity(0))),
        docs=docs,
        minutes=minutes,
        repetitions=repetitions,
        bus=bus.value,
        data=data,
        planner=planner,
        detector=detector,
    )
    screen = Console(stderr=True)
    try:
        result = load(name.value)(options, screen)
    except KeyboardInterrupt:
        raise _interrupted(options.out) from None
    if as_json:
        print(result.json())
    if result.missed:
        raise _missed(result.missed, options.out)


def _all(quick: bool, workers: int | None, common: list[str], docs: Path | None, out: Path) -> None:
    """Run every experiment: the quick pass, and unless that was asked for, the estimate and the full runs."""
    from rich.console import Console

    from experiments.common import all_experiments as every

    screen, count = Console(stderr=True), workers or len(os.sched_getaffinity(0))
    common = ["--workers", str(count), *common]
    try:
        outcomes = every.perform(True, common, out / "quick", screen)
        if not quick:
            every.show_estimate(every.estimate_h(outcomes, count), screen)
            outcomes = every.perform(False, [*common, *(["--docs", str(docs)] if docs else [])], out, screen)
    except KeyboardInterrupt:
        raise _interrupted(out) from None
    every.show(outcomes, screen)
    failed = [outcome.name for outcome in outcomes if outcome.code not in (ExitCode.OK, ExitCode.FIGURE_MISSED)]
    if failed:
        raise CommandFailed(
            "experiment.failed",
            f"{', '.join(failed)} did not end with a result; run them one by one: timberhand experiment NAME",
        )
    missed = [outcome.name for outcome in outcomes if outcome.code == ExitCode.FIGURE_MISSED]
    if missed and not quick:
        raise CommandFailed(
            "experiment.figure-missed", f"figures missed in: {', '.join(missed)}; see {out}", ExitCode.FIGURE_MISSED
        )


def _interrupted(out: Path) -> CommandFailed:
    return CommandFailed(
        "experiment.interrupted",
        f"interrupted; finished trials are kept in {out}, the same command continues",
        ExitCode.INTERRUPTED,
    )


def _missed(figures: Sequence[str], out: Path) -> CommandFailed:
    return CommandFailed(
        "experiment.figure-missed",
        f"figures missed: {', '.join(figures)}; see {out / 'result.json'}",
        ExitCode.FIGURE_MISSED,
    )


def campaign(
    name: Annotated[CampaignName, typer.Argument(metavar="EXPERIMENT", help=f"One of {', '.join(CampaignName)}.")],
    trials: Annotated[
        int | None, typer.Option(min=1, help="Trials of each kind (default: as in the experiment).")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes (default: one per core).")] = None,
    ray: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Ray cluster: auto for that of this node, or HOST:PORT.")
    ] = "",
    recordings: Annotated[int, typer.Option(min=0, help="Failed trials to record; each is performed once more.")] = 10,
    seed: Annotated[int, typer.Option(help="The same seed gives the same table.")] = 1,
    truth: TruthOption = "nominal",
    profile: ProfileOption = "palms_471",
    quick: Annotated[bool, typer.Option(help="The trials of the experiment's --quick.")] = False,
    out: Annotated[Path | None, typer.Option(help="Directory of the campaign (default: runs/campaign/NAME).")] = None,
    planner: ForeignPlannerOption = "",
    detector: ForeignDetectorOption = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print campaign.json on stdout.")] = False,
) -> None:
    """Perform many trials, on all cores or on a Ray cluster, and keep them.

    The table is the same bytes wherever the trials ran, except for faults. Ctrl-C
    keeps the finished trials; the same command continues, also with more trials.
    Failed trials are recorded.

    [bold]Examples[/bold]

      timberhand campaign grasp-configs --trials 1000

      timberhand campaign plc --trials 20 --workers 2 --out runs/plc-night

      timberhand campaign generalization --trials 10000 --ray auto
    """
    from rich.console import Console

    from experiments.common import campaign as campaigns
    from experiments.common.registry import Options
    from experiments.common.workers import Workers
    from machine.loading.profile_file import load_profile

    load_profile(profile)
    check_foreign(name.value, planner, detector)
    options = Options(
        seed=seed,
        truth=truth,
        profile=profile,
        out=out or Path("runs") / "campaign" / name.value,
        trials=trials,
        quick=quick,
        workers=Workers(workers or len(os.sched_getaffinity(0)), ray),
        planner=planner,
        detector=detector,
    )
    try:
        result, summary = campaigns.run(name.value, options, recordings, Console(stderr=True))
    except KeyboardInterrupt:
        raise _interrupted(options.out) from None
    if as_json:
        print((options.out / campaigns.SUMMARY).read_text(), end="")
    else:
        print("\n".join(_words(summary, options.out / campaigns.TABLE)))
    if result.missed:
        raise _missed(result.missed, options.out)


def _words(found: Campaign, table: Path) -> list[str]:
    from experiments.common.campaign import recording_of

    between = "" if found.overhead_s is None else f", {1e3 * found.overhead_s:.0f} ms between two of them"
    lines = [
        f"{found.trials} trials, {found.failures} failed; {table}, SHA-256 {found.table_sha256[:16]}",
        f"{found.seconds:.2f} s a trial (at most {found.seconds_max:.2f}){between}; workers: {found.workers}, at most "
        f"{found.worker_bytes / 2**20:.0f} MiB each; {_size(found.table_bytes)} a trial in the table, "
        f"{_size(found.kept_bytes)} on the disk",
    ]
    for trial in found.recorded:
        note = "" if trial.repeated else "  (the repetition did not fail in the same way: the trial is not repeatable)"
        lines.append(f"failed {trial.name}: timberhand console --replay {recording_of(Path(trial.recording))}{note}")
    return lines


def _size(count: float) -> str:
    """Write bytes in words."""
    return f"{count:.0f} B" if count < 1e4 else f"{count / 1e3:.0f} kB"
