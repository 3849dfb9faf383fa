"""``timberhand demo``: the main job, a log goes from the ground into the bunk."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hil.exits import Exit, Stopped


class Backend(StrEnum):
    """Where the frames travel."""

    AUTO = "auto"
    WIRE = "wire"
    VCAN = "vcan"


def demo(
    lockstep: Annotated[bool, typer.Option(help="Virtual time in one process, bit-identical for a seed.")] = False,
    seed: Annotated[int, typer.Option(help="Chooses the log and where it lies.")] = 1,
    bus: Annotated[
        Backend, typer.Option(help="vcan (in user-mode Linux if need be), the wire, or what is there.")
    ] = Backend.AUTO,
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "palms_471",
    truth: Annotated[str, typer.Option(help="The plant's hidden truth: nominal, sampled, or a TOML file.")] = "nominal",
    out: Annotated[
        Path | None, typer.Option(help="Directory of the run's logs (default: a new one under runs/).")
    ] = None,
    console: Annotated[bool, typer.Option(help="Serve the page that shows the crane.")] = True,
    console_port: Annotated[int, typer.Option(help="Port of the page on localhost.")] = 8471,
    limit_s: Annotated[float, typer.Option(help="Give up after so many seconds.")] = 300.0,
    patience: Annotated[int, typer.Option(help="How many stops the stand-in operator arms again after (live).")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")] = False,
) -> None:
    """A log goes from the ground into the bunk, over CAN.

    The exit code is 0 only if the log truly lies in the bunk, judged by the plant's physics.

    [bold]Examples[/bold]

      timberhand demo                        live, on the bus that is there, with the page

      timberhand demo --bus vcan --seed 3    live on real SocketCAN

      timberhand demo --lockstep --seed 3    the same job in virtual time
    """
    from rich.console import Console

    from machine.load import ProfileError, load_profile

    if bus is Backend.VCAN and not lockstep and "TIMBERHAND_LAB" not in os.environ:
        from hil.vcan_lab.__main__ import vcan

        vcan([sys.executable, "-m", "timberhand", *_without_page(sys.argv[1:])])
    try:
        load_profile(profile)
    except ProfileError as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from None
    directory = out or _new_directory(f"{'lockstep' if lockstep else bus.value}-seed{seed}")
    screen = Console(stderr=as_json)
    if lockstep:
        from hil.demo import run_lockstep

        summary = run_lockstep(profile, seed, truth, directory, limit_s, screen)
    else:
        from hil.demo import run_live

        page = console_port if console else 0
        summary = run_live(profile, seed, truth, bus.value, directory, page, limit_s, patience, screen)
    summary.show(screen)
    summary.save(directory / "summary.json")
    if as_json:
        print(json.dumps(asdict(summary)))
    raise typer.Exit(summary.exit)


def _without_page(arguments: list[str]) -> list[str]:
    """Inside user-mode Linux nobody can reach the page, so it is not started there."""
    return arguments if "--no-console" in arguments else [*arguments, "--no-console"]


def _new_directory(name: str) -> Path:
    """``runs/<name>-<n>`` with the first free n, and ``runs/LAST`` pointing at it."""
    runs = Path("runs")
    number = 1
    while (directory := runs / f"{name}-{number}").exists():
        number += 1
    runs.mkdir(exist_ok=True)
    last = runs / "LAST"
    last.unlink(missing_ok=True)
    last.symlink_to(directory.name)
    return directory
