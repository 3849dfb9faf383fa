"""Which individual machine a plant is: the text that a ``--truth`` option takes.

``nominal``, ``sampled`` or ``wide_valves`` of a shipped machine; a TOML file, which is nominal as it stands; or
``sampled:FILE`` and ``wide_valves:FILE``, individuals drawn around a file.  A machine with files of its own has its
truth beside its profile, as ``NAME.truth.toml``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

DRAWN: Final = ("sampled", "wide_valves")
"""Truths that are another individual for every seed."""
NAMES: Final = ("nominal", *DRAWN)


def split(text: str) -> tuple[str, Path | None]:
    """Split a choice into its kind (one of `NAMES`) and its file, None for a shipped one."""
    kind, colon, path = text.partition(":")
    if kind not in NAMES:
        return "nominal", Path(text)
    return kind, Path(path) if colon else None


def beside(profile: str, machine: str, text: str) -> str:
    """Complete a choice that names no file with the file beside the profile ``profile`` if there is one.

    ``machine`` is the profile's name.  A shipped name as ``profile``, and a choice with a file, are left as they are.
    """
    kind, path = split(text)
    own = Path(profile).with_name(f"{machine}.truth.toml")
    has_folder = profile.endswith(".toml") or "/" in profile
    return f"{kind}:{own}" if path is None and has_folder and own.is_file() else text


def another_for_every_seed(text: str) -> str:
    """Return the choice itself, or the sampled one instead of a nominal one that was not given as a plain file."""
    kind, path = split(text)
    if kind != "nominal" or (path is not None and not text.startswith("nominal:")):
        return text
    return "sampled" if path is None else f"sampled:{path}"
