"""A forwarder's mission: route, fences, known logs, landings and options.

Positions are WGS84: degrees, and metres above the ellipsoid where a height is known.  Bearings are degrees clockwise
from true north, as in maps and on the bus; ``autonomy.missions.local_frame`` converts both to local metres.  A mission
is plain data: ``autonomy.missions.validation`` checks it, ``autonomy.missions.mission_file`` reads and writes it.
(``autonomy.missions.crane_job`` is the record of a single grasp, which the console sends.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

import msgspec

from runtime.errors import TimberhandError

SCHEMA: Final = 1
MAX_WAYPOINTS: Final = 2_000
MAX_CORNERS: Final = 2_000
MAX_LOGS: Final = 50_000


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem of a mission: stable code, sentence with a hint, and ``file:line`` where it is known."""

    code: str
    sentence: str
    place: str = ""

    def __str__(self) -> str:
        return f"{self.place}: {self.sentence}" if self.place else self.sentence


class MissionError(TimberhandError, ValueError):
    """A mission cannot be used.  ``problems`` has one record per problem; ``code`` is that of the first."""

    def __init__(self, code: str, sentence: str, place: str = "") -> None:
        problem = Problem(code, sentence, place)
        super().__init__(code, str(problem))
        self.problems: tuple[Problem, ...] = (problem,)

    @classmethod
    def of(cls, problems: Iterable[Problem], more: str = "") -> MissionError:
        """Make the error of several problems, with a last line on those that are not listed."""
        listed_problems = tuple(problems)
        error = cls(listed_problems[0].code, "")
        error.args = ("\n".join([*map(str, listed_problems), *([more] if more else [])]),)
        error.problems = listed_problems
        return error

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.code, str(self), self.problems)


def _restored(code: str, text: str, problems: tuple[Problem, ...]) -> MissionError:
    error = MissionError(code, text)
    error.problems = problems
    return error


class Point(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A position: latitude and longitude [deg], height above the ellipsoid [m] or None."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None


class Fence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A polygon without its closing corner, counter-clockwise seen from above.

    The machine stays inside one of the keep-in fences and outside all keep-out fences.
    """

    corners: tuple[Point, ...]
    keep_out: bool = False
    name: str = ""


class KnownLog(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that is known before the mission: its centre, and its direction and size as far as known.

    ``sigma_m`` is the standard deviation of the position in each horizontal direction, None if unknown.
    ``product_key`` is the harvester's key of the assortment (StanForD 2010).
    """

    position: Point
    key: str = ""
    bearing_deg: float | None = None
    length_m: float | None = None
    diameter_m: float | None = None
    species: str = ""
    assortment: str = ""
    product_key: int | None = None
    sigma_m: float | None = None

    @property
    def volume_m3(self) -> float | None:
        """Volume of a cylinder of its length and diameter; None if unknown."""
        if self.length_m is None or self.diameter_m is None:
            return None
        return 0.25 * math.pi * self.diameter_m**2 * self.length_m


class Landing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where logs are unloaded: the centre of the pile, the direction of its logs, and the assortments it accepts (all,
    if none is named).
    """

    position: Point
    name: str = ""
    bearing_deg: float | None = None
    assortments: tuple[str, ...] = ()


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the mission is driven; None leaves a value to the machine's profile.

    Heights are those of the swing arms above their lowest position.  ``logs`` is the source of logs: ``"search"``, the
    machine detects them along the route (paper B), or ``"listed"``, it also stops at the known ones.  ``logs_wanted``
    ends the mission after that many logs; ``assortments`` leaves all others; ``laps`` counts rounds of the waypoints.
    """

    laps: int = 1
    speed_m_s: float | None = None
    transport_height_m: float | None = None
    loading_height_m: float | None = None
    logs: Literal["search", "listed"] = "search"
    logs_wanted: int | None = None
    assortments: tuple[str, ...] = ()
    sort_by_assortment: bool = False


class ForwardingMission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All data that a forwarder needs before it drives."""

    name: str = ""
    waypoints: tuple[Point, ...] = ()
    fences: tuple[Fence, ...] = ()
    landings: tuple[Landing, ...] = ()
    logs: tuple[KnownLog, ...] = ()
    options: Options = Options()
    schema: Literal[1] = SCHEMA


def is_product_key(key: float) -> bool:
    """Tell whether a number is a product key of StanForD 2010: an integer from 1."""
    return key.is_integer() and 0.0 < key < 2**31


def all_points(mission: ForwardingMission) -> tuple[Point, ...]:
    """List every position of a mission: waypoints, corners of fences, landings, logs."""
    corners = tuple(corner for fence in mission.fences for corner in fence.corners)
    landings = (landing.position for landing in mission.landings)
    return (*mission.waypoints, *corners, *landings, *(log.position for log in mission.logs))
