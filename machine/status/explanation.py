"""Why the machine stopped, part by part, for those who do not show it on one line, and for systemd's journal.

The one text of a reason is `machine.status.faults.describe`.  The journal knows a reason by a MESSAGE_ID, which follows
from the reason's name and so never changes.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from machine.status.evidence import Quantity, quantities
from machine.status.faults import FAULTS, describe, sentence_of
from machine.status.reasons import Reaction, Reason

_NAMESPACE: Final = uuid.uuid5(uuid.NAMESPACE_DNS, "reasons.timberhand")
ERROR, WARNING, NOTICE = 3, 4, 5
"""Priorities of syslog (RFC 5424)."""
_BY_A_PERSON: Final = (Reason.OPERATOR_STOP, Reason.OPERATOR_DISARM)


@dataclass(frozen=True, slots=True)
class Explanation:
    """A reason in words; ``code`` is its name, ``text`` everything on one line."""

    code: str
    sentence: str
    quantities: tuple[Quantity, ...]
    advice: str
    text: str


def explain(reason: int, numbers: Sequence[float | None] = ()) -> Explanation:
    """The explanation of a reason with its detail in bits 8 to 15, as ``StateReport.reason`` carries them.

    Raises:
        ValueError: this release does not know the reason.
    """
    known, detail = Reason(reason & 0xFF), reason >> 8
    return Explanation(
        known.name,
        f"{sentence_of(known, detail)}.",
        quantities(known, detail, numbers),
        FAULTS[known].advice,
        describe(reason, numbers=numbers),
    )


def message_id(reason: Reason) -> str:
    """The MESSAGE_ID of a reason in the journal: 32 hexadecimal digits."""
    return uuid.uuid5(_NAMESPACE, reason.name).hex


def priority(reason: Reason) -> int:
    """How serious a stop is, as a priority of syslog."""
    if reason in _BY_A_PERSON:
        return NOTICE
    return ERROR if FAULTS[reason].reaction >= Reaction.RAMP else WARNING
