"""The command line as a whole: one thread for products of matrices, and the page of the saved results."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from timberhand.cli import app

DOCS = Path(__file__).parents[2] / "docs"
SHOWS = """
import os, sys
from timberhand.cli import main
sys.argv = ["timberhand", "--help"]
try:
    main()
finally:
    print("threads", os.environ["OPENBLAS_NUM_THREADS"])
"""


@pytest.mark.parametrize(("given", "threads"), [(None, "1"), ("2", "2")])
def test_matrices_are_multiplied_in_one_thread_unless_a_person_says_otherwise(given: str | None, threads: str) -> None:
    surroundings = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    surroundings |= {"OPENBLAS_NUM_THREADS": given} if given else {}
    done = subprocess.run([sys.executable, "-c", SHOWS], env=surroundings, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == f"threads {threads}"


def test_the_report_is_written_from_saved_results_and_an_empty_or_broken_folder_is_told(tmp_path: Path) -> None:
    runner = CliRunner()
    refused = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.exit_code is ExitCode.CONFIGURATION
    (tmp_path / "results").mkdir()
    for name in ("navigation", "productivity"):
        shutil.copyfile(DOCS / "results" / f"{name}.json", tmp_path / "results" / f"{name}.json")
    done = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert done.exit_code == 0 and "2 experiments" in done.stdout
    assert "[navigation]" in (tmp_path / "figures.md").read_text()
    (tmp_path / "results" / "navigation.json").write_text("{")
    broken = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(broken.exception, CommandFailed) and "cannot be used" in str(broken.exception)
