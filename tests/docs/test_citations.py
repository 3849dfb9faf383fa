"""Every source that the code names can be opened: the file exists, and so does the section."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@cache
def headings(page: str) -> tuple[str, ...]:
    return tuple(re.findall(r"(?m)^#+ (.+)$", (ROOT / page).read_text()))


def has_section(page: str, number: str) -> bool:
    return any(heading.startswith((f"{number}. ", f"{number} ")) for heading in headings(page))


def test_a_missing_section_is_noticed() -> None:
    assert has_section("docs/reference/machines.md", "7.2")
    assert not has_section("docs/reference/machines.md", "7.9")
