"""The base of all errors that reach a person: a sentence to read and a code to compare."""

from __future__ import annotations

from typing import Any, NamedTuple


class CodedError(Exception):
    """An error with a sentence for people and a code for programs.

    ``code`` is stable; the sentence may be reworded.  A code is written ``area.what`` in lower case with hyphens, for
    example ``profile.unknown-key``.  The site of the documentation lists all of them.
    """

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        # Exception would rebuild itself from the sentence alone when it crosses a process boundary.
        return type(self), (self.code, str(self))


class Problem(NamedTuple):
    """What is wrong, where nothing is raised: the code to compare and the sentence to read, as of a `CodedError`."""

    code: str
    sentence: str
