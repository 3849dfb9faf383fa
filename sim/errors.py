"""The plant's error: what was requested of the plant cannot be built or done."""

from __future__ import annotations

from runtime.errors import TimberhandError


class PlantError(TimberhandError, ValueError):
    """A truth, scene, site or request that the plant cannot use.

    ``logs`` are the numbers of the logs in a scene that it is about; empty where it is about none.
    """

    logs: tuple[int, ...] = ()
