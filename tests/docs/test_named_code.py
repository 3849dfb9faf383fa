"""The code that the pages name exists: files, modules, classes, functions."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import PAGES, ROOT, has_section, text_of

PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))
CODE = re.compile(r"`([^`\n]+)`")
FILE = re.compile(rf"(?:{'|'.join(PACKAGES)}|docs|tests)/[\w./-]+\.(?:py|toml|dbc|eds|js|html|sh|json|md)")
DOTTED = re.compile(rf"(?:{'|'.join(PACKAGES)})(?:\.\w+)+")
ROW = re.compile(r"^\|.*?`(?P<file>[\w./]+\.py)` \| (?P<names>`[\w.]+`(?:, `[\w.]+`)*)", re.M)
"""A row of the tour: a file and what of it is called."""


def code_of(module: list[str]) -> tuple[str, list[str]] | None:
    """The text of the longest prefix that is a module, and the names after it."""
    for length in range(len(module), 0, -1):
        path = ROOT.joinpath(*module[:length])
        for found in (path.with_suffix(".py"), path / "__init__.py"):
            if found.is_file():
                return found.read_text(), module[length:]
    return None


def missing(text: str) -> list[str]:
    """What the text of a page names and the code has not."""
    text = re.sub(r"(?s)```.*?```", "", text)
    found = []
    for quoted in CODE.findall(text):
        if FILE.fullmatch(quoted) and "NAME" not in quoted and not (ROOT / quoted).exists():
            found.append(quoted)
        elif DOTTED.fullmatch(quoted):
            at = code_of(quoted.split("."))
            if at is None or any(not re.search(rf"\b{name}\b", at[0]) for name in at[1]):
                found.append(quoted)
    for row in ROW.finditer(text):
        source = (ROOT / row["file"]).read_text() if (ROOT / row["file"]).is_file() else ""
        names = [name for quoted in CODE.findall(row["names"]) for name in quoted.split(".")]
        defined = re.findall(r"(?m)(?:class|def) (\w+)|^(\w+)\b", source)
        known = {name for pair in defined for name in pair}
        found += [f"{row['file']}: {name}" for name in names if name not in known]
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if page != "docs/reference/errors.md"])
def test_every_file_and_name_on_a_page_exists(page: str) -> None:
    """Not that of the error codes, which look like names."""
    assert missing(text_of(page)) == []


def test_a_wrong_name_is_noticed() -> None:
    text = "`controller.step.stepp` `hil/none.py` `sim.nowhere.at`\n| x | `controller/step.py` | `Nobody.at_all` |\n"
    assert len(missing(text)) == 5


def test_a_walk_of_the_tour_names_at_most_twelve_files() -> None:
    walks = (ROOT / "docs" / "tour.md").read_text().split("\n## Walk ")[1:]
    assert [len(set(FILE.findall(walk))) <= 12 for walk in walks] == [True] * 3


def test_the_glossary_is_short_enough_to_be_read() -> None:
    terms = re.findall(r"(?m)^\| (?!term \|)[^|]+ \|", (ROOT / "docs" / "glossary.md").read_text())
    assert 100 < len(terms) <= 150


def test_a_missing_section_is_noticed() -> None:
    """By what judges every citation in the sources."""
    assert has_section("docs/reference/machines.md", "7.2")
    assert not has_section("docs/reference/machines.md", "7.9")
