"""The record of a service that failed: written by the units' script, read by ``timberhand why``."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from timberhand.cli import app
from timberhand.commands import why
from timberhand.why import failures as records
from timberhand.why.failures import Failure, failures, newest_failure

SCRIPT = Path(__file__).parents[2] / "deploy/system/service-ended"
GUARD = "timberhand-guard.service"
RUNNER = CliRunner()


def ended(file: Path, result: str, code: str = "exited", status: str = "1", unit: str = GUARD) -> None:
    """What systemd runs when a service has ended."""
    told = {"SERVICE_RESULT": result, "EXIT_CODE": code, "EXIT_STATUS": status, "TIMBERHAND_FAILURES": str(file)}
    subprocess.run(["sh", SCRIPT, unit], env={"PATH": os.defpath} | told, check=True, capture_output=True)


def test_a_failure_leaves_a_record_and_a_good_end_none(tmp_path: Path) -> None:
    file = tmp_path / "folder/failures.jsonl"
    ended(file, "success", status="0")
    ended(file, "exec-condition")
    assert not file.exists()
    ended(file, "watchdog", "killed", "KILL")
    ended(file, "exit-code", status="3")
    hung, refused = failures(file)
    assert abs(hung.utc_s - time.time()) < 60 and hung.unit == GUARD
    assert "hung, ended by the watchdog" in hung.sentence and "exit status 3, configuration" in refused.sentence


def test_a_service_that_fails_for_ever_does_not_fill_the_disk(tmp_path: Path) -> None:
    file = tmp_path / "failures.jsonl"
    line = {"unit": GUARD, "result": "signal", "code": "killed", "status": "KILL", "utc_s": 1, "release": ""}
    file.write_text("".join(json.dumps(line | {"utc_s": n}) + "\n" for n in range(400)))
    ended(file, "signal", "killed", "SEGV")
    kept = list(failures(file))
    assert len(kept) == 200 and kept[-1].status == "SEGV" and kept[0].utc_s == 201


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
    assert done.exit_code == 0 and "timberhand-guard.service failed at 1970-01-02 00:00:00 UTC" in done.stdout
    assert "3 times" in done.stdout and "journalctl -u" in done.stdout
    assert json.loads(RUNNER.invoke(app, ["why", "--json"]).stdout)["failure"]["times"] == 3
