"""The site of a mission as a file: where on the Earth the machine stands first, and the logs that lie there.

What a plant in a process of its own is given (``python -m sim --site FILE``), as JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from machine.profile import Profile
from sim.plant import Plant
from sim.wood.log_shape import LogSpec


@dataclass(frozen=True, slots=True)
class Site:
    """The first ``places`` of the logs have one at their place for each of ``rounds`` rounds (`sim.site.log_supply.Layer`)."""

    latitude_deg: float
    longitude_deg: float
    logs: tuple[LogSpec, ...]
    places: int = 0
    rounds: int = 1

    def plant(self, profile: Profile, truth: str, seed: int) -> Plant:
        """The plant with the origin of its world there; raises ValueError for a machine that stands still."""
        if profile.carrier is None:
            raise ValueError(f"{profile.name} stands still; a site needs a machine that drives, such as aoro_fc8")
        here = {"site_lat_deg": self.latitude_deg, "site_lon_deg": self.longitude_deg}
        carrier = msgspec.structs.replace(profile.carrier, **here)
        return Plant(msgspec.structs.replace(profile, carrier=carrier), seed, truth, scene=self.logs)

    def save(self, path: Path) -> None:
        """Write it."""
        path.write_bytes(msgspec.json.format(msgspec.json.encode(self)))


def load_site(path: Path) -> Site:
    """Read it; raises ValueError with a sentence."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Site)
    except OSError as error:
        raise ValueError(f"{path}: the site cannot be read: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise ValueError(f"{path}: this is no site: {error}") from None
