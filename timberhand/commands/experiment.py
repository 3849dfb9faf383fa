"""``timberhand experiment NAME``: measure, write result.json and plots, fail when a figure is missed."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.common.registry import EXPERIMENTS
from timberhand.commands.options import ProfileOption, TruthOption

if TYPE_CHECKING:
    Name = StrEnum("Name", "NAME")
else:
    Name = StrEnum("Name", {name.upper().replace("-", "_"): name for name in EXPERIMENTS})


class Bus(StrEnum):
    """The bus of a live experiment."""

    WIRE = "wire"
    VCAN = "vcan"


def experiment(
    name: Annotated[
        Name, typer.Argument(metavar="NAME", help="; ".join(f"{n}: {e.sentence}" for n, e in EXPERIMENTS.items()))
    ],
    trials: Annotated[
        int | None, typer.Option(min=1, help="Trials of each kind (default: as in the experiment).")
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same figures, except timings.")] = 1,
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
        typer.Option(help="grasp-network: folder of Cornell samples on which to evaluate the shipped weights."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print result.json on stdout.")] = False,
) -> None:
    """Run an experiment, evaluate its figures, and write result.json and plots.

    Exit code 6 when a figure is missed. Ctrl-C keeps the finished trials; the
    same command continues from there.

    [bold]Examples[/bold]

      timberhand experiment plant --quick

      timberhand experiment plant --docs docs

      timberhand experiment plant --truth sampled --seed 7

      sudo timberhand experiment timing       on a quiet computer, 15 minutes

      timberhand experiment soak --bus vcan --minutes 30
    """
    from rich.console import Console

    from experiments.common.registry import Options, load
    from host.exit_codes import CommandFailed, ExitCode
    from machine.loading.profile_file import ProfileError, load_profile

    if bus is Bus.VCAN and "TIMBERHAND_LAB" not in os.environ:
        from host.vcan_lab.__main__ import vcan

        vcan([sys.executable, "-m", "timberhand", *sys.argv[1:]])
    try:
        load_profile(profile)
    except ProfileError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    options = Options(
        seed=seed,
        truth=truth,
        profile=profile,
        out=out or Path("runs") / name.value,
        trials=trials,
        quick=quick,
        workers=workers or len(os.sched_getaffinity(0)),
        docs=docs,
        minutes=minutes,
        repetitions=repetitions,
        bus=bus.value,
        data=data,
    )
    screen = Console(stderr=True)
    try:
        result = load(name.value)(options, screen)
    except KeyboardInterrupt:
        raise CommandFailed(
            "experiment.interrupted",
            f"interrupted; finished trials are kept in {options.out}, the same command continues",
            ExitCode.INTERRUPTED,
        ) from None
    if as_json:
        print(result.json())
    if result.missed:
        raise CommandFailed(
            "experiment.figure-missed",
            f"figures missed: {', '.join(result.missed)}; see {options.out / 'result.json'}",
            ExitCode.FIGURE_MISSED,
        )
