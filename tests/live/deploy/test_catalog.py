"""The journal's catalog: systemd reads it, and it explains exactly the stops that the recorder writes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.reasons import Reason

CATALOG = Path(__file__).parents[3] / "deploy/system/timberhand.catalog"


@pytest.mark.skipif(shutil.which("journalctl") is None, reason="journalctl is missing (apt-get install systemd)")
def test_systemd_reads_the_catalog(tmp_path: Path) -> None:
    folder = tmp_path / "usr/lib/systemd/catalog"
    folder.mkdir(parents=True)
    (tmp_path / "var/lib/systemd/catalog").mkdir(parents=True)
    shutil.copy(CATALOG, folder)

    def journalctl(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["journalctl", f"--root={tmp_path}", *words], capture_output=True, text=True, check=False)

    made = journalctl("--update-catalog")
    assert made.returncode == 0 and not made.stderr, made.stderr
    shown = journalctl("--dump-catalog", message_id(Reason.ENCODER_LOST))
    assert "Subject: ENCODER_LOST: " in shown.stdout and "@TIMBERHAND_PART@" in shown.stdout, shown.stderr
    assert FAULTS[Reason.ENCODER_LOST].advice in shown.stdout
