"""Reads ``timberhand.conf``: names and values with their lines, against the settings that this release knows.

Pure but for `read`.  The shipped file is the list of what exists: its names, their values and the words about them.
`parts` lists every file that decides how a machine behaves.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

from controller.guard.__main__ import profile_path
from controller.guard.envelope import SHIPPED as ENVELOPES
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import ConfigError

INSTALLED: Final = Path("/etc/timberhand/timberhand.conf")
ROOT: Final = Path(__file__).parents[2]
SHIPPED: Final = ROOT / "deploy" / "timberhand.conf"
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


# -- What a machine's configuration consists of: settings, profile, envelope, frames, object dictionaries, weights.
#
# Each with its SHA-256, so that two computers, or a computer and an acceptance protocol, can be compared.

CONTENTS: Final = (("frames", "can_dbc/*.dbc"), ("objects", "can_dbc/*.eds"), ("weights", "autonomy/weights/*"))
"""What comes with the program: a word for it, and its files."""


@dataclass(frozen=True, slots=True)
class Part:
    """A file of the configuration."""

    kind: str
    path: Path
    sha256: str


def parts(settings: Path, profile: str) -> Iterator[Part]:
    """List every file that decides how this machine behaves; those that are missing are left out."""
    own = profile_path(profile)
    name = load_profile(profile).name
    beside = own.with_name(f"{name}.envelope.toml")
    yield from _part("settings", settings)
    yield from _part("profile", own)
    yield from _part("envelope", beside if beside.is_file() else ENVELOPES / beside.name)
    for kind, pattern in CONTENTS:
        for path in sorted(ROOT.glob(pattern)):
            if path.is_file() and path.suffix != ".md":
                yield from _part(kind, path)


def _part(kind: str, path: Path) -> Iterator[Part]:
    if path.is_file():
        yield Part(kind, path, hashlib.sha256(path.read_bytes()).hexdigest())


def profile_word(profile: str) -> str:
    """Return the machine's name, and the hash that every datagram carries."""
    machine = load_profile(profile)
    return f"{machine.name} ({machine.title}), profile hash {profile_hash(machine):08x}"


def effective(path: Path) -> dict[str, tuple[Setting, bool]]:
    """Map name -> setting in force, and whether it differs from the shipped one, which stands in for one that lacks."""
    shipped, own_settings = parse(read(SHIPPED), []), parse(read(path), [])
    in_force = shipped | own_settings
    return {name: (s, name not in shipped or shipped[name].value != s.value) for name, s in in_force.items()}


def differences(first: Path, second: Path) -> list[tuple[str, Any, Any]]:
    """List (key path, first value, second value) of two settings files, or of two TOML files; None: not there."""
    a, b = _flat(first), _flat(second)
    return [(key, a.get(key), b.get(key)) for key in sorted(a.keys() | b.keys()) if a.get(key) != b.get(key)]


def _flat(path: Path) -> dict[str, Any]:
    text = read(path)
    if path.suffix != ".toml":
        return {name: setting.value for name, setting in parse(text, []).items()}
    values: dict[str, Any] = {}
    try:
        _flatten(tomllib.loads(text), "", values)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError("settings.broken-toml", f"{path} is no TOML file: {error}") from None
    return values


def _flatten(value: Any, place: str, found: dict[str, Any]) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(inner, f"{place}.{key}" if place else key, found)
    else:
        found[place] = value
