"""What the commands that run a machine share: the bus, the lab around them, the directory of the run."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from itertools import count
from pathlib import Path


class Backend(StrEnum):
    """Where the frames travel."""

    AUTO = "auto"
    WIRE = "wire"
    VCAN = "vcan"


def enter_lab(bus: Backend) -> None:
    """Where vcan is wanted, run this command again inside the lab and end with its exit code; else return."""
    if bus is Backend.VCAN and "TIMBERHAND_LAB" not in os.environ:
        from host.vcan_lab.__main__ import vcan

        vcan([sys.executable, "-m", "timberhand", *_without_page(sys.argv[1:])])


def _without_page(arguments: list[str]) -> list[str]:
    """Inside user-mode Linux nobody can reach the page, so it is not started there."""
    return arguments if "--no-console" in arguments else [*arguments, "--no-console"]


def new_directory(name: str) -> Path:
    """``runs/<name>-<n>``, made with the first free n, and ``runs/LAST`` pointing at it, also beside other runs."""
    runs = Path("runs")
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
    return directory
