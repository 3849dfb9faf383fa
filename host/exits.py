"""The exit codes, in one place, and the one exception that ends a command with a sentence."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """What the shell sees (design section 9)."""

    FINE = 0
    USAGE = 2
    CONFIGURATION = 3
    BUS = 4
    SAFETY = 5
    FIGURE = 6
    INTERRUPTED = 130


class Stopped(Exception):
    """Ends the command: one clear sentence for stderr and the exit code."""

    def __init__(self, code: Exit, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code
