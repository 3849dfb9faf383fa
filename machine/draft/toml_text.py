"""Writes TOML with the origin of every value behind it, as in the shipped profiles."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

GIVEN: Final = "given"
DERIVED: Final = "derived"
START: Final = "start"
SET: Final = "set"
LEGEND: Final = """\
# Where every value comes from:
#   [given]   an answer of the questionnaire
#   [derived] computed from answers
#   [start]   a starting value of a middling loader: calibrate, then tune
#   [set]     policy and names
"""
_COLUMN: Final = 38
Line = tuple[str, Any, str]
"""Key, value, origin with an explanation."""


def value_text(value: Any) -> str:
    """One TOML value; floats keep all their digits."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return repr(value)


def table(path: str, lines: Iterable[Line]) -> str:
    """A table; ``path`` empty: the top of a file."""
    out = [f"[{path}]"] if path else []
    for key, value, origin in lines:
        kind, _, more = origin.partition(" ")
        out.append(f"{f'{key} = {value_text(value)}':<{_COLUMN}} # [{kind}]{f' {more}' if more else ''}")
    return "\n".join([*out, "", ""])
