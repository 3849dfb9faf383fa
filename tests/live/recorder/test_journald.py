"""The entry of a stop in the real systemd-journald, in a mount namespace of its own, read back by journalctl."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from machine.status.faults import FAULTS
from machine.status.reasons import Reason

ROOT = Path(__file__).parents[3]
JOURNALD = Path("/lib/systemd/systemd-journald")
CATALOG = Path("/usr/lib/systemd/catalog")
pytestmark = [
    pytest.mark.skipif(
        os.getuid() != 0 or not JOURNALD.exists() or not CATALOG.is_dir() or shutil.which("unshare") is None,
        reason="needs root and systemd (apt-get install systemd)",
    ),
]
STOP_TEXT = "The encoder of joint lift is no longer received. [ENCODER_LOST]"
SCRIPT = f"""
set -e
mount -t tmpfs none /run
mount -t tmpfs none /var/lib/systemd
mount -t tmpfs none {CATALOG}
mkdir -p /run/systemd/journal /run/log/journal /var/lib/systemd/catalog
cp {ROOT}/deploy/system/timberhand.catalog {CATALOG}/
journalctl --update-catalog
{JOURNALD} &
until [ -S /run/systemd/journal/socket ]; do sleep 0.05; done
{sys.executable} -c '
from pathlib import Path
from recorder.__main__ import write_to_journal
from recorder.stop_recorder import Stop
write_to_journal(Stop(number=4, at_ns=5, utc_ns=6, mode_before="ACTIVE", mode="STOP", reason=25 | 1 << 8,
    code="ENCODER_LOST", numbers=(20.0, 15.0, 0.0), text="{STOP_TEXT}"), Path("/stops/4.mcap"))
'
tries=0
until journalctl -D /run/log/journal -t timberhand --quiet --no-pager -o json >"$1" 2>/dev/null && [ -s "$1" ]; do
    tries=$((tries + 1)); [ $tries -lt 100 ]; sleep 0.05
done
journalctl -D /run/log/journal -t timberhand -x --no-pager
kill $!
"""


def test_the_journal_keeps_the_fields_and_explains_the_stop(tmp_path: Path) -> None:
    done = subprocess.run(
        ["unshare", "--mount", "--propagation", "private", "sh", "-c", SCRIPT, "sh", str(tmp_path / "json")],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    entry = json.loads((tmp_path / "json").read_text())
    assert entry["TIMBERHAND_CODE"] == "ENCODER_LOST" and entry["PRIORITY"] == "3"
    assert entry["MESSAGE"] == f"STOP: {STOP_TEXT}" and entry["TIMBERHAND_FILE"] == "/stops/4.mcap"
    assert "Subject: ENCODER_LOST: " in done.stdout and "joint lift" in done.stdout
    assert "20.0 ms" in done.stdout and "15.0 ms" in done.stdout
    assert FAULTS[Reason.ENCODER_LOST].advice in done.stdout
