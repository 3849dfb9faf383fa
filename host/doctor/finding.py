"""The result of one check, with the suggested change."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class Severity(IntEnum):
    """The severity of a finding; only FAULT prevents the machine from running."""

    FINE = 0
    ADVICE = 1
    CHANGE = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """``what`` names the topic, ``sentence`` describes it; ``gain`` and ``commands`` belong to a suggested change."""

    what: str
    severity: Severity
    sentence: str
    gain: str = ""
    commands: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """The finding as plain values for JSON."""
        return {
            "what": self.what, "severity": self.severity.name.lower(), "sentence": self.sentence,
            "gain": self.gain, "commands": list(self.commands),
        }  # fmt: skip


def fine(what: str, sentence: str) -> Finding:
    """A finding without a suggested change."""
    return Finding(what, Severity.FINE, sentence)
