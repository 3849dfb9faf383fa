"""The open grapple as a planner needs it: what goes between its tongs, where they come down, what closed tongs hold.

A claw is a chord from pivot to tip that bulges outward.  Its shape over the chord and the width of its blades are those
of the C4 grapple (docs/reference/machines.md section 1.5); a larger grapple has them in proportion.  Lengths in m in the grapple's own frame:
``u`` along the opening axis from the middle, ``v`` across it, heights above the open tips.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np

from machine.geometry.grapple import pin_to_tong_pivot_m
from machine.profile import Profile

C4_CHORD_M: Final = 0.648
JAW_OUTLINE: Final = ((0.06, 0.13), (0.29, 0.205), (0.585, 0.20), (0.85, 0.12), (1.0, 0.0))
"""Points of a claw (along, outward of) its chord, over the chord's length."""
BLADE_M: Final = 0.36
"""Width of the blades of both tongs together; the grapple's width of paper A's section II-C."""
PLATE_M: Final = 0.035
CAPACITY_M2: Final = 0.24
"""Cross-section of wood in closed tongs: the C4 class is sold with 0.20 to 0.25 m2."""
TIP_FORCE_N: Final = 9000.0
"""Closing force at the tips of one side."""
SCOOP_SPAN_M: Final = 0.47
"""Tongs that are stopped further apart stand too steep to get under what stopped them."""
BEAM_OFFSET_M: Final = 0.03
"""The beam between the pivots begins so far above them."""


@dataclass(frozen=True, slots=True)
class Jaws:
    """Sizes of one grapple.  ``height_m`` and ``half_width_m`` are the inner outline of the open claws from the tips
    up; nothing fits above the last height, where the beam is.  ``scoops_m``: so far apart may the axes of the outermost
    logs of a row be when it is pushed together.
    """

    half_gap_m: float
    blade_m: float
    plate_m: float
    holds_m2: float
    grip_n: float
    scoops_m: float
    height_m: tuple[float, ...]
    half_width_m: tuple[float, ...]

    @property
    def room_m(self) -> float:
        """Height of the beam above the open tips."""
        return self.height_m[-1]

    def half_width_at(self, height_m: np.ndarray) -> np.ndarray:
        """Inner half width at heights above the open tips; below them that of the tips."""
        return np.interp(height_m, self.height_m, self.half_width_m)


def jaws_of(profile: Profile) -> Jaws:
    """The grapple of a profile; the pivots come from its table of tips."""
    table = profile.grapple.tongs
    angle, gap = np.array(table.angle_rad), np.array(table.half_gap_m)
    down = table.tip_below_pin_m[0] - pin_to_tong_pivot_m(profile.kinematics)
    columns = np.stack([np.ones_like(angle), np.cos(angle)], axis=1)
    (pivot, out), *_ = np.linalg.lstsq(columns, gap + down * np.sin(angle), rcond=None)
    chord = hypot(float(out), down)
    scale = chord / C4_CHORD_M
    outline = [(0.0, gap[0])]
    for along, across in reversed(JAW_OUTLINE[:-1]):
        outline.append((down - along * down + across * out, pivot + along * out + across * down))
    outline[-1] = (down + BEAM_OFFSET_M * scale, outline[-1][1])
    height, width = zip(*((float(h), float(w) - PLATE_M * scale / 2) for h, w in outline), strict=True)
    areas = (CAPACITY_M2 * scale**2, TIP_FORCE_N * scale**2)
    return Jaws(table.half_gap_m[0], BLADE_M * scale, PLATE_M * scale, *areas, SCOOP_SPAN_M * scale, height, width)
