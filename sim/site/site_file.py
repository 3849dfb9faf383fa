"""The site of a mission as a file: where on the Earth the machine starts, and the logs that lie there.

``python -m sim --site FILE`` reads it; it is JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from machine.profile import Profile
from sim.errors import PlantError
from sim.ground.terrain import Terrain
from sim.plant import Plant
from sim.site.laying import laid_at_rest
from sim.wood.log_shape import LogSpec
from sim.wood.logs import reach_m


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
        """The plant whose world has its origin at this site.

        Raises:
            PlantError: the machine does not drive, or the logs cannot be placed.
        """
        if profile.carrier is None:
            raise PlantError(
                "site.fixed-machine", f"{profile.name} does not drive; use a machine that drives, such as aoro_fc8"
            )
        here = {"site_lat_deg": self.latitude_deg, "site_lon_deg": self.longitude_deg}
        carrier = msgspec.structs.replace(profile.carrier, **here)
        here_profile = msgspec.structs.replace(profile, carrier=carrier)

        def build(scene: tuple[LogSpec, ...]) -> Plant:
            return Plant(here_profile, seed, truth, scene=scene, terrain=self.terrain)

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
