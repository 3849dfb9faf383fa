"""The checkpoint file of a mission: replaced atomically, read when a planner starts.

If the process dies, the last second is lost.  If the computer loses power, data that the file system had not written is
lost; the file is then the previous one, or it is reported as damaged.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from autonomy.manager.checkpoint import Checkpoint, copied_tally, fits_mission, mission_digest
from autonomy.missions.model import ForwardingMission, MissionError
from runtime.errors import InputRefused

PERIOD_NS: Final = 1_000_000_000
_MOVE: Final = "move the file away to start over"


def read_checkpoint(path: Path, mission: ForwardingMission, now_ns: int, unix_ns: int) -> Checkpoint | None:
    """Read the checkpoint of a mission; None without a file.

    ``now_ns`` (clock of this process) and ``unix_ns`` are the same moment; the checkpoint's times are converted to the
    clock of this process.

    Raises:
        MissionError: the file cannot be read, is damaged or belongs to another mission.
        InputRefused: the mission is finished (``checkpoint.finished``).
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise MissionError(
            "checkpoint.unreadable", f"the checkpoint cannot be read: {error.strerror}", str(path)
        ) from None
    try:
        found = msgspec.json.decode(data, type=Checkpoint)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise MissionError(
            "checkpoint.damaged", f"is damaged or not a checkpoint ({error}); {_MOVE}", str(path)
        ) from None
    if not found.rotator.is_possible:
        sentence = f"is damaged: its rotator cannot stand as it says; {_MOVE}"
        raise MissionError("checkpoint.damaged", sentence, str(path))
    if found.mission != mission_digest(mission):
        sentence = f"is the checkpoint of another mission; start the planner with that one, or {_MOVE}"
        raise MissionError("checkpoint.other-mission", sentence, str(path))
    if not fits_mission(found, mission):
        sentence = f"is damaged: it has a landing or waypoints that are not in the mission; {_MOVE}"
        raise MissionError("checkpoint.unknown-place", sentence, str(path))
    if found.finished:
        sentence = f"{path}: this mission is finished, {found.tally.loaded} logs were loaded; {_MOVE}"
        raise InputRefused("checkpoint.finished", sentence)
    later_ns = (now_ns - unix_ns) - (found.clock_ns - found.unix_ns)
    return msgspec.structs.replace(found, tally=copied_tally(found.tally, later_ns), clock_ns=0, unix_ns=0)


class CheckpointFile:
    """Writes checkpoints to one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._due_ns = 0
        self._last: Checkpoint | None = None

    def due(self, now_ns: int) -> bool:
        """Whether the next checkpoint is due."""
        return now_ns >= self._due_ns

    def write(self, progress: Checkpoint, now_ns: int, unix_ns: int) -> None:
        """Write the checkpoint if it has changed.

        Raises:
            OSError: the file cannot be written.
        """
        self._due_ns = now_ns + PERIOD_NS
        if progress == self._last:
            return
        stamped = msgspec.structs.replace(progress, clock_ns=now_ns, unix_ns=unix_ns)
        draft = self._path.with_name(self._path.name + ".part")
        draft.write_bytes(msgspec.json.encode(stamped) + b"\n")
        os.replace(draft, self._path)
        self._last = progress
