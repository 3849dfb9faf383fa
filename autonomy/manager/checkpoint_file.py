"""The file that keeps a mission's progress: written at once or not at all, and read when the planner starts.

A process that dies loses what changed in its last second.  A computer that loses its power may lose what its file
system had not written yet; then the file is the one before, or is told to be damaged.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from autonomy.manager.checkpoint import Progress, copied, digest, fits
from autonomy.missions.model import ForwardingMission, MissionError

EVERY_NS: Final = 1_000_000_000
_MOVE: Final = "move the file away to begin anew"


class MissionFinished(Exception):
    """There is nothing left to do of a mission; the text is one sentence."""


def read(path: Path, mission: ForwardingMission, now_ns: int, unix_ns: int) -> Progress | None:
    """The progress of a mission by the clock of this process, which says ``now_ns`` when it is ``unix_ns``; None where
    there is no file.

    Raises:
        MissionError: it cannot be read, is damaged or of another mission.
        MissionFinished: the mission was done to its end.
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
    """Writes to one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._due_ns = 0
        self._last: Progress | None = None

    def due(self, now_ns: int) -> bool:
        """Whether it is time to keep the progress again."""
        return now_ns >= self._due_ns

    def keep(self, progress: Progress, now_ns: int, unix_ns: int) -> None:
        """Write the progress, if it has changed; raises OSError."""
        self._due_ns = now_ns + EVERY_NS
        if progress == self._last:
            return
        stamped = msgspec.structs.replace(progress, clock_ns=now_ns, unix_ns=unix_ns)
        draft = self._path.with_name(self._path.name + ".part")
        draft.write_bytes(msgspec.json.encode(stamped) + b"\n")
        os.replace(draft, self._path)
        self._last = progress
