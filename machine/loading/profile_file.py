"""Reads a profile: a shipped name or a TOML file in, a checked ``Profile`` out, or ``ProfileError``.

Every problem is one line: the file, the key path, what is wrong, what is allowed.  All problems of one stage
(keys and types first, then values) are reported together, so that few rounds correct a file.
"""

from __future__ import annotations

import tomllib
import types
import zlib
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_origin

import msgspec

from machine.joints import JOINTS
from machine.loading.checks import problems_of
from machine.loading.problem import Problem
from machine.profile import JointSpec, Profile
from runtime.errors import CodedError

_FOLDER: Final = Path(__file__).parents[1]
_UNIT_SUFFIXES: Final = (
    "_rad_s2", "_rad_s", "_deg_s2", "_deg_s", "_m_s2", "_m_s", "_mm_s", "_1_s", "_degrees", "_deg", "_rad",
    "_mm", "_cm", "_ms", "_ns", "_us", "_hz", "_bar", "_mpa", "_pa", "_pct", "_percent", "_px", "_m", "_s",
)  # fmt: skip
_ABSENT: Final = (b',"keep_out":{}', b',"stability":null', b',"imu":null')
"""Sections that came later, as they are encoded where a machine has none; the last one first."""
_JOINT_NAMES: Final = tuple(j.name.lower() for j in JOINTS)


class ProfileError(CodedError, ValueError):
    """A profile cannot be used.

    The text has one line per problem.  ``problems`` holds them where the file could be read: with code
    ``profile.wrong-structure`` those of keys and types, with ``profile.wrong-values`` those of values.
    """

    def __init__(self, code: str, sentence: str, problems: Sequence[Problem] = ()) -> None:
        super().__init__(code, sentence)
        self.problems = tuple(problems)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.code, str(self), self.problems)


def shipped_profiles() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml") if "." not in path.stem))  # no envelopes


def load_profile(name_or_path: str | Path) -> Profile:
    """The checked profile of a shipped name (``"palms_471"``) or of a TOML file; raises ``ProfileError``."""
    path = _find(name_or_path)
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        sentence = f"{path}: the profile cannot be read: {error.strerror}"
        raise ProfileError("profile.unreadable", sentence) from None
    except UnicodeDecodeError as error:
        sentence = f"{path}: not UTF-8 text at byte {error.start}; a profile is a TOML file"
        raise ProfileError("profile.not-utf8", sentence) from None
    except tomllib.TOMLDecodeError as error:
        raise ProfileError("profile.broken-toml", f"{path}: broken TOML: {error}") from None
    problems: list[Problem] = []
    built = _build(Profile, raw, "", problems)
    if problems:
        raise ProfileError("profile.wrong-structure", _lines(path, problems), problems)
    problems = problems_of(built)
    if problems:
        raise ProfileError("profile.wrong-values", _lines(path, problems), problems)
    profile: Profile = built
    return profile


def _lines(path: Path, problems: Sequence[Problem]) -> str:
    return "\n".join(f"{path}: {problem}" for problem in problems)


def profile_hash(profile: Profile) -> int:
    """CRC-32 of the canonical content; datagrams carry it to prove that both ends use the same profile.

    Comments, order and layout of the file do not count; every value does.  Missing sections that came later do not
    count, so that a machine without them keeps the hash of its recordings.
    """
    content = msgspec.json.encode(profile, order="deterministic").removesuffix(b"}")
    for absent in _ABSENT:
        content = content.removesuffix(absent)
    return zlib.crc32(content + b"}")


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or "/" in text or text.endswith(".toml"):
        return Path(name_or_path)
    shipped = shipped_profiles()
    if text in shipped:
        return _FOLDER / f"{text}.toml"
    raise ProfileError(
        "profile.unknown-name",
        f'unknown profile "{text}"{_did_you_mean(text, shipped)}; shipped profiles: {", ".join(shipped)}; '
        "or give the path of a .toml file",
    )


def _did_you_mean(word: str, known: tuple[str, ...]) -> str:
    close = get_close_matches(word, known, 1)
    return f'; did you mean "{close[0]}"?' if close else ""


def _build(kind: Any, value: Any, path: str, problems: list[Problem]) -> Any:
    """``value`` converted to ``kind``; adds every mismatch to ``problems`` with its full key path."""
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
    found = len(problems)
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
    parts = {f.name: _build(f.type, value[key], dot + key, problems) for key, f in keys.items()}
    parts |= {f.name: None for f in absent if f.required}
    return kind(**parts) if len(problems) == found else None


def _build_table(kind: Any, value: Any, path: str, problems: list[Problem]) -> dict[str, Any]:
    """A table of named things, in the order of the file; the joints are a fixed set in chain order."""
    thing = path.removesuffix("s")
    if not isinstance(value, dict):
        problems.append(Problem("profile.not-a-table", path, f"must be a table of {path}, found {value!r}"))
        return {}
    names = tuple(value)
    if kind is JointSpec:
        for name in value:
            if name not in _JOINT_NAMES:
                hint = _did_you_mean(name, _JOINT_NAMES) or f"; the joints are {', '.join(_JOINT_NAMES)}"
                problems.append(Problem("profile.unknown-joint", f"{path}.{name}", f"unknown {thing}{hint}"))
        problems += [
            Problem("profile.missing-joint", f"{path}.{name}", f"missing {thing}")
            for name in _JOINT_NAMES
            if name not in value
        ]
        names = tuple(name for name in _JOINT_NAMES if name in value)
    return {name: _build(kind, value[name], f"{path}.{name}", problems) for name in names}


def _stem(key: str) -> str:
    return next((key.removesuffix(suffix) for suffix in _UNIT_SUFFIXES if key.endswith(suffix)), key)


def _unknown_key(parent: str, key: str, names: tuple[str, ...]) -> Problem:
    same = [name for name in names if _stem(name) == _stem(key)]
    if same:
        unit = "" if _stem(same[0]) != same[0] else " in SI (rad, or m for the telescope; per second)"
        return Problem("profile.wrong-unit", parent + key, f'wrong unit in the name; write "{same[0]}"{unit}')
    hint = _did_you_mean(key, names) or f"; allowed: {', '.join(names)}"
    return Problem("profile.unknown-key", parent + key, f"unknown key{hint}")
