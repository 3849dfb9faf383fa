"""One problem of a profile: a code for programs, the key path, and a sentence for people."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong with the value at a key path.

    ``code`` is stable (``profile.what``); ``sentence`` says what is wrong and what is allowed, and may be reworded.
    """

    code: str
    path: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.path}: {self.sentence}"
