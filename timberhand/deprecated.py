"""Former spellings of commands and options, which keep working: scripts and continuous integration use them.

`current_spelling` rewrites a command line from the table below.  docs/reference/cli.md lists the same table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final


@dataclass(frozen=True, slots=True)
class Renamed:
    """A renamed command (``old`` and ``new`` as words), or a renamed option of the command ``old``, and its values."""

    old: tuple[str, ...]
    new: tuple[str, ...] = ()
    option: str = ""
    new_option: str = ""
    values: dict[str, str] = field(default_factory=dict)


RENAMED: Final = (
    Renamed(("log",), ("recording",)),
    Renamed(("sim", "shot"), ("sim", "picture")),
    Renamed(("train", "judges"), ("train", "scorers")),
    Renamed(
        ("mission", "run"), option="--eyes", new_option="--detector", values={"faithful": "paper-b", "ours": "own"}
    ),
    Renamed(("mission", "run"), option="--way", new_option="--manager", values={"ours": "own"}),
    Renamed(("mission", "run"), option="--patience", new_option="--max-stops"),
    Renamed(("demo",), option="--patience", new_option="--max-stops"),
)


def current_spelling(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The command line in today's words, and one note for each word that was replaced.

    Words after ``--`` belong to another program and stay as they are.
    """
    end = list(arguments).index("--") if "--" in arguments else len(arguments)
    words, rest, notes = list(arguments[:end]), list(arguments[end:]), []
    for rule in RENAMED:
        if tuple(words[: len(rule.old)]) != rule.old:
            continue
        if rule.new:
            words[: len(rule.old)] = rule.new
            notes.append(f"`{' '.join(rule.old)}` is now `{' '.join(rule.new)}`")
            continue
        for i, word in enumerate(words):
            name, equals, value = word.partition("=")
            if name != rule.option:
                continue
            if equals:
                new = words[i] = f"{rule.new_option}={rule.values.get(value, value)}"
                notes.append(f"`{word}` is now `{new}`")
                continue
            words[i] = new = rule.new_option
            if i + 1 < len(words) and rule.values:
                old_value = words[i + 1]
                words[i + 1] = rule.values.get(old_value, old_value)
                word, new = f"{word} {old_value}", f"{new} {words[i + 1]}"
            notes.append(f"`{word}` is now `{new}`")
    return [*words, *rest], notes
