"""How far a mission has come, so that a planner that is started again goes on where the one before it ended.

A `Progress` is plain data, the same on every machine: places are WGS84, lengths metres, times ns by the clock of the
process that took it down.  The manager gives it and can begin with it; `autonomy.manager.checkpoint_file` keeps it in a file.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Annotated, Final, Literal

import msgspec

from autonomy.crane_job.rotator_estimate import Rotator
from autonomy.manager.tally import Taken, Tally
from autonomy.missions.model import ForwardingMission, KnownLog, Point

SCHEMA: Final = 1
Count = Annotated[int, msgspec.Meta(ge=0)]


class Left(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the route was left: a place a bit before and the place itself (``at``), places to drive by from there, and
    how many of the waypoints of all laps are still to come; ``ended``: none, the end of the route was reached.
    """

    to_come: Count
    at: tuple[Point, Point] | None = None
    by: tuple[Point, ...] = ()
    ended: bool = False


class Missed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that grasps came back from empty, by its number."""

    number: Count
    log: KnownLog
    misses: Count


class Known(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of the logs that lie about: which of the mission's no longer lie where it lists them (``gone``, by
    their numbers, which begin with 1), which were missed, and the next number that is free.
    """

    gone: tuple[Count, ...] = ()
    missed: tuple[Missed, ...] = ()
    free: Count = 1


class Progress(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of the mission whose digest is ``mission``.  The load on board goes to ``landing``, and ``served`` and ``rounds``
    are as in `autonomy.manager.sorting`; ``left`` is None before the route was begun; ``rotator`` is what was found out
    about one without an encoder.  ``clock_ns`` and ``unix_ns`` are the same moment, by the process's clock and as Unix
    time: with them times outlast the computer's start.
    """

    mission: str
    tally: Tally
    known: Known = Known()
    left: Left | None = None
    landing: Count | None = None
    served: tuple[Count, ...] = ()
    rounds: Count = 0
    driven_m: float = 0.0
    rotator: Rotator = Rotator()
    finished: bool = False
    clock_ns: int = 0
    unix_ns: int = 0
    schema: Literal[1] = SCHEMA


def digest(mission: ForwardingMission) -> str:
    """The same for the same mission, whatever file it comes from."""
    return hashlib.sha256(msgspec.json.encode(mission)).hexdigest()


def copied(tally: Tally, later_ns: int = 0) -> Tally:
    """A tally of its own, with all its times so much later."""

    def moved(logs: tuple[Taken, ...] | list[Taken]) -> list[Taken]:
        return [msgspec.structs.replace(log, at_ns=log.at_ns + later_ns) for log in logs]

    loads = [
        msgspec.structs.replace(load, logs=tuple(moved(load.logs)), at_ns=load.at_ns + later_ns) for load in tally.loads
    ]
    return replace(tally, given_up=dict(tally.given_up), board=moved(tally.board), loads=loads)


def fits(progress: Progress, mission: ForwardingMission) -> bool:
    """Whether what is said of landings and waypoints can be said of this mission."""
    landings = {*progress.served, *(load.landing for load in progress.tally.loads)}
    landings |= set() if progress.landing is None else {progress.landing}
    to_come = 0 if progress.left is None else progress.left.to_come
    places = mission.options.laps * len(mission.waypoints)
    # Without any landing every load went to the first one that there could be.
    return all(0 <= at < max(1, len(mission.landings)) for at in landings) and to_come <= places
