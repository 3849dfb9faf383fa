"""The errors that reach a person: a sentence to read, a code to compare, a class for what a caller can do about it."""

from __future__ import annotations

from typing import Any, NamedTuple


class TimberhandError(Exception):
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


class InputRefused(TimberhandError, ValueError):
    """What was given is wrong: a file, a picture, a text, a number, an option.  Give another one."""


class ConfigError(TimberhandError, ValueError):
    """The installation is wrong: a database, a register map, a setting, a key, an account, a plug-in.  Correct it."""


class LinkError(TimberhandError):
    """What is outside this process does not answer: a bus, a PLC, a camera, a network.  Check it, and try again."""


class Problem(NamedTuple):
    """What is wrong, where nothing is raised: code and sentence, as of a `TimberhandError`."""

    code: str
    sentence: str
