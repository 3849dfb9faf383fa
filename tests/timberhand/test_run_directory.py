"""Every run has a directory of its own, also beside others."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from timberhand.commands.runs import new_directory


def test_runs_that_begin_side_by_side_get_directories_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: new_directory("run"), range(40)))
    assert len(set(made)) == 40 and all(one.is_dir() for one in made)
    assert Path("runs/LAST").resolve().name.startswith("run-")
    assert sorted(p.name for p in Path("runs").iterdir() if p.name.startswith(".")) == []


def test_the_last_run_is_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert new_directory("a") == Path(f"runs/a-{number}")
        assert Path("runs/LAST").resolve().name == f"a-{number}"
