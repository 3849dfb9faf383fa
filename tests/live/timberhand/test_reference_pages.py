"""The generated pages that are committed say what the code says."""

from __future__ import annotations

from pathlib import Path

from experiments.common.standing import has_history
from timberhand.reference.__main__ import REPOSITORY, committed, stale


def test_no_generated_page_is_stale() -> None:
    assert [path.name for path in stale(committed())] == []


def test_a_changed_page_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text((REPOSITORY / "README.md").read_text())
    pages = {"faults", "transitions", "timberhand"} | ({"README"} if has_history() else set())
    assert {path.stem for path in stale(committed(tmp_path))} == pages
