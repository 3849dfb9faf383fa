"""A folder of missions, as the console saves them and the planner takes them: plain GeoJSON files with plain names."""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from autonomy.missions.model import MissionError
from autonomy.missions.source import MAX_JSON_BYTES
from can_dbc.messages.mission import FILE_NAME

MAX_FILES: Final = 500
"""More are not listed."""
FILE_MODE: Final = 0o640
"""The planner, which reads it, may be another user in the folder's group, whatever the umask of the console."""


@dataclass(frozen=True, slots=True)
class MissionFolder:
    """Missions in ``path``.  Names are checked, links are not followed, and nothing outside is touched."""

    path: Path

    def names(self) -> list[str]:
        """List the missions, newest first."""
        try:
            entries = [
                e for e in os.scandir(self.path) if FILE_NAME.fullmatch(e.name) and e.is_file(follow_symlinks=False)
            ]
            entries.sort(key=lambda e: e.stat(follow_symlinks=False).st_mtime, reverse=True)
        except OSError:
            return []
        return [entry.name for entry in entries[:MAX_FILES]]

    def read(self, name: str) -> bytes:
        """Read the bytes of a mission.

        Raises:
            MissionError: a bad name, no such file, or too large.
        """
        path = self._file(name)
        try:
            with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
                data = file.read(MAX_JSON_BYTES + 1)
        except OSError as error:
            sentence = f"cannot be read: {error.strerror}; choose one of the folder's missions"
            raise MissionError("missions.unreadable", sentence, name) from None
        if len(data) > MAX_JSON_BYTES:
            sentence = f"is larger than {MAX_JSON_BYTES >> 20} MB; a mission has some kB"
            raise MissionError("mission.too-large", sentence, name)
        return data

    def write(self, name: str, data: bytes, replace: bool = False) -> None:
        """Save a mission, whole or not at all.

        Raises:
            MissionError: a bad name, a file of this name although ``replace`` is False, or the disk refuses.
        """
        path = self._file(name)
        draft: Path | None = None
        try:
            if not self.path.is_dir():
                self.path.mkdir(parents=True)
            with tempfile.NamedTemporaryFile(prefix=".mission.", dir=self.path, delete=False) as file:
                draft = Path(file.name)
                file.write(data)
                os.fchmod(file.fileno(), FILE_MODE)
                file.flush()
                os.fsync(file.fileno())  # a rename may reach the disk before the bytes do
            if replace:
                draft.replace(path)
            else:
                os.link(draft, path)
        except FileExistsError:
            if not self.path.is_dir():
                raise MissionError("missions.not-written", f"{self.path} is no folder", name) from None
            sentence = "exists already; choose another name, or replace it"
            raise MissionError("missions.exists", sentence, name) from None
        except OSError as error:
            raise MissionError("missions.not-written", f"cannot be written: {error.strerror}", name) from None
        finally:
            if draft is not None:
                with contextlib.suppress(OSError):
                    draft.unlink(missing_ok=True)

    def _file(self, name: str) -> Path:
        if not FILE_NAME.fullmatch(name):
            raise MissionError(
                "missions.name",
                f'"{name[:60]}" is no name of a mission; use letters, digits, blanks, - and _, and end it in .geojson',
            )
        return self.path / name
