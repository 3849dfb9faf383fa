"""The journal's catalog: systemd reads it, and it explains exactly the stops that the recorder writes."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.reasons import Reaction, Reason, pack
from recorder.journal import stop_fields
from recorder.stop import Stop

CATALOG = Path(__file__).parents[2] / "deploy/system/timberhand.catalog"


def test_every_reason_that_stops_has_a_text_and_no_other() -> None:
    found = re.findall(r"^-- ([0-9a-f]{32})$", CATALOG.read_text(), re.MULTILINE)
    assert found == [message_id(r) for r, fault in sorted(FAULTS.items()) if fault.reaction >= Reaction.HOLD]


def test_the_catalog_names_only_fields_that_an_entry_has() -> None:
    stop = Stop(
        number=1, at_ns=1, utc_ns=1, mode_before="ACTIVE", mode="STOP", reason=pack(Reason.ENCODER_LOST, 1),
        code="ENCODER_LOST", numbers=(), text="",
    )  # fmt: skip
    wanted = set(re.findall(r"@(\w+)@", CATALOG.read_text()))
    assert wanted and wanted <= set(stop_fields(stop, Path("file")))


@pytest.mark.skipif(shutil.which("journalctl") is None, reason="journalctl is missing (apt-get install systemd)")
def test_systemd_reads_the_catalog(tmp_path: Path) -> None:
    folder = tmp_path / "usr/lib/systemd/catalog"
    folder.mkdir(parents=True)
    (tmp_path / "var/lib/systemd/catalog").mkdir(parents=True)
    shutil.copy(CATALOG, folder)

    def journalctl(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["journalctl", f"--root={tmp_path}", *words], capture_output=True, text=True, check=False
        )  # fmt: skip

    made = journalctl("--update-catalog")
    assert made.returncode == 0 and not made.stderr, made.stderr
    shown = journalctl("--dump-catalog", message_id(Reason.ENCODER_LOST))
    assert "Subject: ENCODER_LOST: The encoder of @TIMBERHAND_PART@ is no longer received" in shown.stdout, shown.stderr
    assert "What to do: Check its cable, then reset and arm." in shown.stdout
