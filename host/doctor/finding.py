"""The result of one check with the suggested change, and findings on a terminal: changes first, then what is fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
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
        """The finding as plain values for JSON."""
        return {
            "what": self.what,
            "severity": self.severity.name.lower(),
            "sentence": self.sentence,
            "gain": self.gain,
            "commands": list(self.commands),
        }


def fine(what: str, sentence: str) -> Finding:
    """A finding without a suggested change."""
    return Finding(what, Severity.FINE, sentence)


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
    for finding in findings:
        if finding.severity is not Severity.FINE:
            _print(console, finding)
    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, min_width=12)
    table.add_column(overflow="fold")
    for finding in findings:
        if finding.severity is Severity.FINE:
            table.add_row(Text(*_MARKS[finding.severity]), Text(finding.what), Text(finding.sentence, style="dim"))
    console.print(table)
    console.print()


def conclusion(findings: Sequence[Finding]) -> str:
    """The final line."""
    worst = max((f.severity for f in findings), default=Severity.FINE)
    count = sum(f.severity is worst for f in findings)
    return _CONCLUSIONS[worst].format(count, "" if count == 1 else "s")


def _print(console: Console, finding: Finding) -> None:
    mark, style = _MARKS[finding.severity]
    head = Text.assemble((mark, style), " ", (f"{finding.what}: ", style), finding.sentence)
    console.print(head)
    if finding.gain:
        console.print(Padding(Text(f"gain: {finding.gain}", style="dim"), (0, 0, 0, 4)))
    for command in finding.commands:  # not folded, so that they can be copied
        console.print(Text(f"    $ {command}", style="cyan"), soft_wrap=True)
