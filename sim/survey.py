"""A surveying instrument of the bench: it reads the hanger pin in the crane's base frame, with honest noise."""

from __future__ import annotations

import random
from typing import Final

from sim.shape import Vector

NOISE_M: Final = 0.002
"""One sigma per axis: a total station on a prism that hangs from a swinging boom."""


class TotalStation:
    """Reads positions; the noise is its own, drawn from a seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(f"total station {seed}")

    def read(self, pin_m: Vector) -> Vector:
        """What it shows for a pin that is at ``pin_m``."""
        x, y, z = (axis + self._rng.gauss(0.0, NOISE_M) for axis in pin_m)
        return (x, y, z)
