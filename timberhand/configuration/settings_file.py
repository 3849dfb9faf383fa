"""Reads ``timberhand.conf``: names and values with their lines, against the settings that this release knows.

Pure but for `read`.  The shipped file is the list of what exists: its names, their values and the words about them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from runtime.errors import ConfigError

INSTALLED: Final = Path("/etc/timberhand/timberhand.conf")
SHIPPED: Final = Path(__file__).parents[2] / "deploy" / "timberhand.conf"
_LINE: Final = re.compile(r"([A-Z][A-Z0-9_]*)=(.*)")


@dataclass(frozen=True, slots=True)
class Setting:
    """A value and its line, counted from 1."""

    value: str
    line: int


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong where, and what to do; ``line`` 0: about the file as a whole.

    ``note``: the services run with it all the same.
    """

    line: int
    sentence: str
    note: bool = False


def read(path: Path) -> str:
    """Read the text of a settings file; raises ConfigError."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError("settings.unreadable", f"{path} cannot be read: {error.strerror}; name a file") from None
    except UnicodeDecodeError as error:
        raise ConfigError("settings.not-utf8", f"{path} is not UTF-8 text at byte {error.start}") from None


def parse(text: str, problems: list[Problem]) -> dict[str, Setting]:
    """Read name -> setting; append to ``problems`` what is no setting, or is set twice (the last counts)."""
    settings: dict[str, Setting] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith(("#", ";")):
            continue
        match = _LINE.fullmatch(line.rstrip())
        if match is None:
            problems.append(Problem(number, f"{line.strip()[:60]!r} is no setting; write NAME=value without spaces"))
            continue
        name, value = match.groups()
        if name in settings:
            problems.append(Problem(number, f"{name} stands in line {settings[name].line}, too; remove one of them"))
        settings[name] = Setting(value, number)
    return settings


def unknown(settings: dict[str, Setting], known: dict[str, Setting]) -> Iterator[Problem]:
    """Report names that this release does not have, and those that the file lacks."""
    for name, setting in settings.items():
        if name not in known:
            similar_names = get_close_matches(name, known, 1)
            hint = f"; did you mean {similar_names[0]}?" if similar_names else "; remove it"
            yield Problem(setting.line, f"there is no setting {name}{hint}")
    for name in known:
        if name not in settings:
            sentence = f"{name} is missing, so it is as this release ships it; timberhand config migrate adds it"
            yield Problem(0, sentence, note=True)


def migrated(text: str, shipped: str) -> tuple[str, list[str]]:
    """Return the shipped file with the values of ``text``, and what was done about names that it does not have."""
    own_settings = parse(text, [])
    known = parse(shipped, [])
    lines = shipped.splitlines()
    notes = []
    for name, setting in known.items():
        if name in own_settings:
            lines[setting.line - 1] = f"{name}={own_settings[name].value}"
        else:
            notes.append(f"{name} is new: {setting.value or 'empty'}")
    for name in own_settings.keys() - known.keys():
        notes.append(f"{name}={own_settings[name].value} is gone: this release has no such setting")
    return "\n".join(lines) + "\n", sorted(notes)
