"""The findings on a terminal: what to change first, with its command ready to copy, then what is fine."""

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
    """One group of findings."""
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


def verdict(findings: Sequence[Finding]) -> str:
    """The last line."""
    count = {severity: sum(f.severity is severity for f in findings) for severity in Severity}
    if count[Severity.FAULT]:
        return f"{_things(count[Severity.FAULT])} in the way: mend the ones marked ✗ first."
    if count[Severity.CHANGE]:
        return f"It runs; {_things(count[Severity.CHANGE])} should be changed (!), from the top."
    if count[Severity.ADVICE]:
        return f"All is well; {_things(count[Severity.ADVICE])} could be better (·)."
    return "All is well."


def _print(console: Console, finding: Finding) -> None:
    mark, style = _MARKS[finding.severity]
    head = Text.assemble((mark, style), " ", (f"{finding.what}: ", style), finding.sentence)
    console.print(head)
    if finding.gain:
        console.print(Padding(Text(f"gained: {finding.gain}", style="dim"), (0, 0, 0, 4)))
    for command in finding.commands:  # never folded: they are there to be copied
        console.print(Text(f"    $ {command}", style="cyan"), soft_wrap=True)


def _things(count: int) -> str:
    return "one thing" if count == 1 else f"{count} things"
