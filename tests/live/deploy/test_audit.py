"""No pattern of insecure code but those whose lines say why they are as intended."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("bandit") is None, reason="bandit is missing: timberhand[audit]"
)


def bandit(*places: object) -> subprocess.CompletedProcess[str]:
    """As deploy/audit.sh calls it."""
    command = [
        sys.executable,
        "-m",
        "bandit",
        "--quiet",
        "--severity-level",
        "medium",
        "--format",
        "txt",
        "--recursive",
    ]
    return subprocess.run([*command, *map(str, places)], cwd=ROOT, capture_output=True, text=True, check=False)


def test_bandit_finds_nothing_in_the_program() -> None:
    listed = subprocess.run(["git", "ls-files", "*/*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    done = bandit(*sorted({name.split("/")[0] for name in listed.splitlines()} - {"tests", "docs"}))
    assert done.returncode == 0, done.stdout


def test_bandit_finds_what_nobody_justified_and_every_justification_has_a_reason(tmp_path: Path) -> None:
    (tmp_path / "new.py").write_text("eval(input())\n")
    assert bandit(tmp_path).returncode == 1
    marked = subprocess.run(
        ["git", "grep", "-hE", "# nosec", "--", "*.py", ":!tests"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    bare = [line for line in marked if "  # nosec B" not in line or line.count("#") < 2]
    assert marked and bare == []
