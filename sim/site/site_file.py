"""The site of a mission as a file: where on the Earth the machine starts, and the logs that lie there.

``python -m sim --site FILE`` reads it; it is JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import msgspec

from machine.profile import Profile
from sim.errors import PlantError
from sim.ground.terrain import Terrain
from sim.plant import Plant
from sim.wood.log_shape import LogSpec
from sim.wood.logs import reach_m

# -- Lays the logs of a site so that they stay where they are laid: a log that rolls away is laid anew, as a person
# would.
#
# A log lies safest along the slope: it cannot roll along its own axis.  So one that rolls is turned towards the
# line of steepest fall, and laid a little aside when it still does not rest.


MAX_ATTEMPTS: Final = 6
ROLLED_M: Final = 1.0
"""A log that came to rest farther than this from its place has rolled away."""
ASIDE_M: Final = 0.4
"""From its second attempt on, a log is laid this much farther aside each time."""
SLOPE_SPAN_M: Final = 0.6
"""The slope under a log is measured over twice this length."""

Scene = tuple[LogSpec, ...]


def laid_at_rest(build: Callable[[Scene], Plant], scene: Scene, terrain: Terrain) -> Plant:
    """Make by ``build`` the plant of a scene on ``terrain`` in which every log rests near its place.

    Raises:
        PlantError: after ``MAX_ATTEMPTS`` a log still rolls, or the scene cannot be built for another reason.
    """
    attempts = [0] * len(scene)
    for _ in range(MAX_ATTEMPTS):
        try:
            plant = build(scene)
        except PlantError as error:
            if not error.logs:
                raise
            rolling = set(error.logs)
        else:
            rolling = rolled(plant, scene)
            if not rolling:
                return plant
            plant.close()
        for i in rolling:
            attempts[i] += 1
        scene = tuple(laid_anew(log, terrain, attempts[i]) if i in rolling else log for i, log in enumerate(scene))
    return build(scene)


def rolled(plant: Plant, scene: Scene) -> set[int]:
    """Find the numbers of the logs that came to rest away from their places."""
    places = ((state.position_m, log) for state, log in zip(plant.logs(), scene, strict=True))
    return {i for i, (at, log) in enumerate(places) if math.dist(at[:2], (log.x_m, log.y_m)) > ROLLED_M}


def laid_anew(log: LogSpec, terrain: Terrain, attempt: int) -> LogSpec:
    """Lay the log along the slope at its place; from the second attempt on also aside, right and left in turn."""
    aside_m = (attempt - 1) * ASIDE_M * (-1) ** attempt
    yaw = _fall_rad(terrain, log.x_m, log.y_m)
    x_m, y_m = log.x_m - aside_m * math.sin(yaw), log.y_m + aside_m * math.cos(yaw)
    # The butt end stays on its side, so that the log is turned by no more than a quarter.
    turn = math.remainder(_fall_rad(terrain, x_m, y_m) - log.yaw_rad, math.pi)
    return replace(log, x_m=x_m, y_m=y_m, yaw_rad=log.yaw_rad + turn)


def _fall_rad(terrain: Terrain, x_m: float, y_m: float) -> float:
    """Find the direction in which the ground falls most [rad]."""
    h, d = terrain.height, SLOPE_SPAN_M
    return math.atan2(h(x_m, y_m - d) - h(x_m, y_m + d), h(x_m - d, y_m) - h(x_m + d, y_m))


# -- The site of a mission as a file


@dataclass(frozen=True, slots=True)
class Site:
    """``logs`` in laps: the first ``places`` lie at their places, and there are ``rounds`` laps of them.

    `sim.site.log_supply.LogSupplier` replaces collected logs.  ``terrain`` is a kind of `sim.ground.terrain.Terrain`.
    """

    latitude_deg: float
    longitude_deg: float
    logs: tuple[LogSpec, ...]
    places: int = 0
    rounds: int = 1
    terrain: str = "flat"

    def plant(self, profile: Profile, truth: str, seed: int) -> Plant:
        """Make the plant whose world has its origin at this site.

        Raises:
            PlantError: the machine does not drive, or the logs cannot be placed.
        """
        if profile.carrier is None:
            raise PlantError(
                "site.fixed-machine", f"{profile.name} does not drive; use a machine that drives, such as aoro_fc8"
            )
        origin_fields = {"site_lat_deg": self.latitude_deg, "site_lon_deg": self.longitude_deg}
        carrier = msgspec.structs.replace(profile.carrier, **origin_fields)
        site_profile = msgspec.structs.replace(profile, carrier=carrier)

        def build(scene: tuple[LogSpec, ...]) -> Plant:
            return Plant(site_profile, seed, truth, scene=scene, terrain=self.terrain)

        if self.terrain == "flat":  # logs on level ground stay where they are laid
            return build(self.logs)
        return laid_at_rest(build, self.logs, Terrain(self.terrain, seed, reach_m=reach_m(self.logs)))

    def save(self, path: Path) -> None:
        """Write the file."""
        path.write_bytes(msgspec.json.format(msgspec.json.encode(self)))


def load_site(path: Path) -> Site:
    """Read the file.

    Raises:
        PlantError: the file cannot be read or is not a site.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Site)
    except OSError as error:
        raise PlantError("site.unreadable", f"{path}: the site file cannot be read: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise PlantError("site.malformed", f"{path}: this is not a site file: {error}") from None
