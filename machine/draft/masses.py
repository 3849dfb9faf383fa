"""Where the masses of a crane's links are, as shares of the links: from the two shipped machines, which agree.

The profile needs them as weights at the two pins, the plant as centres of mass.
"""

from __future__ import annotations

from typing import Final

from machine.draft.answers import MassAnswers

BOOM_CENTRE: Final = 0.46
"""Of the boom, from its pin."""
STICK_CENTRE: Final = 0.40
"""Of stick and of telescope, from the stick pin to the hanger pin at extension 0."""
TELESCOPE_CENTRE: Final = 0.46


def weights_at_pins(masses: MassAnswers) -> tuple[float, float]:
    """The empty crane as weights at the stick pin and at the hanger pin [kg]."""
    links = ((masses.stick_kg, STICK_CENTRE), (masses.telescope_kg, TELESCOPE_CENTRE))
    head = BOOM_CENTRE * masses.boom_kg + sum((1.0 - share) * mass for mass, share in links)
    return head, masses.grapple_kg + sum(share * mass for mass, share in links)
