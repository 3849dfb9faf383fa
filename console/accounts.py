"""The persons who may use the page from elsewhere: their roles, and a file with the hashes of their passwords.

A line of the file is ``NAME ROLE HASH``, written by ``timberhand operator password``; the hash is Argon2id in its usual
text form (RFC 9106).  An unknown name takes as long to refuse as a wrong password.
"""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, Final

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError, VerifyMismatchError

from runtime.errors import ConfigError

MAX_PASSWORD_CHARS: Final = 256
"""Longer ones are not hashed: hashing them would only cost time."""
MIN_PASSWORD_CHARS: Final = 10
NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,31}")


class Role(IntEnum):
    """What a person may do; a greater role includes the smaller ones."""

    VIEWER = 1
    """Look, and press STOP."""
    OPERATOR = 2
    """Arm the machine, run missions, plan them."""
    TECHNICIAN = 3
    """Step joints, calibrate, fill in the acceptance protocol."""


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody who uses the page."""

    name: str
    role: Role


class Accounts:
    """The accounts of one file."""

    def __init__(self, hashes: dict[str, tuple[Role, str]]) -> None:
        self._hashes = hashes

    def check(self, name: str, password: str) -> Person | None:
        """Find the person with this name and password; takes some 50 ms and 64 MiB, so ask for one at a time."""
        role, known = self._hashes.get(name, (Role.VIEWER, _nobody()))
        if len(password) > MAX_PASSWORD_CHARS:
            return None
        try:
            PasswordHasher().verify(known, password)
        except (VerifyMismatchError, VerificationError):
            return None
        return Person(name, role) if name in self._hashes else None

    @property
    def names(self) -> list[str]:
        """The names in the file."""
        return list(self._hashes)


def read_accounts(path: Path) -> Accounts:
    """Read the accounts of a file.

    Raises:
        ConfigError: it cannot be read, others may read it, or a line is wrong.
    """
    try:
        text = path.read_text()
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        sentence = f"{path} cannot be read ({reason}); make it with `timberhand operator password`"
        raise ConfigError("accounts.unreadable", sentence) from None
    if mode & (stat.S_IROTH | stat.S_IWOTH | stat.S_IWGRP):
        sentence = f"{path} can be read or changed by others; run `chmod 600 {path}`"
        raise ConfigError("accounts.open-file", sentence)
    accounts: dict[str, tuple[Role, str]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        name, role, known = (*line.split(), "", "", "")[:3]
        if not (NAME.fullmatch(name) and role.upper() in Role.__members__ and _is_hash(known)):
            roles = ", ".join(r.name.lower() for r in Role)
            sentence = (
                f"{path}, line {number} is not NAME ROLE HASH with a role of {roles}; "
                "write it anew with `timberhand operator password`"
            )
            raise ConfigError("accounts.line", sentence)
        accounts[name] = Role[role.upper()], known
    if not accounts:
        sentence = f"{path} holds no account; add one with `timberhand operator password`"
        raise ConfigError("accounts.empty", sentence)
    return Accounts(accounts)


def account_line(name: str, role: Role, password: str) -> str:
    """Write the line of an account.

    Raises:
        ConfigError: the name or the password cannot be used.
    """
    if not NAME.fullmatch(name):
        sentence = f"{name!r} cannot be a name; use up to 32 letters, digits, dots, dashes and underscores"
        raise ConfigError("accounts.name", sentence)
    if not MIN_PASSWORD_CHARS <= len(password) <= MAX_PASSWORD_CHARS:
        sentence = f"the password has {len(password)} characters; use {MIN_PASSWORD_CHARS} to {MAX_PASSWORD_CHARS}"
        raise ConfigError("accounts.password", sentence)
    return f"{name} {role.name.lower()} {PasswordHasher().hash(password)}"


def with_account(text: str, line: str) -> str:
    """Return the text of a file with this line in it, in place of an earlier one of the same name."""
    name = line.split()[0]
    other_lines = [old for old in text.splitlines() if old.split()[:1] != [name]]
    return "\n".join([*other_lines, line]) + "\n"


def _is_hash(text: str) -> bool:
    try:
        PasswordHasher().check_needs_rehash(text)
    except InvalidHashError:
        return False
    return text.startswith("$argon2id$")


@cache
def _nobody() -> Any:
    return PasswordHasher().hash("the hash that an unknown name is compared with")
