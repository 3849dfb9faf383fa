"""What the run of the live tests promises of processes that are left behind, and of failures beside a stall."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.live import conftest as live

ROOT = Path(__file__).parents[2]
LEAVES = """
import subprocess
def test_leaves_a_process():
    subprocess.Popen(["sleep", "1000"])
"""
FAILS = """
import pytest
@pytest.mark.bears({bears})
def test_fails():
    assert False
"""


def run(folder: Path, name: str, text: str) -> str:
    """What a run of one test file beside this one prints; it begins with the exit code."""
    path = folder / f"test_{name}.py"
    path.write_text(text)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-c",
        str(ROOT / "pyproject.toml"),
        f"--rootdir={ROOT}",
        "-p",
        "tests.live.conftest",
        str(path),
    ]
    environment = {name: value for name, value in os.environ.items() if name != live.TAG}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment, check=False)
    return f"{done.returncode}\n{done.stdout}{done.stderr}"


def test_a_process_that_a_test_leaves_is_ended_and_told(tmp_path: Path) -> None:
    told = run(tmp_path, "leaves", LEAVES)
    assert told.startswith("1\n") and "sleep 1000" in told
    assert not any("sleep 1000" in command for command in live.running().values())


@pytest.mark.parametrize(("bears_ms", "code"), [(-1.0, "0"), (1e9, "1")], ids=["stalled", "quiet"])
def test_a_failure_beside_a_stall_is_inconclusive_and_any_other_one_a_failure(
    tmp_path: Path, bears_ms: float, code: str
) -> None:
    told = run(tmp_path, "fails", FAILS.format(bears=bears_ms))
    assert told.startswith(f"{code}\n"), told
