"""The mission of a forwarder: a route, its fence, logs that are known beforehand, landings and options.

Places are WGS84: degrees, and metres above the ellipsoid where a height is known.  Bearings are degrees clockwise from
true north, as maps and the bus have them; what drives turns both into local metres with ``autonomy.missions.local_frame``.
A mission is only data: ``autonomy.missions.validation`` says what makes it one, ``autonomy.missions.mission_file`` reads and writes
it.  (``autonomy.missions.crane_job`` is the record of a single grasp, which the console sends.)
"""

from __future__ import annotations

import math
from typing import Final, Literal

import msgspec

SCHEMA: Final = 1
MAX_WAYPOINTS: Final = 2_000
MAX_CORNERS: Final = 2_000
MAX_LOGS: Final = 50_000


class MissionError(ValueError):
    """A mission cannot be used; ``problems`` holds one sentence per problem and the text is all of them."""

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class Point(msgspec.Struct, frozen=True):
    """A place: latitude and longitude [deg], height above the ellipsoid [m] or None."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None


class Fence(msgspec.Struct, frozen=True):
    """A polygon without its closing corner, counter-clockwise seen from above.

    The machine stays inside of one of the fences that keep in and outside of all that keep out.
    """

    corners: tuple[Point, ...]
    keep_out: bool = False
    name: str = ""


class KnownLog(msgspec.Struct, frozen=True):
    """A log that someone knows of: where its middle lies, what is known of its direction and size.

    ``sigma_m`` is the standard deviation of the place in each horizontal direction, None when nothing is said.
    ``product_key`` is the harvester's number of the assortment (StanForD 2010).
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
        """Of a cylinder of its length and diameter."""
        if self.length_m is None or self.diameter_m is None:
            return None
        return 0.25 * math.pi * self.diameter_m**2 * self.length_m


class Landing(msgspec.Struct, frozen=True):
    """Where logs are unloaded: the middle of the pile, the direction in which its logs lie, and which assortments
    it takes (all, when none is named).
    """

    position: Point
    name: str = ""
    bearing_deg: float | None = None
    assortments: tuple[str, ...] = ()


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the mission is driven; None leaves it to the machine's profile.

    Heights are those of the swing arms, above the lowest.  ``logs`` says where logs come from: ``"search"``, the
    machine's eyes look for them along the route (paper B), or ``"listed"``, it stops at the known ones, too.
    ``logs_wanted`` ends the mission after so many; ``assortments`` leaves the others lying; ``laps`` counts rounds of
    the waypoints.
    """

    laps: int = 1
    speed_m_s: float | None = None
    transport_height_m: float | None = None
    loading_height_m: float | None = None
    logs: Literal["search", "listed"] = "search"
    logs_wanted: int | None = None
    assortments: tuple[str, ...] = ()
    sort_by_assortment: bool = False


class ForwardingMission(msgspec.Struct, frozen=True):
    """Everything a forwarder is told before it drives."""

    name: str = ""
    waypoints: tuple[Point, ...] = ()
    fences: tuple[Fence, ...] = ()
    landings: tuple[Landing, ...] = ()
    logs: tuple[KnownLog, ...] = ()
    options: Options = Options()
    schema: Literal[1] = SCHEMA


def all_points(mission: ForwardingMission) -> tuple[Point, ...]:
    """Every place of a mission: waypoints, corners of fences, landings, logs."""
    corners = tuple(corner for fence in mission.fences for corner in fence.corners)
    return (*mission.waypoints, *corners, *(x.position for x in (*mission.landings, *mission.logs)))
