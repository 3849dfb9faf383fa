"""Geometry of the open grapple for planning: the space between its jaws, where the tips come down, what it holds.

A jaw is a chord from pivot to tip that bulges outward.  Its shape over the chord and the width of its blades are those
of the C4 grapple (docs/reference/machines.md section 1.5); a larger grapple scales them.  Lengths in m in the grapple's
own frame: ``u`` along the opening axis from the middle, ``v`` across it, heights above the open tips.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np

from machine.geometry.grapple import pin_to_jaw_pivot_m
from machine.profile import Profile

C4_CHORD_M: Final = 0.648
JAW_OUTLINE: Final = ((0.06, 0.13), (0.29, 0.205), (0.585, 0.20), (0.85, 0.12), (1.0, 0.0))
"""Points of a jaw (along, outward of) its chord, over the chord's length."""
BLADE_M: Final = 0.36
"""Width of the blades of both jaws together; the grapple's width of paper A's section II-C."""
PLATE_M: Final = 0.035
CAPACITY_M2: Final = 0.24
"""Cross-section of wood in the closed grapple: the C4 class is sold with 0.20 to 0.25 m2."""
TIP_FORCE_N: Final = 9000.0
"""Closing force at the tips of one jaw."""
SCOOP_SPAN_M: Final = 0.47
"""Jaws that logs stop farther apart than this stand too steep to get under them."""
BEAM_OFFSET_M: Final = 0.03
"""The beam between the pivots begins this far above them."""


@dataclass(frozen=True, slots=True)
class Jaws:
    """Sizes of one grapple.

    ``height_m`` and ``half_width_m`` are the inner outline of the open jaws from the tips up; nothing fits above the
    last height, where the beam is.  ``scoop_span_m`` is the greatest distance between the axes of the outermost logs
    of a row when the row is pushed together.
    """

    half_gap_m: float
    blade_m: float
    plate_m: float
    capacity_m2: float
    tip_force_n: float
    scoop_span_m: float
    height_m: tuple[float, ...]
    half_width_m: tuple[float, ...]

    @property
    def room_m(self) -> float:
        """Height of the beam above the open tips."""
        return self.height_m[-1]

    def half_width_at(self, height_m: np.ndarray) -> np.ndarray:
        """Inner half width at heights above the open tips; below the tips, their half gap."""
        width: np.ndarray = np.interp(height_m, self.height_m, self.half_width_m)
        return width


def jaws_of(profile: Profile) -> Jaws:
    """The grapple of a profile; the pivots follow from its table of tip positions."""
    table = profile.grapple.jaws
    angle, gap = np.array(table.angle_rad), np.array(table.half_gap_m)
    down = table.tip_below_pin_m[0] - pin_to_jaw_pivot_m(profile.kinematics)
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
