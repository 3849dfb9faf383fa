"""``timberhand experiment NAME``: measures, writes result.json and plots, and fails when a figure is missed."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from experiments.common.registry import EXPERIMENTS

Name = StrEnum("Name", {name.upper().replace("-", "_"): name for name in EXPERIMENTS})


class Bus(StrEnum):
    """Where the frames of a live experiment travel."""

    WIRE = "wire"
    VCAN = "vcan"


def experiment(
    name: Annotated[
        Name, typer.Argument(metavar="NAME", help="; ".join(f"{n}: {e.sentence}" for n, e in EXPERIMENTS.items()))
    ],
    trials: Annotated[
        int | None, typer.Option(min=1, help="Trials of each kind (default: the experiment's own).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same figures (but for timings).")] = 1,
    truth: Annotated[str, typer.Option(help="The plant's hidden truth: nominal, sampled, or a TOML file.")] = "nominal",
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "palms_471",
    out: Annotated[Path | None, typer.Option(help="Where the results go (default: runs/NAME).")] = None,
    quick: Annotated[bool, typer.Option(help="A few trials of everything, in under a minute.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: one per core).")] = None,
    docs: Annotated[
        Path | None, typer.Option(help="Also refresh the page, the pictures and results/NAME.json in this folder.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="soak: how long (default: 30).")] = None,
    repetitions: Annotated[
        int | None, typer.Option(min=1, help="crane-accuracy: motions to every goal of a machine (default: 20).")
    ] = None,
    bus: Annotated[Bus, typer.Option(help="soak: vcan (in user-mode Linux if need be) or the wire.")] = Bus.WIRE,
    data: Annotated[
        Path | None, typer.Option(help="grasp-network: judge the shipped weights on this folder in the Cornell layout.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print result.json on stdout.")] = False,
) -> None:
    """Run an experiment, judge its figures and write DIR/result.json with its plots.

    Exit code 6 when a figure is not reached. Ctrl-C keeps the finished trials; the same command goes on from there.

    [bold]Examples[/bold]

      timberhand experiment plant --quick                   a look, in a minute

      timberhand experiment plant --docs docs               the committed figures and docs/plant.md

      timberhand experiment plant --truth sampled --seed 7  every trial on another individual machine

      timberhand experiment timing --docs docs              a quarter of an hour on a quiet machine, as root for FIFO

      timberhand experiment soak --bus vcan --minutes 30    half an hour on SocketCAN
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
            f"interrupted; finished trials are kept in {options.out}, the same command goes on",
            ExitCode.INTERRUPTED,
        ) from None
    if as_json:
        print(result.json())
    if result.missed:
        raise CommandFailed(
            "experiment.figure-missed",
            f"figures not reached: {', '.join(result.missed)}; see {options.out / 'result.json'}",
            ExitCode.FIGURE_MISSED,
        )
