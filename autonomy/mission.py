"""The mission record: what to pick and where to put it, as an operator or the console writes it."""

from __future__ import annotations

import msgspec


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pick one log from the ground and lay it into the bunk.

    ``log_id`` names the log (None: the one on top, then the one that is nearest by slewing); ``place_m`` is
    where its centre goes, base frame (None: the centre of the bunk).
    """

    log_id: int | None = None
    place_m: tuple[float, float] | None = None
