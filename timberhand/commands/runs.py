"""What the commands that run a machine share: the choice of bus, the vcan lab, the directory and the end of a run."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from enum import StrEnum
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn

import typer

from host.exit_codes import CommandFailed

if TYPE_CHECKING:
    from rich.console import Console

    from hil.demo.summary import Summary
    from hil.missions.summary import MissionSummary


class Backend(StrEnum):
    """The bus that carries the frames."""

    AUTO = "auto"
    WIRE = "wire"
    VCAN = "vcan"
    PYTHON_CAN = "python-can"
    """vcan, through python-can's socket instead of ours."""


BusOption = Annotated[
    Backend,
    typer.Option(
        "--bus",
        help="CAN backend of a live run: vcan (in user-mode Linux if necessary), python-can (vcan through python-can's "
        "socket instead of ours), wire, or auto.",
    ),
]


class ClockChoice(StrEnum):
    """The clock of a live run in user-mode Linux."""

    AUTO = "auto"
    REAL = "real"
    SIMULATED = "simulated"


ClockOption = Annotated[
    ClockChoice,
    typer.Option(
        "--clock",
        help="With --bus vcan in user-mode Linux: real time, simulated time (`make lab-kernel`), or the one that this "
        "host is quiet enough for.",
    ),
]


DETECTOR_MEM_MB: Final = 3072
"""Memory of a user-mode kernel with a detector: with less, the network's weights and the renderer drive each other out
of it, and every process waits for them to be read again."""


def enter_lab(bus: Backend, clock: ClockChoice = ClockChoice.AUTO, detects: bool = False) -> None:
    """Prepare a live run.  For vcan outside the lab: run this command again inside it, and exit with its code.

    Where the lab is user-mode Linux, the clock is chosen by the processor time that the host leaves and the run needs,
    and announced; ``detects``: a camera's detector runs in it.
    """
    if "TIMBERHAND_LAB" in os.environ:
        return
    if bus in (Backend.VCAN, Backend.PYTHON_CAN):
        from host.vcan_lab.__main__ import vcan
        from host.vcan_lab.spec import DEFAULT_MEM_MB

        simulated = clock is ClockChoice.SIMULATED or (clock is ClockChoice.AUTO and _simulates(detects))
        vcan(
            [sys.executable, "-m", "timberhand", *_without_page(sys.argv[1:])],
            time_travel=simulated,
            mem=DETECTOR_MEM_MB if detects else DEFAULT_MEM_MB,
        )


def _simulates(detects: bool) -> bool:
    """Tell whether the lab runs in simulated time; announced on stderr.  False where the lab is not user-mode Linux."""
    from host.vcan_lab.choose import clock_here

    chosen = clock_here(detects)
    if chosen is None:
        return False
    sys.stderr.write(f"vcan lab: {chosen.kind} time: {chosen.reason}\n")
    return chosen.kind == "simulated"


def _without_page(arguments: list[str]) -> list[str]:
    """Add the option for no page: a browser cannot reach one inside user-mode Linux."""
    return arguments if "--no-console" in arguments else [*arguments, "--no-console"]


def end(summary: Summary | MissionSummary, screen: Console, directory: Path, as_json: bool = False) -> NoReturn:
    """Show the summary of a run, keep it in the run's directory, and exit with its code."""
    summary.show(screen)
    summary.save(directory / "summary.json")
    if as_json:
        print(json.dumps(asdict(summary)))
    raise typer.Exit(summary.exit_code)


def new_directory(name: str) -> Path:
    """Make ``runs/<name>-<n>`` with the first free n, and point ``runs/LAST`` at it; safe for concurrent runs.

    Raises:
        CommandFailed: it cannot be made.
    """
    runs = Path("runs")
    try:
        runs.mkdir(exist_ok=True)
        for number in count(1):
            directory = runs / f"{name}-{number}"
            try:
                directory.mkdir()
            except FileExistsError:
                continue
            break
        link = runs / f".LAST-{directory.name}"
        link.symlink_to(directory.name)
        link.replace(runs / "LAST")
    except OSError as error:
        raise CommandFailed(
            "runs.not-made", f"no run can be kept below {runs.absolute()}: {error.strerror}; start it in another folder"
        ) from None
    return directory
