"""The experiments by name.  Each module has ``run(options, console) -> Result``, imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

from rich.console import Console

from hil.experiments.result import Result


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says; ``trials`` None is the experiment's default, ``docs`` the folder to refresh."""

    seed: int
    truth: str
    profile: str
    out: Path
    trials: int | None = None
    quick: bool = False
    workers: int = 1
    docs: Path | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """What an experiment is about, and where it is."""

    sentence: str
    module: str


EXPERIMENTS: Final = {
    "plant": Entry(
        "Does the simulated machine behave like steel, oil and wood? Grasps, closed-form physics, endurance, speed.",
        "hil.experiments.plant.experiment",
    ),
}


def load(name: str) -> Callable[[Options, Console], Result]:
    """The experiment's ``run``."""
    runner: Callable[[Options, Console], Result] = import_module(EXPERIMENTS[name].module).run
    return runner
