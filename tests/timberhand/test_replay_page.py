"""A recording opens in the page from the command line, at its newest stop with `timberhand why --page`."""

from __future__ import annotations

import lzma
from pathlib import Path
from typing import Any

import pytest

from host.exit_codes import CommandFailed
from tests.codes import coded
from timberhand.commands.why import why
from timberhand.replay_page import show_recording

KEPT = Path(__file__).parents[1] / "recordings"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "run.mcap").write_bytes(lzma.decompress((KEPT / "palms.mcap.xz").read_bytes()))
    return tmp_path


def test_a_stop_opens_ten_seconds_before(monkeypatch: pytest.MonkeyPatch, run: Path) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr("timberhand.replay_page.serve_replay", lambda *_, **told: asked.update(told))
    show_recording(run, None, 0, stop_ns=25 * 10**9)
    assert asked["at_ns"] == 15 * 10**9


def test_a_run_without_a_stop_has_no_page_of_one(run: Path) -> None:
    with pytest.raises(CommandFailed, check=coded("why.no-stop")):
        why(run, page=True)


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CommandFailed, check=coded("recording.none")):
        show_recording(tmp_path, None, 0)
