"""The file with the key that authenticates datagrams."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import Final

from runtime.errors import ConfigError

MIN_KEY_BYTES: Final = 16
SERVICE_KEY: Final = Path("/etc/timberhand/key")
"""The key of the installed services; root and the group timberhand-operator may read it."""


def read_key(path: Path) -> bytes:
    """The key in a file, without white space around it; raises ConfigError."""
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise ConfigError("key.unreadable", f"{path}: the key cannot be read: {error.strerror}.") from error
    if len(key) < MIN_KEY_BYTES:
        raise ConfigError("key.short", f"{path}: a key of {len(key)} bytes is too short; use at least {MIN_KEY_BYTES}.")
    return key


def write_key(path: Path) -> Path:
    """Draw a key for one run and write it to a new file that only this user reads; its path.  Raises OSError."""
    path.unlink(missing_ok=True)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as out:
        out.write(secrets.token_hex(MIN_KEY_BYTES))
    return path


def service_key() -> bytes | None:
    """The key of the services that are installed here; None where there is none, or this user may not read it."""
    try:
        return read_key(SERVICE_KEY)
    except ConfigError:
        return None
