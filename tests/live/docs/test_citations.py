"""Every source that the code names can be opened: the file exists, and so does the section."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from tests.docs.pages import ROOT, has_section, headings
from timberhand.reference.__main__ import BUILT

TEXTS = ("*.py", "*.toml", "*.dbc", "*.eds", "*.js", "*.sh", "*.service", "*.md", "Makefile")
ELSEWHERE = re.compile(
    r"(?<!reference/)\b(machines|can_bus|realtime|safety_faults|ecosystem)\.md\b"
    r"|(?<![\w/-])(plant|perception)\.md (section )?\d|\bdesign(\.md)? section\b|\.\./shared/(?!data)"
)
"""Names of notes that are not in the repository."""
PAGE = re.compile(r"\bdocs/[\w./-]+\.md\b")
SECTIONS = re.compile(
    r"(?P<page>docs/[\w./-]+\.md),? sections? (?P<numbers>\d[\d.]*\d|\d)(?P<more>(?:(?:,| and) (?:\d[\d.]*\d|\d)\b)*)"
)
QUOTED = re.compile(r'(?P<page>docs/[\w./-]+\.md), "(?P<heading>[^"]+)"')


def sources() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", *TEXTS], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    left_out = ("docs/results/", "console/static/vendor/", "tests/live/docs/test_citations.py")
    return [ROOT / name for name in listed.split() if not name.startswith(left_out) and (ROOT / name).is_file()]


def prose(path: Path) -> str:
    """The text with line breaks and comment marks folded, so that a citation may run over two lines."""
    return re.sub(r"\s*\n\s*(#|//|\*)?\s*", " ", path.read_text())


def problems(path: Path) -> list[str]:
    """What a reader of this file could not open."""
    text = prose(path)
    found = [f"{name[0]!r} is not in the repository" for name in ELSEWHERE.finditer(text)]
    if path.suffix == ".md":
        return found  # the links of pages are checked by the site's build
    if "tmp_path" not in text:
        pages = [page for page in PAGE.findall(text) if "NAME" not in page]
        found += [f"{page} does not exist" for page in pages if page not in BUILT and not (ROOT / page).is_file()]
    for cited in SECTIONS.finditer(text):
        for number in re.findall(r"\d[\d.]*\d|\d", cited["numbers"] + cited["more"]):
            if not has_section(cited["page"], number):
                found.append(f"{cited['page']} has no section {number}")
    for cited in QUOTED.finditer(text):
        if cited["heading"] not in headings(cited["page"]):
            found.append(f"{cited['page']} has no heading {cited['heading']!r}")
    return found


def test_every_cited_page_and_section_exists() -> None:
    found = {path.relative_to(ROOT).as_posix(): problems(path) for path in sources()}
    assert {name: what for name, what in found.items() if what} == {}
