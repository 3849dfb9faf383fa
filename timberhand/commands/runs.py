"""What the commands that run a machine share: the bus, the lab around them, the directory of the run."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path


class Backend(StrEnum):
    """Where the frames travel."""

    AUTO = "auto"
    WIRE = "wire"
    VCAN = "vcan"


def enter_lab(bus: Backend) -> None:
    """Where vcan is wanted, run this command again inside the lab and end with its exit code; else return."""
    if bus is Backend.VCAN and "TIMBERHAND_LAB" not in os.environ:
        from hil.vcan_lab.__main__ import vcan

        vcan([sys.executable, "-m", "timberhand", *_without_page(sys.argv[1:])])


def _without_page(arguments: list[str]) -> list[str]:
    """Inside user-mode Linux nobody can reach the page, so it is not started there."""
    return arguments if "--no-console" in arguments else [*arguments, "--no-console"]


def new_directory(name: str) -> Path:
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
