"""The outcome of a one-log run, in the same words live and in lockstep."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from hil.harness.display import say
from host.exit_codes import ExitCode

SHOWN_S: Final = 0.1
"""A smaller loss of time is not worth a word."""


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of one run; ``in_bunk`` and ``verdict`` come from the plant's physics alone.

    ``closings``: how often the grapple was closed about the log; a second one is a retry.  ``paced``: the run was in
    paced virtual time, which fell ``behind_s`` behind the wall clock.
    """

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
    closings: int
    directory: str
    paced: bool = False
    behind_s: float = 0.0

    @property
    def exit_code(self) -> ExitCode:
        """`ExitCode.OK` only when the log lies in the bunk according to the physics."""
        if self.in_bunk:
            return ExitCode.OK
        return ExitCode.SAFETY_STOP if self.stops else ExitCode.FIGURE_MISSED

    def show(self, console: Console) -> None:
        """Print it for a person."""
        say(console, "[green]✔[/green] " if self.in_bunk else "[red]✘[/red] ", self.verdict)
        if self.failure:
            say(console, "  ", f"the planner failed: {self.failure}")
        if self.grasp:
            retries = f"; closed {self.closings} times" if self.closings > 1 else ""
            say(console, "  ", f"grasp: {self.grasp}{retries}")
        say(
            console,
            "  ",
            f"{self.seconds:.1f} s, {self.ticks} control ticks ({self.missed_ticks} missed), "
            f"{self.frames} frames, {self.stops} {'stop' if self.stops == 1 else 'stops'}, "
            f"{self.refused_setpoints} setpoints refused",
        )
        if self.paced:
            lost = f", which fell {self.behind_s:.1f} s behind the clock" if self.behind_s >= SHOWN_S else ""
            say(console, "  ", f"in paced virtual time{lost}: no evidence of real time")
        say(console, "  ", f"recording: {self.directory}")
        if self.stops:
            say(console, "  ", f"why it stopped: timberhand why {self.directory}")

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n")


def is_settled(verdict: dict[str, Any]) -> bool:
    """Tell whether waiting changes nothing of the evaluation: it is a success, or every log is at rest."""
    return bool(verdict["success"] or all(log["at_rest"] for log in verdict["logs"]))


def outcome_sentence(verdict: dict[str, Any]) -> str:
    """Describe the evaluation of the first log; ``verdict`` is the plant's evaluation as plain data."""
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
