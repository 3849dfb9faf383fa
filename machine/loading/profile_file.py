"""Reads a profile: a shipped name or a TOML file in, a checked ``Profile`` out, or ``ProfileError``.

Every problem is one line: the file, the key path, what is wrong, what is allowed.  All problems of one stage
(keys and types first, then values) are reported together, so that few rounds correct a file.
"""

from __future__ import annotations

import shutil
import tomllib
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from machine.loading.checks import problems_of
from machine.loading.structure import Problem, build, did_you_mean
from machine.profile import Profile
from runtime.errors import TimberhandError

SHIPPED_FOLDER: Final = Path(__file__).resolve().parents[1]
"""Profiles and envelopes that come with the package."""
_ABSENT: Final = (b',"keep_out":{}', b',"stability":null', b',"imu":null')
"""Sections that came later, as they are encoded where a machine has none; the last one first."""
_DEFAULT: Final = b',"operator_link_ms":1000'
"""A value that came later, as it is encoded where a machine has the default."""


class ProfileError(TimberhandError, ValueError):
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
    """List the names of the profiles that come with the package."""
    return tuple(sorted(path.stem for path in SHIPPED_FOLDER.glob("*.toml") if "." not in path.stem))  # no envelopes


def load_profile(name_or_path: str | Path) -> Profile:
    """Load and check the profile of a shipped name (``"palms_471"``) or of a TOML file; raises ``ProfileError``."""
    path = profile_file(name_or_path)
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
    except RecursionError:
        raise ProfileError("profile.broken-toml", f"{path}: brackets nested too deeply; a profile has three") from None
    except ValueError as error:  # Python converts no number of more than 4300 digits
        raise ProfileError("profile.broken-toml", f"{path}: a number that cannot be read: {error}") from None
    problems: list[Problem] = []
    built = build(Profile, raw, "", problems)
    if problems:
        raise ProfileError("profile.wrong-structure", _lines(path, problems), problems)
    try:
        problems = problems_of(built)
    except OverflowError as error:  # an integer of hundreds of digits
        raise ProfileError("profile.out-of-range", f"{path}: a number is out of every range: {error}") from None
    if problems:
        raise ProfileError("profile.wrong-values", _lines(path, problems), problems)
    profile: Profile = built
    return profile


def _lines(path: Path, problems: Sequence[Problem]) -> str:
    return "\n".join(f"{path}: {problem}" for problem in problems)


def profile_hash(profile: Profile) -> int:
    """Compute the CRC-32 of the canonical content; datagrams carry it to prove that both ends use the same profile.

    Comments, order and layout of the file do not count; every value does.  Missing sections that came later do not
    count, nor does a later value's default, so that a machine without them keeps the hash of its recordings.
    """
    content = msgspec.json.encode(profile, order="deterministic").removesuffix(b"}")
    for absent in _ABSENT:
        content = content.removesuffix(absent)
    return zlib.crc32(content.replace(_DEFAULT, b"") + b"}")


def profile_check(name_or_path: str | Path) -> int:
    """Compute the CRC-32 of a profile's file, lower 24 bits, by which the guard knows it; OSError, ``ProfileError``.

    The guard does not read a profile as others do, so it knows the bytes alone: comments count.
    """
    return zlib.crc32(profile_file(name_or_path).read_bytes()) & 0xFFFFFF


def profile_file(name_or_path: str | Path) -> Path:
    """Find the file of a shipped name or of a path; raises ``ProfileError`` for an unknown name."""
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or "/" in text or text.endswith(".toml"):
        return Path(name_or_path)
    shipped = shipped_profiles()
    if text in shipped:
        return SHIPPED_FOLDER / f"{text}.toml"
    raise ProfileError(
        "profile.unknown-name",
        f'unknown profile "{text}"{did_you_mean(text, shipped)}; shipped profiles: {", ".join(shipped)}; '
        "or give the path of a .toml file",
    )


# -- Files that belong to a machine and lie beside its profile, by name: ``NAME.envelope.toml``, the guard's limits.


def carry_envelope(profile: Path, folder: Path) -> None:
    """Copy the envelope beside a profile into ``folder``, where a changed copy of that profile is written.

    The guard looks beside the profile first, then among the shipped envelopes, so a shipped one is not copied.
    """
    if profile.parent.resolve() in (SHIPPED_FOLDER, folder.resolve()):
        return
    envelope = profile.with_name(f"{load_profile(profile).name}.envelope.toml")
    if envelope.is_file():
        shutil.copy(envelope, folder)
