"""The checkpoint file of a mission: replaced atomically, read when a planner starts.

If the process dies, the last second is lost.  If the computer loses power, data that the file system had not written is
lost; the file is then the previous one, or it is reported as damaged.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from autonomy.manager.checkpoint import Progress, copied, digest, fits
from autonomy.missions.model import ForwardingMission, MissionError

EVERY_NS: Final = 1_000_000_000
_MOVE: Final = "move the file away to start over"


class MissionFinished(Exception):
    """The mission of a checkpoint is finished; nothing is left to do."""


def read(path: Path, mission: ForwardingMission, now_ns: int, unix_ns: int) -> Progress | None:
    """Read the checkpoint of a mission; None without a file.

    ``now_ns`` (clock of this process) and ``unix_ns`` are the same moment; the checkpoint's times are converted to the
    clock of this process.

    Raises:
        MissionError: the file cannot be read, is damaged or belongs to another mission.
        MissionFinished: the mission is finished.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise MissionError(f"{path}: the mission's progress cannot be read: {error.strerror}") from None
    try:
        found = msgspec.json.decode(data, type=Progress)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise MissionError(f"{path}: is damaged or no mission's progress ({error}); {_MOVE}") from None
    if found.mission != digest(mission):
        raise MissionError(f"{path}: is the progress of another mission; start the planner with that one, or {_MOVE}")
    if not fits(found, mission):
        raise MissionError(f"{path}: is damaged, it names a landing or waypoints that the mission has not; {_MOVE}")
    if found.finished:
        raise MissionFinished(f"{path}: this mission is finished, {found.tally.loaded} logs were loaded; {_MOVE}")
    later_ns = (now_ns - unix_ns) - (found.clock_ns - found.unix_ns)
    return msgspec.structs.replace(found, tally=copied(found.tally, later_ns), clock_ns=0, unix_ns=0)


class Logbook:
    """Writes checkpoints to one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._due_ns = 0
        self._last: Progress | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the next checkpoint is due."""
        return now_ns >= self._due_ns

    def keep(self, progress: Progress, now_ns: int, unix_ns: int) -> None:
        """Write the checkpoint if it has changed.

        Raises:
            OSError: the file cannot be written.
        """
        self._due_ns = now_ns + EVERY_NS
        if progress == self._last:
            return
        stamped = msgspec.structs.replace(progress, clock_ns=now_ns, unix_ns=unix_ns)
        draft = self._path.with_name(self._path.name + ".part")
        draft.write_bytes(msgspec.json.encode(stamped) + b"\n")
        os.replace(draft, self._path)
        self._last = progress
