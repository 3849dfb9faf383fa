"""The rows of a run that is printed into a pipe or a file."""

from __future__ import annotations

import io
import math

from rich.console import Console

from can_dbc.messages.crane import StateReport
from hil.harness.display import Display
from machine.status.modes import Mode

SECOND_NS = 1_000_000_000
FAR = (-math.pi, -math.pi, -math.pi, 12.345, -math.pi)


def report(seconds: int, mode: Mode = Mode.STANDBY) -> StateReport:
    zeros = (0.0,) * 5
    return StateReport(
        1, 2, 1 + seconds * SECOND_NS, mode, 0, 0, 0, 0, 0, 0, FAR, FAR, zeros, 100.0, 0.0, 0.0, 0, 0, 0, 0
    )


def printed(seconds: int) -> list[str]:
    out = io.StringIO()
    with Display(
        Console(file=out, width=80), "a machine whose name and job are longer than a line of a terminal " * 2
    ) as display:
        display.phase("APPROACH")
        for i in range(seconds):
            display.report(report(i))
    return out.getvalue().splitlines()


def test_a_row_fits_into_80_columns_and_the_headings_come_again() -> None:
    title, _, *rows = printed(seconds=90)
    assert title.startswith("a machine") and title.count("line of a terminal") == 2, "the title is one line"
    headings = [i for i, row in enumerate(rows) if "slew" in row]
    assert headings == [0, 41, 82] and len(rows) == 93
    assert max(map(len, rows)) == 80
    assert len({row.rindex(" ", 0, 26) for row in rows if "APPROACH" in row}) == 1
