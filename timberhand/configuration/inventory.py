"""What a machine's configuration consists of: settings, profile, envelope, frames, object dictionaries, weights.

Each with its SHA-256, so that two computers, or a computer and an acceptance protocol, can be compared.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.guard.__main__ import profile_path
from controller.guard.envelope import SHIPPED as ENVELOPES
from machine.loading.profile_file import load_profile, profile_hash
from timberhand.configuration.settings_file import SHIPPED, Setting, parse, read

ROOT: Final = Path(__file__).parents[2]
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
    """Map name -> setting, and whether it differs from the shipped one."""
    shipped = parse(read(SHIPPED), [])
    own_settings = parse(read(path), [])
    return {name: (s, name not in shipped or shipped[name].value != s.value) for name, s in own_settings.items()}


def differences(first: Path, second: Path) -> list[tuple[str, Any, Any]]:
    """List (key path, first value, second value) of two settings files, or of two TOML files; None: not there."""
    a, b = _flat(first), _flat(second)
    return [(key, a.get(key), b.get(key)) for key in sorted(a.keys() | b.keys()) if a.get(key) != b.get(key)]


def _flat(path: Path) -> dict[str, Any]:
    text = read(path)
    if path.suffix != ".toml":
        return {name: setting.value for name, setting in parse(text, []).items()}
    values: dict[str, Any] = {}
    _flatten(tomllib.loads(text), "", values)
    return values


def _flatten(value: Any, place: str, found: dict[str, Any]) -> None:
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(inner, f"{place}.{key}" if place else key, found)
    else:
        found[place] = value
