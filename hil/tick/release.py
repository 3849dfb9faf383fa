"""Another state of the program to compare with: a git tag or commit, or a wheel; kept below ``build/against``."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from host.exit_codes import CommandFailed, ExitCode
from runtime.compiled import source_root

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Release:
    """``folder`` holds the packages; ``name`` is what the user asked for, with the commit."""

    name: str
    folder: Path


def newest_tag() -> str:
    """Return the newest tag of this checkout; empty without one."""
    return _git("tag", "--sort=-creatordate").split("\n", 1)[0].strip()


def release(wanted: str, progress: Progress) -> Release:
    """Provide the packages of a commit, with its own compiled tick, or of a wheel as it is.

    Raises:
        CommandFailed: no such commit or wheel, or it does not compile.
    """
    folder = source_root() / "build" / "against"
    if wanted.endswith(".whl"):
        return _from_wheel(Path(wanted), folder)
    commit = _git("rev-parse", "--verify", "--quiet", f"{wanted}^{{commit}}").strip()
    if not commit:
        raise _failed(f"there is no commit or wheel {wanted!r}: name a tag, a commit or a .whl file")
    made = folder / commit[:16]
    if not made.is_dir():
        progress(f"unpacking {wanted}")
        with _new(made) as new, tempfile.TemporaryFile() as packed:
            subprocess.run(["git", "archive", commit], cwd=source_root(), stdout=packed, check=True)
            packed.seek(0)
            with tarfile.open(fileobj=packed) as archive:
                archive.extractall(new, filter="data")
    progress(f"compiling the tick of {wanted}, unless it is ready")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "timberhand", "compile"],
        cwd=made,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(made)},
    )
    if done.returncode:
        raise _failed(f"the tick of {wanted} does not compile: {done.stderr[-500:].strip()}")
    return Release(f"{wanted} ({commit[:12]})", made)


def _from_wheel(wheel: Path, folder: Path) -> Release:
    if not wheel.is_file():
        raise _failed(f"there is no wheel {str(wheel)!r}")
    made = folder / f"{wheel.stem}-{wheel.stat().st_mtime_ns:x}"
    if not made.is_dir():
        with _new(made) as new, zipfile.ZipFile(wheel) as packed:
            packed.extractall(new)  # zipfile keeps every name inside, and makes no links  # nosec B202
    return Release(wheel.name, made)


@contextlib.contextmanager
def _new(target: Path) -> Iterator[Path]:
    """Make a folder that takes its place only when it is complete."""
    work = target.with_name(f".{target.name}")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    yield work
    work.rename(target)


def _git(*arguments: str) -> str:
    """Return what git prints; nothing when it refuses or is missing."""
    try:
        return subprocess.run(["git", *arguments], cwd=source_root(), capture_output=True, text=True).stdout
    except OSError:
        return ""


def _failed(sentence: str) -> CommandFailed:
    return CommandFailed("tick.against", sentence, ExitCode.CONFIGURATION)
