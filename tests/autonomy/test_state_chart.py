"""The page of the activity manager and its diagrams match the transition tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from autonomy.manager.state_chart import diagram, page
from autonomy.manager.transition_table import OURS, PAPER_B

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_of_the_activity_manager_is_as_the_code_has_it() -> None:
    assert (DOCS / "activity.md").read_text() == page(), "run `timberhand mission states --docs docs`"


@pytest.mark.parametrize("table", [PAPER_B, OURS], ids=["paper_b", "ours"])
def test_every_change_is_in_the_diagram(table) -> None:
    text = diagram(table)
    for (begin, event), end in table.items():
        line = next(x for x in text.splitlines() if x.strip().startswith(f"{begin.name} --> {end.name} "))
        assert event.name.lower().replace("_", " ") in line
