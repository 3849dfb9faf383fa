"""The command line as a whole: threads, version, errors, and the page of the saved results."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from tests.codes import numbers_in
from timberhand.cli import app

DOCS = Path(__file__).parents[3] / "docs"
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


@pytest.mark.parametrize("module", ["timberhand.cli", "hil.harness.live", "controller.process.command"])
def test_what_starts_first_loads_no_numerics(module: str) -> None:
    heavy = ("numpy", "scipy", "matplotlib", "pybullet", "openvino", "torch")
    code = f"import sys, {module}; print(*(set({heavy}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("words", [["demo"], ["mission", "run"], ["plan", "check"], ["experiment"]])
def test_help_at_80_columns_has_each_option_on_a_line_and_its_words_below(words: list[str]) -> None:
    environment = {**os.environ, "COLUMNS": "80", "TERMINAL_WIDTH": "80"}
    command = [sys.executable, "-m", "timberhand", *words, "--help"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    lines = [line.strip("│ ") for line in done.stdout.splitlines()]
    options = [k for k, line in enumerate(lines) if line.startswith("--")]
    assert len(options) > 2
    for k in options:
        assert len(lines[k]) < 76 and len(lines[k + 1].split()) >= 3, lines[k]


def test_the_report_is_written_from_saved_results_and_an_empty_or_broken_folder_is_refused(tmp_path: Path) -> None:
    runner = CliRunner()
    refused = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.exit_code is ExitCode.CONFIGURATION
    assert refused.exception.code == "report.no-results"
    (tmp_path / "results").mkdir()
    for name in ("navigation", "productivity"):
        saved = json.loads((DOCS / "results" / f"{name}.json").read_text())
        (tmp_path / "results" / f"{name}.json").write_text(json.dumps({**saved, "commit": "0123456789ab"}))
    done = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert done.exit_code == 0 and 2 in numbers_in(done.stdout)
    assert "[navigation]" in (tmp_path / "results.md").read_text()
    checked = runner.invoke(app, ["report", "--check", "--docs", str(tmp_path)])
    assert isinstance(checked.exception, CommandFailed) and checked.exception.exit_code is ExitCode.FIGURE_MISSED
    assert "navigation" in checked.stdout and numbers_in(str(checked.exception))[:2] == [2, 2]
    (tmp_path / "results" / "navigation.json").write_text("{")
    broken = runner.invoke(app, ["report", "--docs", str(tmp_path)])
    assert isinstance(broken.exception, CommandFailed) and broken.exception.code == "report.results-unusable"


def test_an_error_is_one_line_with_its_code_and_the_documented_exit_code(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "timberhand", "recording", "decode", str(tmp_path / "none.log")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.CONFIGURATION and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("timberhand: ") and line.endswith(" [recording.unreadable]")


WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "{0}":
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
sys.argv = ["timberhand", *{1}]
from timberhand.cli import main
main()
"""


def without(module: str, arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """A command on a computer that lacks a package."""
    command = [sys.executable, "-c", WITHOUT.format(module, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_a_package_that_is_missing_is_one_sentence_and_one_of_ours_is_a_fault(tmp_path: Path) -> None:
    """As on a machine's computer, whose bundle brings no plant."""

    done = without("pybullet", ["demo", "--lockstep"], tmp_path)
    assert done.returncode == ExitCode.CONFIGURATION and done.stderr.count("\n") == 1, done.stderr
    assert "timberhand[sim]" in done.stderr and "--with-plant" in done.stderr and "[package.missing]" in done.stderr
    assert "Traceback" in without("sim", ["demo", "--lockstep"], tmp_path).stderr


def test_an_exit_imports_nothing(tmp_path: Path) -> None:
    """`timberhand service uninstall` has removed the program when it ends."""
    done = without("controller", ["--version"], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
