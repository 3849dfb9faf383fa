"""The pages of the documentation; those that are not committed are made as the site's build makes them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from timberhand.reference.__main__ import BUILT

ROOT = Path(__file__).resolve().parents[2]
WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [path.relative_to(ROOT).as_posix() for path in WRITTEN if "_build" not in path.parts]
PAGES = sorted({*NAMES, *BUILT})


def text_of(page: str) -> str:
    """The text of a page, which is named by its path in the repository."""
    return BUILT[page]() if page in BUILT else (ROOT / page).read_text()


@cache
def headings(page: str) -> tuple[str, ...]:
    return tuple(re.findall(r"(?m)^#+ (.+)$", (ROOT / page).read_text()))


def has_section(page: str, number: str) -> bool:
    return any(heading.startswith((f"{number}. ", f"{number} ")) for heading in headings(page))
