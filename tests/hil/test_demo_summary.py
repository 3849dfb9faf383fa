"""What a run tells: when a single log's evaluation is final, what it says, and rows in a pipe or a file."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from hil.demo.summary import Summary, is_settled, outcome_sentence
from hil.harness.display import Display
from machine.status.modes import Mode
from tests.console.state_reports import at


def verdict(**its: bool) -> dict[str, Any]:
    log = {"in_bunk": True, "released": True, "at_rest": True, "lifted": True} | its
    return {"logs": [log], "success": log["in_bunk"] and log["released"] and log["at_rest"]}


@pytest.mark.parametrize(
    ("its", "settled"),
    [
        ({}, True),
        ({"at_rest": False}, False),
        ({"in_bunk": False}, True),
        ({"in_bunk": False, "at_rest": False}, False),
        ({"lifted": False, "in_bunk": False}, True),
    ],
)
def test_only_a_log_that_still_moves_is_waited_for(its: dict[str, bool], settled: bool) -> None:
    assert is_settled(verdict(**its)) is settled


def test_the_sentence_names_all_that_is_wrong() -> None:
    wrong = ({}, {"in_bunk": False}, {"at_rest": False}, {"in_bunk": False, "at_rest": False})
    assert len({outcome_sentence(verdict(**its)) for its in wrong}) == len(wrong)


SUMMARY = Summary(
    True,
    outcome_sentence(verdict()),
    "",
    26.5,
    1,
    5300,
    0,
    62160,
    0,
    "1 log (0) of 1 at once, all draws hold it",
    1,
    "runs/paced-seed3-1",
    paced=True,
    behind_s=10.5,
)


def shown(summary: Summary, terminal: bool) -> list[str]:
    out = io.StringIO()
    summary.show(Console(file=out, force_terminal=terminal, width=80, no_color=True, highlight=False))
    return re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).splitlines()


def test_a_terminal_gets_lines_of_its_width_broken_between_words_and_a_pipe_gets_whole_ones() -> None:
    narrow, whole = shown(SUMMARY, True), shown(SUMMARY, False)
    assert max(map(len, narrow)) <= 80 < max(map(len, whole)) and len(narrow) > len(whole)
    assert " ".join(" ".join(narrow).split()) == " ".join(" ".join(whole).split())
    assert all(line.startswith("  ") for line in narrow[1:])


def test_a_paced_run_says_so_and_how_much_it_lost() -> None:
    live = shown(replace(SUMMARY, paced=False), False)
    (paced,) = set(shown(SUMMARY, False)) - set(live)
    (steady,) = set(shown(replace(SUMMARY, behind_s=0.01), False)) - set(live)
    assert "10.5" in paced and len(steady) < len(paced)


SECOND_NS = 1_000_000_000
FAR = (-math.pi, -math.pi, -math.pi, 12.345, -math.pi)


def printed(seconds: int) -> list[str]:
    out = io.StringIO()
    with Display(
        Console(file=out, width=80), "a machine whose name and job are longer than a line of a terminal " * 2
    ) as display:
        display.phase("APPROACH")
        for i in range(seconds):
            display.report(at(FAR, 1 + i * SECOND_NS, Mode.STANDBY, velocity=FAR, opening_pct=100.0))
    return out.getvalue().splitlines()


def test_a_row_fits_into_80_columns_and_the_headings_come_again() -> None:
    title, _, *rows = printed(seconds=90)
    assert title.startswith("a machine") and title.count("line of a terminal") == 2, "the title is one line"
    headings = [i for i, row in enumerate(rows) if "slew" in row]
    assert headings == [0, 41, 82] and len(rows) == 93
    assert max(map(len, rows)) == 80
    assert len({row.rindex(" ", 0, 26) for row in rows if "APPROACH" in row}) == 1
