"""The command line as a whole: threads, version, errors, and the page of the saved results."""

from __future__ import annotations

import pickle
from importlib.metadata import version
from pathlib import Path

import pytest
from typer.testing import CliRunner

from experiments.common.result import sealed_seed
from host.exit_codes import CommandFailed, ExitCode
from timberhand.cli import app

DOCS = Path(__file__).parents[2] / "docs"


def test_a_page_of_the_checkout_is_refused_while_sources_are_not_committed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.common.result.commit", lambda: "0123456789ab+changes")
    refused = CliRunner().invoke(app, ["experiment", "plant", "--quick", "--docs", str(DOCS)])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.code == "experiment.uncommitted"
    sealed = CliRunner().invoke(app, ["experiment", "plant", "--quick", "--sealed"])
    assert isinstance(sealed.exception, CommandFailed) and sealed.exception.code == "experiment.uncommitted"


def test_a_sealed_run_gets_the_seed_of_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("experiments.common.result.commit", lambda: "0123456789ab")
    monkeypatch.setattr("experiments.common.registry.load", lambda _: lambda options, _: given.append(options.seed))
    CliRunner().invoke(app, ["experiment", "plant", "--sealed"])
    assert given == [sealed_seed("0123456789ab", "plant")]


def test_the_version_is_that_of_the_package() -> None:
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0 and done.stdout == f"timberhand {version('timberhand')}\n"


def test_a_command_failure_crosses_process_boundaries() -> None:
    failure = CommandFailed("area.what", "a sentence", ExitCode.BUS)
    copy = pickle.loads(pickle.dumps(failure))
    assert (copy.code, str(copy), copy.exit_code) == ("area.what", "a sentence", ExitCode.BUS)
