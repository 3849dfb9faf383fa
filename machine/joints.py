"""The crane's joints: the enumeration that indexes every array over joints."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class Joint(IntEnum):
    """Actuated joints in chain order (paper A III-A, RRRP + rotator; paper B 3.1.2, q1..q5).

    LIFT is the main (inner) boom, TILT the stick (outer boom), EXT the telescope.  Angles are in rad, EXT in m.
    """

    SLEW = 0
    LIFT = 1
    TILT = 2
    EXT = 3
    ROT = 4


JOINTS: Final = tuple(Joint)
N_JOINTS: Final = len(JOINTS)
ARTICULATION: Final = N_JOINTS
"""The number of the carrier's articulation where encoders are numbered; it follows the crane's joints."""
