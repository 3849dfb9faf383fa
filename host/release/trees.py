"""The trees of the releases on disk, and the three links that name them; every change survives a power cut.

::

    /opt/timberhand/releases/NAME/   a release: a virtual environment; whole once its release.json is there
    /opt/timberhand/current          -> releases/NAME, the release in use; changed by one rename
    /opt/timberhand/previous         -> releases/NAME, the one before it, for the way back
    /opt/timberhand/trial            -> releases/NAME, where to return to while the one in use is on trial
    /opt/timberhand/incoming/        an unpacked bundle

A rename is atomic, and it is on disk once its folder is flushed (fsync(2) of the directory, as rename(2) requires).
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MARKER: Final = "release.json"
"""Written last: a tree without it was not finished."""
RELEASES: Final = "releases"
CURRENT, PREVIOUS, TRIAL = "current", "previous", "trial"


@dataclass(frozen=True, slots=True)
class State:
    """The names of the releases that the links name; None where there is no such link."""

    current: str | None
    previous: str | None
    trial: str | None


class Trees:
    """The releases below ``place``; methods that write raise OSError."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.releases = place / RELEASES
        self.incoming = place / "incoming"

    def tree(self, name: str) -> Path:
        """Return the folder of a release."""
        return self.releases / name

    def state(self) -> State:
        """Return what the links name now."""
        return State(self._named(CURRENT), self._named(PREVIOUS), self._named(TRIAL))

    def whole(self) -> list[str]:
        """List the releases that were finished, by name."""
        return sorted(path.parent.name for path in self.releases.glob(f"*/{MARKER}"))

    def seal(self, name: str, marker: bytes) -> None:
        """Mark a tree as whole, after everything in it is on disk."""
        os.sync()
        write_durably(self.tree(name) / MARKER, marker)
        flush_folder(self.releases)

    def point(self, link: str, name: str) -> None:
        """Let a link name a release, at once and for good."""
        point(self.place / link, f"{RELEASES}/{name}")

    def accept(self) -> None:
        """End the trial: where to return to becomes the previous release."""
        os.replace(self.place / TRIAL, self.place / PREVIOUS)
        flush_folder(self.place)

    def end_trial(self) -> None:
        """End the trial of a release that is not in use."""
        (self.place / TRIAL).unlink(missing_ok=True)
        flush_folder(self.place)

    def clear(self) -> None:
        """Remove what an interrupted update left: trees without a marker, the unpacked bundle."""
        state = self.state()
        for path in self.releases.iterdir() if self.releases.is_dir() else ():
            if not (path / MARKER).is_file() and path.name not in (state.current, state.previous, state.trial):
                shutil.rmtree(path)
        if self.incoming.exists():
            shutil.rmtree(self.incoming)

    def remove(self, name: str) -> None:
        """Remove a release: first its marker, so that an interrupted removal leaves no half tree that looks whole."""
        with contextlib.suppress(FileNotFoundError):
            (self.tree(name) / MARKER).unlink()
            flush_folder(self.tree(name))
        shutil.rmtree(self.tree(name), ignore_errors=True)

    def prune(self) -> None:
        """Remove every release that no link names, and the unpacked bundle."""
        state = self.state()
        for name in self.whole():
            if name not in (state.current, state.previous, state.trial):
                self.remove(name)
        self.clear()

    def _named(self, link: str) -> str | None:
        try:
            return Path(os.readlink(self.place / link)).name
        except OSError:
            return None


def marker_of(tree: Path) -> dict[str, str]:
    """Read what a release says of itself; empty where it does not."""
    try:
        marker = json.loads((tree / MARKER).read_text())
    except (OSError, ValueError):
        return {}
    return marker if isinstance(marker, dict) else {}


def write_durably(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, and flush it."""
    fresh = path.with_name(f"{path.name}.new")
    with fresh.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)
    flush_folder(path.parent)


def point(link: Path, target: str) -> None:
    """Let a link name ``target``, at once and for good; raises OSError."""
    fresh = link.with_name(f"{link.name}.new")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    os.replace(fresh, link)
    flush_folder(link.parent)


def flush_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
