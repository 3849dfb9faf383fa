"""Builds a struct from the tables of a TOML file, and names every key and type that does not fit.

All problems are found in one pass, each with its full key path, so that few rounds correct a file.
"""

from __future__ import annotations

import types
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Final, Literal, get_args, get_origin

import msgspec

from machine.joints import JOINTS
from machine.profile import JointSpec

_UNIT_SUFFIXES: Final = (
    "_rad_s2",
    "_rad_s",
    "_deg_s2",
    "_deg_s",
    "_m_s2",
    "_m_s",
    "_mm_s",
    "_1_s",
    "_degrees",
    "_deg",
    "_rad",
    "_mm",
    "_cm",
    "_ms",
    "_ns",
    "_us",
    "_hz",
    "_bar",
    "_mpa",
    "_pa",
    "_pct",
    "_percent",
    "_px",
    "_m",
    "_s",
)
_JOINT_NAMES: Final = tuple(j.name.lower() for j in JOINTS)


def did_you_mean(word: str, known: tuple[str, ...]) -> str:
    """Write the end of a sentence with the known word that is nearest, empty without one."""
    close = get_close_matches(word, known, 1)
    return f'; did you mean "{close[0]}"?' if close else ""


def build(kind: Any, value: Any, path: str, problems: list[Problem]) -> Any:
    """Convert ``value`` to ``kind``; adds every mismatch to ``problems`` with its full key path."""
    if get_origin(kind) is types.UnionType:  # T | None, where an absent key means None
        kind = next(k for k in get_args(kind) if k is not types.NoneType)
    if get_origin(kind) is dict:
        return _build_table(get_args(kind)[1], value, path, problems)
    if get_origin(kind) is Literal:
        # A bool equals 1 but is no sign.
        if value not in get_args(kind) or isinstance(value, bool):
            allowed = ", ".join(map(repr, get_args(kind)))
            problems.append(Problem("profile.not-allowed", path, f"{value!r} is not allowed; use one of {allowed}"))
        return value
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return _build_struct(kind, value, path, problems)
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        text, _, inner = str(error).partition(" - at `$")
        where = f"{path}{inner.rstrip('`')}"
        problems.append(Problem("profile.wrong-type", where, f"{text[0].lower()}{text[1:]}"))
        return None


def _build_struct(kind: type[msgspec.Struct], value: Any, path: str, problems: list[Problem]) -> Any:
    if not isinstance(value, dict):
        problems.append(Problem("profile.not-a-table", path, f"must be a table, found {value!r}"))
        return None
    problems_before = len(problems)
    dot = f"{path}." if path else ""
    fields = msgspec.structs.fields(kind)
    names = tuple(field.encode_name for field in fields)
    absent = [f for f in fields if f.encode_name not in value]
    missing = [f.encode_name for f in absent if f.required and types.NoneType not in get_args(f.type)]
    for key in value:
        if key not in names:
            problems.append(_unknown_key(dot, key, names))
    stems = {_stem(key) for key in value if key not in names}
    problems += [
        Problem("profile.missing-key", f"{dot}{name}", "missing") for name in missing if _stem(name) not in stems
    ]
    keys = {f.encode_name: f for f in fields if f.encode_name in value}
    parts = {f.name: build(f.type, value[key], dot + key, problems) for key, f in keys.items()}
    parts |= {f.name: None for f in absent if f.required}
    return kind(**parts) if len(problems) == problems_before else None


def _build_table(kind: Any, value: Any, path: str, problems: list[Problem]) -> dict[str, Any]:
    """Build a table of named things, in the order of the file; the joints are a fixed set in chain order."""
    thing = path.removesuffix("s")
    if not isinstance(value, dict):
        problems.append(Problem("profile.not-a-table", path, f"must be a table of {path}, found {value!r}"))
        return {}
    names = tuple(value)
    if kind is JointSpec:
        for name in value:
            if name not in _JOINT_NAMES:
                hint = did_you_mean(name, _JOINT_NAMES) or f"; the joints are {', '.join(_JOINT_NAMES)}"
                problems.append(Problem("profile.unknown-joint", f"{path}.{name}", f"unknown {thing}{hint}"))
        problems += [
            Problem("profile.missing-joint", f"{path}.{name}", f"missing {thing}")
            for name in _JOINT_NAMES
            if name not in value
        ]
        names = tuple(name for name in _JOINT_NAMES if name in value)
    return {name: build(kind, value[name], f"{path}.{name}", problems) for name in names}


def _stem(key: str) -> str:
    return next((key.removesuffix(suffix) for suffix in _UNIT_SUFFIXES if key.endswith(suffix)), key)


def _unknown_key(parent: str, key: str, names: tuple[str, ...]) -> Problem:
    same = [name for name in names if _stem(name) == _stem(key)]
    if same:
        unit = "" if _stem(same[0]) != same[0] else " in SI (rad, or m for the telescope; per second)"
        return Problem("profile.wrong-unit", parent + key, f'wrong unit in the name; write "{same[0]}"{unit}')
    hint = did_you_mean(key, names) or f"; allowed: {', '.join(names)}"
    return Problem("profile.unknown-key", parent + key, f"unknown key{hint}")


# -- One problem of a profile: a code for programs, the key path, and a sentence for people.


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong with the value at a key path.

    ``code`` is stable (``profile.what``); ``sentence`` says what is wrong and what is allowed, and may be reworded.
    """

    code: str
    path: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.path}: {self.sentence}"
