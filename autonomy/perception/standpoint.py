"""Where a machine that drives stands when its planner asks for logs: base, articulation, and how both move.

So a detector in another process can say where a picture was taken.
A detector that is still busy with the last picture takes the next one a little later; the machine has driven on by
then.  Over `MAX_AGE_NS` its motion is extrapolated, and no picture is measured from an older standpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from autonomy.perception.camera.frame import Pose

MAX_AGE_NS: Final = 500_000_000
"""At 1 m/s an acceleration of 0.3 m/s^2 moves the camera by 4 cm meanwhile, which the tracks average out."""
NUMBERS: Final = 14
"""Of a standpoint besides its stamp and ``load``: four vectors, the articulation and its rate."""


@dataclass(frozen=True, slots=True)
class Standpoint:
    """The crane's base in the plane and the articulation at ``stamp_ns`` (of this computer's monotonic clock).

    ``velocity_m_s`` and ``turn_rad_s`` (3,) are those of the base in the plane, ``bending_rad_s`` is the rate of
    ``articulation_rad``.
    """

    stamp_ns: int
    base: Pose
    articulation_rad: float
    velocity_m_s: np.ndarray
    turn_rad_s: np.ndarray
    bending_rad_s: float
    load: bool = False
    """Whether the crane holds a load in front of the camera."""

    def at(self, now_ns: int) -> tuple[Pose, float] | None:
        """Return base and articulation at another time; None when that is too far away."""
        if abs(now_ns - self.stamp_ns) > MAX_AGE_NS:
            return None
        seconds = (now_ns - self.stamp_ns) * 1e-9
        turn = Rotation.from_rotvec(seconds * self.turn_rad_s).as_matrix()
        base = Pose(self.base.position_m + seconds * self.velocity_m_s, turn @ self.base.rotation)
        return base, self.articulation_rad + seconds * self.bending_rad_s

    def numbers(self) -> tuple[float, ...]:
        """Return all but the stamp and ``load``, as `from_numbers` reads them."""
        turn = Rotation.from_matrix(self.base.rotation).as_rotvec()
        vectors = (self.base.position_m, turn, self.velocity_m_s, self.turn_rad_s)
        moving = (self.articulation_rad, self.bending_rad_s)
        return (*(float(v) for vector in vectors for v in vector), *moving)


def from_numbers(stamp_ns: int, numbers: Sequence[float]) -> Standpoint:
    """Make the standpoint with these `NUMBERS` numbers."""
    position, turn, velocity, turning = np.reshape(np.asarray(numbers[:12], float), (4, 3))
    base = Pose(position, Rotation.from_rotvec(turn).as_matrix())
    return Standpoint(stamp_ns, base, float(numbers[12]), velocity, turning, float(numbers[13]))


def standpoint(now_ns: int, here: Pose, before: Pose, bends_rad: tuple[float, float], seconds: float) -> Standpoint:
    """Return the standpoint of a machine that was ``before`` with the first of two articulations ``seconds`` ago."""
    rate = 0.0 if seconds <= 0.0 else 1.0 / seconds
    turn = Rotation.from_matrix(here.rotation @ before.rotation.T).as_rotvec()
    return Standpoint(
        now_ns,
        here,
        bends_rad[1],
        rate * (here.position_m - before.position_m),
        rate * turn,
        rate * (bends_rad[1] - bends_rad[0]),
    )
