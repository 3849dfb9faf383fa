"""Every experiment, one after the other, each in a process of its own; with what each took.

A quick pass comes first.  It shows that everything runs, and its processor times, scaled by the work of the full run,
are the estimate of the hours that follow.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Table

from experiments.common.registry import EXPERIMENTS

SUMMARY: Final = "all.json"
HOUR_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class Pass:
    """One experiment: exit code of its command, duration [s] and processor time [s] of it and its workers."""

    name: str
    code: int
    wall_s: float
    processor_s: float


def perform(
    quick: bool, options: Sequence[str], out: Path, console: Console, call: Callable[[list[str]], int] | None = None
) -> list[Pass]:
    """Run the command of every experiment with further ``options``, its results in ``out``/NAME.

    A quick pass leaves out those that measure this computer in real time.
    """
    run = call or _run
    passes = []
    for name, entry in EXPERIMENTS.items():
        if quick and entry.live:
            continue
        command = [sys.executable, "-m", "timberhand", "experiment", name, "--out", str(out / name), *options]
        begun_s, before_s = time.monotonic(), _processor_s()
        console.print(f"[bold]{name}[/bold]", highlight=False)
        code = run([*command, "--quick"] if quick else command)
        passes.append(Pass(name, code, round(time.monotonic() - begun_s, 2), round(_processor_s() - before_s, 2)))
        out.mkdir(parents=True, exist_ok=True)
        (out / SUMMARY).write_text(json.dumps([asdict(finished) for finished in passes], indent=2) + "\n")
    return passes


def _run(command: list[str]) -> int:
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def estimate_h(quick: Sequence[Pass], workers: int) -> dict[str, float]:
    """Estimate the hours of every full run: its quick processor time, scaled; a live one takes its fixed time."""
    scaled = {p.name: p.processor_s * EXPERIMENTS[p.name].scale / workers / HOUR_S for p in quick}
    live = {name: entry.live_s / HOUR_S for name, entry in EXPERIMENTS.items() if entry.live}
    return scaled | live


def show(found: Sequence[Pass], console: Console) -> None:
    """Print what every experiment took and how it ended."""
    end_texts = {0: "all limits met", 6: "limits missed"}
    table = Table("experiment", "duration", "processor time", "end")
    for finished in found:
        end = end_texts.get(finished.code, f"failed, exit code {finished.code}")
        table.add_row(finished.name, f"{finished.wall_s:.0f} s", f"{finished.processor_s:.0f} s", end)
    table.add_row("all", f"{sum(p.wall_s for p in found):.0f} s", f"{sum(p.processor_s for p in found):.0f} s", "")
    console.print(table)


def show_estimate(hours: dict[str, float], console: Console) -> None:
    """Print the hours of the full runs, the longest first."""
    for name, value in sorted(hours.items(), key=lambda pair: -pair[1]):
        console.print(f"{name}: {value:.1f} h", highlight=False)
    console.print(f"[bold]about {sum(hours.values()):.0f} hours in all[/bold]", highlight=False)
