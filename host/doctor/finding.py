"""A check is one row: its topic, what is good about it, or what is wrong, what a change gains and its commands.

There is one way to print rows: what to change comes first, then what is fine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text


class Severity(IntEnum):
    """The severity of a finding; only FAULT prevents the machine from running."""

    FINE = 0
    ADVICE = 1
    CHANGE = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """``what`` names the topic, ``sentence`` describes it; ``gain`` and ``commands`` belong to a suggested change."""

    what: str
    severity: Severity
    sentence: str
    gain: str = ""
    commands: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the finding as plain values for JSON."""
        return asdict(self) | {"severity": self.severity.name.lower(), "commands": list(self.commands)}


def fine(what: str, sentence: str) -> Finding:
    """Make a finding without a suggested change."""
    return Finding(what, Severity.FINE, sentence)


def row(what: str, good: str, severity: Severity, wrong: str, gain: str, *commands: str) -> Finding:
    """Make one finding: what is said where it is good, else (empty) what is wrong, a change's gain, its commands."""
    return fine(what, good) if good else Finding(what, severity, wrong, gain, commands)


_MARKS = {
    Severity.FINE: ("✓", "green"),
    Severity.ADVICE: ("·", "cyan"),
    Severity.CHANGE: ("!", "bold yellow"),
    Severity.FAULT: ("✗", "bold red"),
}
_CONCLUSIONS = {
    Severity.FINE: "No problems.",
    Severity.ADVICE: "No problems; {} improvement{} (·) possible.",
    Severity.CHANGE: "The machine can run; {} change{} (!) recommended, in the order shown.",
    Severity.FAULT: "{} fault{} (✗) prevent a run: correct them first.",
}


def show(console: Console, title: str, findings: Sequence[Finding]) -> None:
    """Print one group of findings."""
    console.print(Text(title, style="bold"))
    for finding in sorted(findings, key=lambda f: f.severity is Severity.FINE):
        mark, style = _MARKS[finding.severity]
        console.print(Text.assemble((f"{mark} {finding.what}: ", style), finding.sentence))
        if finding.gain:
            console.print(Padding(Text(f"gain: {finding.gain}", style="dim"), (0, 0, 0, 4)))
        for command in finding.commands:  # not folded, so that they can be copied
            console.print(Text(f"    $ {command}", style="cyan"), soft_wrap=True)
    console.print()


def conclusion(findings: Sequence[Finding]) -> str:
    """Write the final line."""
    worst = max((f.severity for f in findings), default=Severity.FINE)
    count = sum(f.severity is worst for f in findings)
    return _CONCLUSIONS[worst].format(count, "" if count == 1 else "s")
