"""Lists of SHA-256 hashes in the format of ``sha256sum``: one line ``HASH  NAME`` for every file.

The format is kept so that ``sha256sum --check`` of any Linux reads it.  Names are relative, with ``/``, and never leave
their folder.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Final

from runtime.errors import InputRefused

_LINE: Final = re.compile(r"([0-9a-f]{64}) [ *](\S.*)")


def sha256_of(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def encode(sums: Mapping[str, str]) -> str:
    """Write the list of name -> hash, sorted by name, so that the same files give the same bytes."""
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))


def decode(text: str, where: str) -> dict[str, str]:
    """Read name -> hash; ``where`` names the list in the error.

    Raises:
        InputRefused: a line is no entry, a name stands twice or leaves the folder.
    """
    digests: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _LINE.fullmatch(line)
        name = match[2] if match else ""
        if match is None or PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or name in digests:
            raise InputRefused("sums.broken", f"{where}, line {number}, is no hash of a file; get the list again")
        digests[name] = match[1]
    return digests


def of_files(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Map name -> hash of files below a folder; raises OSError."""
    return {name: sha256_of(folder / name) for name in names}


def differing(folder: Path, sums: Mapping[str, str]) -> list[str]:
    """List the files that are missing, unreadable, or not those of the list, in the order of their names."""
    differing_names = []
    for name, digest in sorted(sums.items()):
        try:
            good = sha256_of(folder / name) == digest
        except OSError:
            good = False
        if not good:
            differing_names.append(name)
    return differing_names
