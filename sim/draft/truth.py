"""The truth of a drafted machine, complete: with the inertias that follow from its own links."""

from __future__ import annotations

from typing import Final

import msgspec

from machine.draft.answers import Answers
from machine.profile import Profile
from sim.draft.least_inertia import least_inertia
from sim.draft.truth_text import truth_text
from sim.draft.urdf import crane_urdf
from sim.truth.load import Truth

_UNKNOWN: Final = dict.fromkeys(("slew", "lift", "tilt", "ext", "rot", "grapple"), 1.0)


def truth_and_urdf(answers: Answers, profile: Profile) -> tuple[str, str]:
    """The texts of the truth file and of the URDF file of the machine of these answers and this profile."""
    links = msgspec.toml.decode(truth_text(answers, _UNKNOWN), type=Truth)
    return truth_text(answers, least_inertia(profile, links)), crane_urdf(profile, links)
