"""One thing that was looked at, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class Severity(IntEnum):
    """How much it matters.  Only FAULT prevents the machine from running."""

    FINE = 0
    ADVICE = 1
    CHANGE = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """``what`` in a word or two, ``sentence``: how it is; unless it is fine, ``gain`` and ``commands`` to change it."""

    what: str
    severity: Severity
    sentence: str
    gain: str = ""
    commands: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "what": self.what, "severity": self.severity.name.lower(), "sentence": self.sentence,
            "gain": self.gain, "commands": list(self.commands),
        }  # fmt: skip


def fine(what: str, sentence: str) -> Finding:
    """Nothing to do."""
    return Finding(what, Severity.FINE, sentence)
