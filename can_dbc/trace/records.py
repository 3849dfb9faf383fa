"""What a reader of traces yields besides frames, and what it says at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from can_dbc.frame import Frame


class MalformedRecord(NamedTuple):
    """A record that cannot be parsed: line number (0 in a binary file) and its text."""

    line: int
    text: str


class Trace(Iterator[Frame | MalformedRecord]):
    """The records of a trace in file order; ``notes`` is complete behind the last one and says what is not read."""

    def __init__(self, reader: Callable[[list[str]], Iterator[Frame | MalformedRecord]]) -> None:
        self.notes: list[str] = []
        self._records = reader(self.notes)

    def __next__(self) -> Frame | MalformedRecord:
        return next(self._records)
