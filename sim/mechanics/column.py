"""The elastic column: two sprung hinges under the mast, which no encoder measures
(docs/reference/plant-model.md section 2).

The encoders are zeroed, and the crane is levelled, at the home pose with an empty grapple: there the column stands
plumb.  The springs' rest angles carry that pose's weight, and elsewhere the tip sags against the encoders' reading.
"""

from __future__ import annotations

from collections.abc import Sequence

from sim.truth.body import Structure


class Column:
    """Spring and damper of ``flex_pitch`` and ``flex_roll``; ``home_moments``: moments of the weight at home [Nm]."""

    def __init__(self, structure: Structure, home_moments: Sequence[float]) -> None:
        self._k = (structure.flex_pitch_nm_rad, structure.flex_roll_nm_rad)
        self._damping_s = structure.flex_damping_s
        self._rest = tuple(-moment / k for moment, k in zip(home_moments, self._k, strict=True))

    def torques(self, angles: Sequence[float], rates: Sequence[float], extra_s: float = 0.0) -> list[float]:
        """Torques [Nm] on flex_pitch and flex_roll; ``extra_s`` adds to the ratio of damper to spring."""
        d = self._damping_s + extra_s
        springs = zip(angles, self._rest, rates, self._k, strict=True)
        return [-k * (x - rest + d * v) for x, rest, v, k in springs]

    def balance(self, moments: Sequence[float]) -> list[float]:
        """The angles at which the springs carry these moments [Nm]."""
        return [rest + moment / k for rest, moment, k in zip(self._rest, moments, self._k, strict=True)]
