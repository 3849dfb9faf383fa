"""The texts of `journalctl -x`: one entry of systemd's message catalog for every reason that stops the machine."""

from __future__ import annotations

from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.reasons import Fault, Reaction, Reason


def page() -> str:
    """deploy/system/timberhand.catalog; the fields in ``@`` are those of `recorder.journal.stop_fields`."""
    head = "# generated from `machine.status.faults.FAULTS` by `python -m timberhand.reference`; do not edit\n"
    stops = (entry for entry in sorted(FAULTS.items()) if entry[1].reaction >= Reaction.HOLD)
    return head + "".join(_entry(reason, fault) for reason, fault in stops)


def _entry(reason: Reason, fault: Fault) -> str:
    sentence = fault.sentence.format("@TIMBERHAND_PART@")
    return f"""
-- {message_id(reason)}
Subject: {reason.name}: {sentence}
Defined-By: timberhand

{sentence}.
The mode changed from @TIMBERHAND_MODE_BEFORE@ to @TIMBERHAND_MODE@.
Measured: @TIMBERHAND_MEASURED@.

What to do: {fault.advice}

What happened around the stop: timberhand why @TIMBERHAND_FILE@
"""
