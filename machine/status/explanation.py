"""A stop: when one begins, and any reason in words; the one place for recorder, ``timberhand why``, page and journal.

A stop begins when the mode enters STOP or FAULT from another mode, and when its reason changes to another one while the
machine is stopped (a second fault during the ramp).  A FAULT that follows the ramp of its STOP is the same stop.

The journal knows a reason by a MESSAGE_ID, which follows from the reason's name and so never changes.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from machine.crane_nodes import NODE_NAMES
from machine.joints import ARTICULATION, JOINTS
from machine.status.evidence import Quantity, quantities
from machine.status.faults import FAULTS
from machine.status.modes import STOPPED, mode_name
from machine.status.reasons import DetailKind, Reaction, Reason

ERROR, WARNING, NOTICE = 3, 4, 5
"""Priorities of syslog (RFC 5424)."""
_NAMESPACE: Final = uuid.uuid5(uuid.NAMESPACE_DNS, "reasons.timberhand")
_BY_A_PERSON: Final = (Reason.OPERATOR_STOP, Reason.OPERATOR_DISARM)
_BUS_NAMES: Final = ("the crane bus", "the machine bus")
_ARM_NAMES: Final = ("front left", "front right", "rear left", "rear right")


class StopDetector:
    """Finds stops in a sequence of modes and reasons, as state reports carry them."""

    def __init__(self) -> None:
        self._mode: int | None = None
        self._reason = 0
        self._before = "unknown"

    def step(self, mode: int, reason: int) -> str | None:
        """Return the mode before a stop that begins with this report; None when none begins.

        A machine that is stopped already in the first report has stopped before it: no stop begins.
        """
        before, changed = self._mode, reason != self._reason
        self._mode, self._reason = mode, reason
        if mode not in STOPPED:
            self._before = mode_name(mode)
            return None
        return self._before if before is not None and (before not in STOPPED or changed) else None


@dataclass(frozen=True, slots=True)
class Explanation:
    """A reason in words; ``code`` is its name, ``part`` what its detail names."""

    code: str
    sentence: str
    quantities: tuple[Quantity, ...]
    advice: str
    part: str

    @property
    def measured(self) -> str:
        """The numbers, as in ``age of its last good sample 20.0 ms, limit 15.0 ms``; empty without any."""
        return ", ".join(quantity.text for quantity in self.quantities)

    @property
    def finding(self) -> str:
        """Sentence without its full stop, and the numbers."""
        return self.sentence[:-1] + (f" ({self.measured})" if self.quantities else "")

    @property
    def text(self) -> str:
        """Sentence, numbers, advice, and in brackets the code: the one text of a reason."""
        code = "" if self.code == Reason.NONE.name else f" [{self.code}]"
        return f"{self.finding}. {self.advice}{code}"


def explain(reason: int, numbers: Sequence[float | None] = ()) -> Explanation:
    """Explain a reason with its detail in bits 8 to 15, as ``StateReport.reason`` carries them.

    Raises:
        ValueError: this release does not know the reason.
    """
    known, detail = Reason(reason & 0xFF), reason >> 8
    fault = FAULTS[known]
    part = part_of(fault.about, detail)
    sentence = fault.sentence.format(part).rstrip(".")
    evidence = quantities(known, detail, numbers)
    return Explanation(known.name, f"{sentence[0].upper()}{sentence[1:]}.", evidence, fault.advice, part)


def describe(reason: int, detail: int = 0, numbers: Sequence[float | None] = ()) -> str:
    """Return `Explanation.text` of a reason; ``reason`` may carry its detail in bits 8 to 15."""
    return explain(reason & 0xFF | (detail or reason >> 8) << 8, numbers).text


def sentence_of(reason: Reason, detail: int = 0) -> str:
    """Return the operator's sentence without its full stop."""
    return explain(reason | detail << 8).sentence[:-1]


def part_of(about: DetailKind, detail: int) -> str:
    """Name the part of a detail; empty when it names none."""
    match about:
        case DetailKind.JOINT:
            if detail < len(JOINTS):
                return f"joint {JOINTS[detail].name.lower()}"
            return "the articulation" if detail == ARTICULATION else f"joint {detail}"
        case DetailKind.NODE:
            return NODE_NAMES.get(detail, f"node {detail}")
        case DetailKind.BUS:
            return _BUS_NAMES[detail] if detail < len(_BUS_NAMES) else f"bus {detail}"
        case DetailKind.ARM:
            return _ARM_NAMES[detail] if detail < len(_ARM_NAMES) else f"swing {detail}"
        case _:
            return ""


def message_id(reason: Reason) -> str:
    """Return the MESSAGE_ID of a reason in the journal: 32 hexadecimal digits."""
    return uuid.uuid5(_NAMESPACE, reason.name).hex


def priority(reason: Reason) -> int:
    """Tell how serious a stop is, as a priority of syslog."""
    if reason in _BY_A_PERSON:
        return NOTICE
    return ERROR if FAULTS[reason].reaction >= Reaction.RAMP else WARNING
