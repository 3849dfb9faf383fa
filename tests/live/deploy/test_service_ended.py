"""The record of a service that failed: written by the units' script, read by ``timberhand why``."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path

from tests.codes import numbers_in
from timberhand.why.stops import failures

SCRIPT = Path(__file__).parents[3] / "deploy/system/service-ended"
GUARD = "timberhand-guard.service"


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
    assert (hung.result, hung.code, hung.status) == ("watchdog", "killed", "KILL")
    assert 3 in numbers_in(refused.sentence) and hung.sentence


def test_a_service_that_fails_for_ever_does_not_fill_the_disk(tmp_path: Path) -> None:
    file = tmp_path / "failures.jsonl"
    line = {"unit": GUARD, "result": "signal", "code": "killed", "status": "KILL", "utc_s": 1, "release": ""}
    file.write_text("".join(json.dumps(line | {"utc_s": n}) + "\n" for n in range(400)))
    ended(file, "signal", "killed", "SEGV")
    kept = list(failures(file))
    assert len(kept) == 200 and kept[-1].status == "SEGV" and kept[0].utc_s == 201
