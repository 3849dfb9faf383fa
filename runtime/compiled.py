"""Loads the tick that was compiled ahead of time, where one is ready for exactly these sources.

A build is a folder of extension modules with ``manifest.json``; `host.compiled.build` makes it below `builds_folder`.
`activate`, called before the tick is imported, installs a finder that serves the extension modules in place of the
``.py`` files.  A build is used as a whole or not at all: one source file that differs, another Python or another
platform, and the interpreter runs.  ``TIMBERHAND_COMPILED=0`` switches it off.  In an installed wheel with compiled
modules the extension modules lie beside their sources, and the switch works as well.  Standard library only.
"""

from __future__ import annotations

import hashlib
import importlib.abc
import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, Final

SWITCH: Final = "TIMBERHAND_COMPILED"
"""Environment variable; 0 keeps the tick on the interpreter."""
PACKAGES: Final = ("runtime", "can_dbc", "machine", "controller")
"""Packages of the compiled modules and of all that they import."""
MANIFEST: Final = "manifest.json"
TICK: Final = "controller.step"
"""A module that every build holds."""


@dataclass(frozen=True, slots=True)
class Build:
    """A compiled tick: its key, and the file of each extension module."""

    key: str
    files: dict[str, Path]


@dataclass(frozen=True, slots=True)
class Running:
    """What runs the tick here: ``kind`` is "compiled" or "interpreter", ``reason`` says why no build runs."""

    kind: str
    key: str = ""
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.kind} {self.key}".strip()


def source_root() -> Path:
    """Return the folder that holds the packages."""
    return Path(__file__).resolve().parents[1]


def builds_folder(root: Path | None = None) -> Path:
    """Tell where builds lie: beside the sources, so that whoever may change the one may change the other."""
    root = root or source_root()
    if (root / "pyproject.toml").is_file():
        return root / "build" / "compiled"
    return root / "timberhand_compiled"


def platform_tag() -> str:
    """Return the Python and the platform that a build is for."""
    return f"{'.'.join(map(str, sys.version_info[:3]))}{EXTENSION_SUFFIXES[0]}"


def hash_of(path: Path) -> str:
    """Compute the SHA-256 of a file; empty when it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def key_of(manifest: dict[str, Any]) -> str:
    """Compute the name of the build with this manifest: platform, compiler and sources."""
    identity = [manifest["platform"], manifest["mypy"], manifest["modules"], sorted(manifest["sources"].items())]
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:16]


def mismatch(manifest: dict[str, Any], root: Path) -> str:
    """Tell why a build with this manifest cannot be used with the sources below ``root``; empty when it can."""
    if manifest["platform"] != platform_tag():
        return f"it was made for {manifest['platform']}, this is {platform_tag()}"
    changed = [path for path, made in manifest["sources"].items() if hash_of(root / path) != made]
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        return f"{changed[0]}{more} changed since"
    return ""


def find_build(root: Path | None = None, folder: Path | None = None) -> tuple[Build | None, str]:
    """Find the build for the sources below ``root``, or None and the reason, which names the newest build."""
    root = root or source_root()
    folder = folder or builds_folder(root)
    reason = "no build"
    for path in sorted(folder.glob(f"*/{MANIFEST}"), key=_age_key):
        try:
            manifest = json.loads(path.read_text())
            problem = mismatch(manifest, root)
            files = {name: path.parent / file for name, file in manifest["files"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            problem, files = f"its manifest cannot be read ({error})", {}
        if not problem and (missing := [file.name for file in files.values() if not file.is_file()]):
            problem = f"{missing[0]} is missing"
        if not problem:
            return Build(path.parent.name, files), ""
        reason = f"build {path.parent.name}: {problem}"
    return None, reason


def _age_key(manifest: Path) -> tuple[int, str]:
    """Sort the oldest manifest first."""
    try:
        return manifest.stat().st_mtime_ns, str(manifest)
    except OSError:
        return 0, str(manifest)


class _Finder(importlib.abc.MetaPathFinder):
    """Serves modules by full name from the given files, before the path is searched.

    A name whose file is missing is no module: the generated codecs exist in compiled form only.
    """

    def __init__(self, files: dict[str, Path]) -> None:
        self._files = files

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        file = self._files.get(fullname)
        if file is None:
            return None
        if not file.is_file():
            raise ModuleNotFoundError(f"{fullname} exists in compiled form only", name=fullname)
        return importlib.util.spec_from_file_location(fullname, file)


_running = Running("interpreter", reason="not activated")


def activate(root: Path | None = None, folder: Path | None = None) -> Running:
    """Serve the tick from its build from now on, if one fits; call it before the tick is imported.

    Never raises, because the interpreter is always there.
    """
    global _running
    root = root or source_root()
    _running = _activated(root, folder)
    return _running


def stay_interpreted(root: Path | None = None) -> None:
    """Serve sources from now on, also in a wheel with extension modules beside them; call it before other imports."""
    root = root or source_root()
    if beside := _beside(root):
        sources = {name: root.joinpath(*name.split(".")).with_suffix(".py") for name in beside}
        sys.meta_path.insert(0, _Finder(sources))


def _activated(root: Path, folder: Path | None) -> Running:
    if os.environ.get(SWITCH) == "0":
        stay_interpreted(root)
        return Running("interpreter", reason=f"{SWITCH}=0")
    beside = _beside(root)
    if beside:
        return Running("compiled", "installed")
    build, reason = find_build(root, folder)
    if build is None:
        return Running("interpreter", reason=reason)
    early = sorted(build.files.keys() & sys.modules.keys())
    if early:
        return Running("interpreter", reason=f"{early[0]} was imported before")
    sys.meta_path.insert(0, _Finder(build.files))
    return Running("compiled", build.key)


def running() -> Running:
    """Tell what runs the tick in this process."""
    if _running.kind == "interpreter" and _running.reason == "not activated" and _beside(source_root()):
        return Running("compiled", "installed")
    return _running


def _beside(root: Path) -> list[str]:
    """Find the modules whose extension module lies beside the source, as in a compiled wheel."""
    suffix = EXTENSION_SUFFIXES[0]
    if not root.joinpath(*TICK.split(".")).with_suffix(suffix).is_file():
        return []
    return [
        ".".join(path.relative_to(root).parts).removesuffix(suffix)
        for package in PACKAGES
        for path in (root / package).rglob(f"*{suffix}")
    ]
