"""Quick runs of experiments by their command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from timberhand.cli import app


def quick_result(name: str, out: Path, *more: str) -> dict[str, Any]:
    """The result of a quick run, which may miss a limit: its trials are few."""
    done = CliRunner().invoke(app, ["experiment", name, "--quick", "--out", str(out), *more])
    missed = isinstance(done.exception, CommandFailed) and done.exception.exit_code is ExitCode.FIGURE_MISSED
    assert done.exit_code == 0 or missed, done.output
    document: dict[str, Any] = json.loads((out / "result.json").read_text())
    return document
