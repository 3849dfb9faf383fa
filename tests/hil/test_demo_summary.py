"""When a single log's evaluation is final, and what it says."""

from __future__ import annotations

from typing import Any

import pytest

from hil.demo.summary import is_settled, outcome_sentence


def verdict(**its: bool) -> dict[str, Any]:
    log = {"in_bunk": True, "released": True, "at_rest": True, "lifted": True} | its
    return {"logs": [log], "success": log["in_bunk"] and log["released"] and log["at_rest"]}


@pytest.mark.parametrize(
    ("its", "settled"),
    [
        ({}, True), ({"at_rest": False}, False), ({"in_bunk": False}, True),
        ({"in_bunk": False, "at_rest": False}, False), ({"lifted": False, "in_bunk": False}, True),
    ],
)  # fmt: skip
def test_only_a_log_that_still_moves_is_waited_for(its: dict[str, bool], settled: bool) -> None:
    assert is_settled(verdict(**its)) is settled


def test_the_sentence_names_all_that_is_wrong() -> None:
    assert "lies in the bunk" in outcome_sentence(verdict())
    said = outcome_sentence(verdict(in_bunk=False, at_rest=False))
    assert "it is not in the bunk" in said and "it still moves" in said
