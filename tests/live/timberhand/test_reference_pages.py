"""The generated pages of docs/reference say what the code says, and the codes of errors keep their form."""

from __future__ import annotations

from pathlib import Path

from experiments.common.standing import has_history
from timberhand.reference.__main__ import REPOSITORY, stale


def test_no_generated_page_is_stale() -> None:
    assert [path.name for path in stale()] == []


def test_a_changed_page_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text((REPOSITORY / "README.md").read_text())
    pages = {"cli", "errors", "faults", "frames", "transitions", "timberhand"} | (
        {"README"} if has_history() else set()
    )
    assert {path.stem for path in stale(tmp_path)} == pages
