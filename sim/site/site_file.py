"""The site of a mission as a file: where on the Earth the machine starts, and the logs that lie there.

``python -m sim --site FILE`` reads it; it is JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from machine.profile import Profile
from sim.errors import PlantError
from sim.plant import Plant
from sim.wood.log_shape import LogSpec


@dataclass(frozen=True, slots=True)
class Site:
    """``logs`` in laps: the first ``places`` lie at their places, and there are ``rounds`` laps of them.

    `sim.site.log_supply.LogSupplier` replaces collected logs.
    """

    latitude_deg: float
    longitude_deg: float
    logs: tuple[LogSpec, ...]
    places: int = 0
    rounds: int = 1

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
        return Plant(msgspec.structs.replace(profile, carrier=carrier), seed, truth, scene=self.logs)

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
