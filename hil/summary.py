"""What a run of the first job came to, in the same words live and in lockstep."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from host.exits import Exit


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of one run; ``in_bunk`` and ``verdict`` come from the plant's physics, nothing from the planner."""

    in_bunk: bool
    verdict: str
    failure: str
    seconds: float
    stops: int
    ticks: int
    missed_ticks: int
    frames: int
    refused_setpoints: int
    grasp: str
    directory: str

    @property
    def exit(self) -> Exit:
        """Fine only when the log truly lies in the bunk."""
        if self.in_bunk:
            return Exit.FINE
        return Exit.SAFETY if self.stops else Exit.FIGURE

    def show(self, console: Console) -> None:
        """Print it for a person."""
        mark = "[green]✔[/green]" if self.in_bunk else "[red]✘[/red]"
        console.print(f"{mark} {self.verdict}", highlight=False, soft_wrap=True)
        if self.failure:
            console.print(f"  the planner gave up: {self.failure}", highlight=False, soft_wrap=True)
        if self.grasp:
            console.print(f"  grasp: {self.grasp}", highlight=False, soft_wrap=True)
        console.print(
            f"  {self.seconds:.1f} s, {self.ticks} control ticks ({self.missed_ticks} missed), "
            f"{self.frames} frames, {self.stops} stops, {self.refused_setpoints} setpoints refused",
            highlight=False,
            soft_wrap=True,
        )
        console.print(f"  logs: {self.directory}", highlight=False, soft_wrap=True)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n")


def verdict_sentence(verdict: dict[str, Any]) -> str:
    """The plant's judgement of the first log in words; ``verdict`` is the plant's verdict as plain data."""
    log = verdict["logs"][0]
    if log["in_bunk"] and log["released"] and log["at_rest"]:
        return "The log lies in the bunk: lifted, released and at rest, as the plant's physics sees it."
    wrong = [
        text
        for text, true in (
            ("it was never lifted", not log["lifted"]),
            ("it is not in the bunk", not log["in_bunk"]),
            ("the grapple still touches it", not log["released"]),
            ("it still moves", not log["at_rest"]),
        )
        if true
    ]
    return f"The log does not lie in the bunk: {', '.join(wrong)}."
