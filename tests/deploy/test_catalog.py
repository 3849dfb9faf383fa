"""The journal's catalog: systemd reads it, and it explains exactly the stops that the recorder writes."""

from __future__ import annotations

import re
from pathlib import Path

from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.reasons import Reaction, Reason, pack
from recorder.__main__ import stop_fields
from recorder.stop_recorder import Stop

CATALOG = Path(__file__).parents[2] / "deploy/system/timberhand.catalog"


def test_every_reason_that_stops_has_a_text_and_no_other() -> None:
    found = re.findall(r"^-- ([0-9a-f]{32})$", CATALOG.read_text(), re.MULTILINE)
    assert found == [message_id(r) for r, fault in sorted(FAULTS.items()) if fault.reaction >= Reaction.HOLD]


def test_the_catalog_names_only_fields_that_an_entry_has() -> None:
    stop = Stop(
        number=1,
        at_ns=1,
        utc_ns=1,
        mode_before="ACTIVE",
        mode="STOP",
        reason=pack(Reason.ENCODER_LOST, 1),
        code="ENCODER_LOST",
        numbers=(),
        text="",
    )
    wanted = set(re.findall(r"@(\w+)@", CATALOG.read_text()))
    assert wanted and wanted <= set(stop_fields(stop, Path("file")))
