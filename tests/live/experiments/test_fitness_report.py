"""The real-time report: verdicts from figures, the text without private words, and one real measurement."""

from __future__ import annotations

import getpass
import platform
from pathlib import Path

import pytest
from typer.testing import CliRunner

from experiments.timing.fitness import private_words, read_data, without_private
from host.exit_codes import ExitCode
from timberhand.cli import app


@pytest.mark.timeout(300)
def test_the_command_measures_and_writes_a_report_without_names(tmp_path: Path) -> None:
    out = tmp_path / "report.md"
    arguments = ["doctor", "--rt", "--report", "--seconds", "3", "--bus", "wire", "--out", str(out)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code in (ExitCode.OK, ExitCode.FIGURE_MISSED), done.output
    text = out.read_text()
    data = read_data(text)
    figures = data["measured"]["figures"]
    assert figures["ticks"] + figures["missed"] > 500 and figures["tick_p50_us"] > 0
    assert data["settings"]["release"] == platform.release()
    assert {j["topic"] for j in data["judgements"]} == {"rights", "wake-ups", "tick", "frames", "memory", "stops"}
    assert str(tmp_path) not in text
    words = private_words(platform.node(), getpass.getuser())
    assert without_private(data, words) == data
