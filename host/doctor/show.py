"""Findings on a terminal: suggested changes first, with commands to copy, then everything that is fine."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from host.doctor.finding import Finding, Severity

_MARKS = {
    Severity.FINE: ("✓", "green"), Severity.ADVICE: ("·", "cyan"), Severity.CHANGE: ("!", "bold yellow"),
    Severity.FAULT: ("✗", "bold red"),
}  # fmt: skip


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
    count = {severity: sum(f.severity is severity for f in findings) for severity in Severity}
    if count[Severity.FAULT]:
        return f"{_counted(count[Severity.FAULT], 'fault')} (✗) prevent a run: correct them first."
    if count[Severity.CHANGE]:
        return f"The machine can run; {_counted(count[Severity.CHANGE], 'change')} (!) recommended, in the order shown."
    if count[Severity.ADVICE]:
        return f"No problems; {_counted(count[Severity.ADVICE], 'improvement')} (·) possible."
    return "No problems."


def _print(console: Console, finding: Finding) -> None:
    mark, style = _MARKS[finding.severity]
    head = Text.assemble((mark, style), " ", (f"{finding.what}: ", style), finding.sentence)
    console.print(head)
    if finding.gain:
        console.print(Padding(Text(f"gain: {finding.gain}", style="dim"), (0, 0, 0, 4)))
    for command in finding.commands:  # not folded, so that they can be copied
        console.print(Text(f"    $ {command}", style="cyan"), soft_wrap=True)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
