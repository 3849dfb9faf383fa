"""The record of a service that failed: written by the units' script, read by ``timberhand why``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.codes import numbers_in
from timberhand.cli import app
from timberhand.commands import why
from timberhand.why import stops as records
from timberhand.why.stops import Failure, newest_failure

GUARD = "timberhand-guard.service"
RUNNER = CliRunner()


def test_only_what_failed_since_the_last_stop_is_told_with_its_number(tmp_path: Path) -> None:
    file = tmp_path / "failures.jsonl"
    text = '{"unit": "%s", "result": "signal", "code": "killed", "status": "KILL", "utc_s": %d, "release": "1.0-a"}\n'
    file.write_text("".join(text % pair for pair in (("a", 10), (GUARD, 20), ("a", 25), (GUARD, 30))) + '{"unit": "cu')
    newest = newest_failure(15 * 10**9, file)
    assert newest is not None and (newest[0].utc_s, newest[1]) == (30, 2)
    assert newest_failure(40 * 10**9, file) is None and newest_failure(None, tmp_path / "none") is None


def test_why_tells_a_failure_where_there_is_no_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = Failure(unit=GUARD, result="watchdog", code="killed", status="KILL", utc_s=86400, release="1.0-abc")
    monkeypatch.setattr(records, "newest_failure", lambda after: (found, 3) if after is None else None)
    monkeypatch.setattr(why, "_explain", lambda *_: (0, None))
    done = RUNNER.invoke(app, ["why"])
    assert done.exit_code == 0 and GUARD in done.stdout
    assert "1970-01-02 00:00:00" in done.stdout and 3 in numbers_in(done.stdout) and "journalctl -u" in done.stdout
    assert json.loads(RUNNER.invoke(app, ["why", "--json"]).stdout)["failure"]["times"] == 3
