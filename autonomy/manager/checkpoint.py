"""Checkpoint of a mission, so that a restarted planner resumes where the previous one ended.

A `Checkpoint` is plain data, independent of the machine: positions in WGS84, lengths in metres, times in ns of the
clock of the process that made it.  The manager creates it and can start from it;
`CheckpointFile` stores it.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec

from autonomy.crane_job.rotator_estimate import RotatorEstimate
from autonomy.manager.tally import LoadedLog, Tally
from autonomy.missions.model import ForwardingMission, KnownLog, MissionError, Point
from runtime.errors import InputRefused

SCHEMA: Final = 1
Count = Annotated[int, msgspec.Meta(ge=0)]


class RouteRemainder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the route was left: a point shortly before and the point itself (``at``), extra places to drive by from
    there (``by``), and the number of waypoints of all laps still to come; ``ended``: the end was reached.
    """

    to_come: Count
    at: tuple[Point, Point] | None = None
    by: tuple[Point, ...] = ()
    ended: bool = False


class MissedLog(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log with failed grasps, by its number."""

    number: Count
    log: KnownLog
    misses: Count


class LogKnowledge(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Knowledge of the logs on the ground: listed logs that are gone (numbers from 1), logs with failed grasps, and the
    next unused number.
    """

    gone: tuple[Count, ...] = ()
    missed: tuple[MissedLog, ...] = ()
    free: Count = 1


class Checkpoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Checkpoint of the mission with the digest ``mission``.

    ``landing``, ``served`` and ``rounds`` are as in `autonomy.manager.sorting`; ``left`` is None before the route was
    begun; ``rotator`` is the state of one without an encoder.  ``clock_ns`` and ``unix_ns`` are the same moment by the
    process's clock and as Unix time, so that times survive a restart of the computer.
    """

    mission: str
    tally: Tally
    known: LogKnowledge = LogKnowledge()
    left: RouteRemainder | None = None
    landing: Count | None = None
    served: tuple[Count, ...] = ()
    rounds: Count = 0
    driven_m: float = 0.0
    rotator: RotatorEstimate = RotatorEstimate()
    finished: bool = False
    clock_ns: int = 0
    unix_ns: int = 0
    schema: Literal[1] = SCHEMA


def mission_digest(mission: ForwardingMission) -> str:
    """Compute the digest of a mission's content, independent of its file format."""
    return hashlib.sha256(msgspec.json.encode(mission)).hexdigest()


def copied_tally(tally: Tally, later_ns: int = 0) -> Tally:
    """Copy a tally deeply, with all times shifted."""

    def moved(logs: tuple[LoadedLog, ...] | list[LoadedLog]) -> list[LoadedLog]:
        return [msgspec.structs.replace(log, at_ns=log.at_ns + later_ns) for log in logs]

    loads = [
        msgspec.structs.replace(load, logs=tuple(moved(load.logs)), at_ns=load.at_ns + later_ns) for load in tally.loads
    ]
    remarks = [msgspec.structs.replace(remark, at_ns=remark.at_ns + later_ns) for remark in tally.remarks]
    return replace(tally, given_up=dict(tally.given_up), board=moved(tally.board), loads=loads, remarks=remarks)


def fits_mission(progress: Checkpoint, mission: ForwardingMission) -> bool:
    """Tell whether landings and waypoints of a checkpoint exist in this mission."""
    landings = {*progress.served, *(load.landing for load in progress.tally.loads)}
    landings |= set() if progress.landing is None else {progress.landing}
    to_come = 0 if progress.left is None else progress.left.to_come
    places = mission.options.laps * len(mission.waypoints)
    # Without landings every load counts for landing 0.
    return all(0 <= at < max(1, len(mission.landings)) for at in landings) and to_come <= places


# -- The checkpoint file of a mission: replaced atomically, read when a planner starts.
#
# If the process dies, the last second is lost.  If the computer loses power, data that the file system had not
# written is lost; the file is then the previous one, or it is reported as damaged.

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
        checkpoint = msgspec.json.decode(data, type=Checkpoint)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise MissionError(
            "checkpoint.damaged", f"is damaged or not a checkpoint ({error}); {_MOVE}", str(path)
        ) from None
    if not checkpoint.rotator.is_possible:
        sentence = f"is damaged: its rotator cannot stand as it says; {_MOVE}"
        raise MissionError("checkpoint.damaged", sentence, str(path))
    if checkpoint.mission != mission_digest(mission):
        sentence = f"is the checkpoint of another mission; start the planner with that one, or {_MOVE}"
        raise MissionError("checkpoint.other-mission", sentence, str(path))
    if not fits_mission(checkpoint, mission):
        sentence = f"is damaged: it has a landing or waypoints that are not in the mission; {_MOVE}"
        raise MissionError("checkpoint.unknown-place", sentence, str(path))
    if checkpoint.finished:
        sentence = f"{path}: this mission is finished, {checkpoint.tally.loaded} logs were loaded; {_MOVE}"
        raise InputRefused("checkpoint.finished", sentence)
    later_ns = (now_ns - unix_ns) - (checkpoint.clock_ns - checkpoint.unix_ns)
    return msgspec.structs.replace(checkpoint, tally=copied_tally(checkpoint.tally, later_ns), clock_ns=0, unix_ns=0)


class CheckpointFile:
    """Writes checkpoints to one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._due_ns = 0
        self._last: Checkpoint | None = None

    def due(self, now_ns: int) -> bool:
        """Tell whether the next checkpoint is due."""
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
