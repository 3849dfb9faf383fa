"""The command line as a whole: threads, version, errors, and the page of the saved results."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from importlib.metadata import version
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
def test_matrix_products_use_one_thread_unless_the_environment_says_otherwise(given: str | None, threads: str) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {"OPENBLAS_NUM_THREADS": given} if given else {}
    done = subprocess.run([sys.executable, "-c", SHOWS], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == f"threads {threads}"


def test_the_report_is_written_from_saved_results_and_an_empty_or_broken_folder_is_refused(tmp_path: Path) -> None:
    runner = CliRunner()
    refused = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.exit_code is ExitCode.CONFIGURATION
    assert refused.exception.code == "report.no-results"
    (tmp_path / "results").mkdir()
    for name in ("navigation", "productivity"):
        shutil.copyfile(DOCS / "results" / f"{name}.json", tmp_path / "results" / f"{name}.json")
    done = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert done.exit_code == 0 and "2 experiments" in done.stdout
    assert "[navigation]" in (tmp_path / "results.md").read_text()
    (tmp_path / "results" / "navigation.json").write_text("{")
    broken = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(broken.exception, CommandFailed) and broken.exception.code == "report.results-unusable"


def test_the_version_is_that_of_the_package() -> None:
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0 and done.stdout == f"timberhand {version('timberhand')}\n"


def test_an_error_is_one_line_with_its_code_and_the_documented_exit_code(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "timberhand", "recording", "decode", str(tmp_path / "none.log")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.CONFIGURATION and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("timberhand: ") and line.endswith(" [recording.unreadable]")


def test_a_command_failure_crosses_process_boundaries() -> None:
    failure = CommandFailed("area.what", "a sentence", ExitCode.BUS)
    copy = pickle.loads(pickle.dumps(failure))
    assert (copy.code, str(copy), copy.exit_code) == ("area.what", "a sentence", ExitCode.BUS)
