"""``timberhand campaign NAME``: many trials of an experiment on this computer or on a cluster, kept and counted."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.common.registry import EXPERIMENTS
from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import (
    ForeignDetectorOption,
    ForeignPlannerOption,
    ProfileOption,
    TruthOption,
    check_foreign,
)

if TYPE_CHECKING:
    from experiments.common.campaign import Campaign

    Name = StrEnum("Name", "NAME")
else:
    Name = StrEnum("Name", {n.upper().replace("-", "_"): n for n, entry in EXPERIMENTS.items() if not entry.live})


def campaign(
    name: Annotated[Name, typer.Argument(metavar="EXPERIMENT", help=f"One of {', '.join(Name)}.")],
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
        raise CommandFailed(
            "experiment.interrupted",
            f"interrupted; finished trials are kept in {options.out}, the same command continues",
            ExitCode.INTERRUPTED,
        ) from None
    if as_json:
        print((options.out / campaigns.SUMMARY).read_text(), end="")
    else:
        print("\n".join(_words(summary, options.out / campaigns.TABLE)))
    if result.missed:
        raise CommandFailed(
            "experiment.figure-missed",
            f"figures missed: {', '.join(result.missed)}; see {options.out / 'result.json'}",
            ExitCode.FIGURE_MISSED,
        )


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
