"""What `timberhand service install` and `uninstall` hand on to the installer."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

import deploy.__main__ as installer
from timberhand.commands.service import app


@pytest.mark.parametrize(
    ("given", "handed_on"),
    [
        (["install"], []),
        (["install", "--wheel", "a.whl", "--cpu", "0", "--dry-run"], ["--wheel", "a.whl", "--cpu", "0", "--dry-run"]),
        (["install", "--from-environment", "/e"], ["--from-environment", "/e"]),
        (["uninstall", "--root", "/r"], ["--uninstall", "--root", "/r"]),
    ],
)
def test_the_installer_is_given_the_options_by_their_own_names(
    monkeypatch: pytest.MonkeyPatch, given: list[str], handed_on: list[str]
) -> None:
    seen: list[str] = []
    monkeypatch.setattr(installer, "install", lambda words: seen.extend(words) or 7)
    assert CliRunner().invoke(app, given).exit_code == 7
    assert seen == handed_on
