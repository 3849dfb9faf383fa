"""When tongs that let go may open on: not among what they left, however high a bunk or low a pile is."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.grasp.direct import travel_height
from autonomy.motion.arm import Arm
from autonomy.tongs import among_stakes
from machine.grapple import tip_below_pin_m
from machine.load import load_profile
from machine.profile import Bunk

AORO = load_profile("aoro_fc8")
ARM = Arm(AORO)
PILE = Bunk((0.4, -2.9), 0.0, 3.0, 2.6, -1.4, 1.5)


@pytest.mark.parametrize("bunk", [AORO.bunk, PILE])
def test_they_are_among_it_until_open_tips_are_over_its_top(bunk: Bunk) -> None:
    top = bunk.floor_z_m + bunk.stake_height_m + tip_below_pin_m(AORO.grapple.tongs, 0.0)
    high = travel_height(AORO)
    for above_m, among in ((-0.3, True), (-0.05, True), (0.05, False), (0.3, False)):
        q = ARM.joints(np.array([ARM.over(*bunk.center_m, top + above_m, high)]))[0].tolist()
        assert among_stakes(ARM, bunk, tuple(q)) is among


def test_beside_it_they_may_open_at_any_height() -> None:
    q = ARM.joints(np.array([ARM.over(*PILE.center_m, 0.0, travel_height(AORO))]))[0].tolist()
    assert among_stakes(ARM, PILE, tuple(q)) and not among_stakes(ARM, AORO.bunk, tuple(q))
