"""What a reader of traces yields, and what it says at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Self

from can_dbc.frame import Frame


class TraceFrame(Frame):
    """A frame of a trace with the interface (or channel) that the trace names, "" if it names none."""

    interface: str

    def __new__(cls, stamp_ns: int, key: int, data: bytes, interface: str = "") -> Self:
        """Make the record as a ``Frame``, which it equals."""
        frame = super().__new__(cls, stamp_ns, key, data)
        frame.interface = interface
        return frame


class MalformedRecord(NamedTuple):
    """A record that cannot be parsed: line number (0 in a binary file) and its text."""

    line: int
    text: str

    @property
    def shown(self) -> str:
        """For people: the line's number and what of its beginning can be printed; a sentence on a binary file whole."""
        if not self.line:
            return self.text
        text = "".join(c if c.isprintable() else "�" for c in self.text[:80])
        return f"line {self.line}: {text}"


class Trace(Iterator[TraceFrame | MalformedRecord]):
    """The records of a trace in file order; ``notes`` is complete behind the last one and says what is not read."""

    def __init__(self, reader: Callable[[list[str]], Iterator[TraceFrame | MalformedRecord]]) -> None:
        self.notes: list[str] = []
        self._records = reader(self.notes)

    def __next__(self) -> TraceFrame | MalformedRecord:
        return next(self._records)
