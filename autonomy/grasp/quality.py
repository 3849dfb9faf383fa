"""Grasp quality: the physical capture rule, for many candidates at once.

A candidate is the point midway between the tips, the direction of the opening axis, and a height above which logs are
taken: the ground, or the top of logs that stay lying.  The tips come down open and stay just above that height while
they sweep together.  The rule has parts (a) to (f):

(a) what is captured fits between the jaws, under the beam and, closed, into them; (b) no jaw comes down on a log that
reaches over its tip; (c) nothing that is left behind lies on what is captured; (d) every captured log lies across the
jaws, within the angle of friction; (e) its weight is held near its middle; (f) more wood is better.

The rule plans and labels.  It never evaluates: that does the plant's physics (docs/reference/perception.md section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, hypot, pi, sin
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, axis_offsets
from autonomy.grasp.grapple_heights import HALF_PLATE_M, SCOOP_SHARE, TIP_CLEARANCE_M
from machine.geometry.grapple import pin_to_jaw_pivot_m
from machine.profile import Profile

FRICTION_COEFFICIENT: Final = 0.45
MAX_AXIS_OBLIQUITY: Final = sin(atan(FRICTION_COEFFICIENT))
"""Greatest component of a captured log's level axis along the opening axis."""
LEVER_SCALE_M: Final = 0.35
OFF_CENTRE_SCALE_M: Final = 0.7
"""At this distance from its own middle, one log among others scores a third: it may turn in the jaws."""
DENSITY_KG_M3: Final = 550.0
GRAVITY_M_S2: Final = 9.81
TIP_HEIGHT_M: Final = 0.03
"""Height of the tips over the surface they sweep along, for what they have to pass over."""
LOWEST_ROW_M: Final = 0.08
"""Captured logs whose undersides are lower than this over the swept surface form the lowest row."""
WEDGED_SHARE: Final = 0.8
"""To this share of its width jaws press a row together on which others lie.  Of heaps of four to six logs all 13 whose
row's outer axes were up to 0.57 m apart came up at the first closing, of wider ones 13 of 20."""
CONTACT_M: Final = 0.06
"""A log this near to another and above it lies on it."""
SUPPORT_RISE_SHARE: Final = 0.3
"""A log lies on another if it is higher by this share of the sum of their radii, ..."""
SUPPORT_RISE_M: Final = 0.05
"""... and its underside higher by this: a thick log beside a thin one on the ground is not."""


@dataclass(frozen=True, slots=True)
class CaptureRule:
    """How strict the rule is.

    Tips lower than ``scoop_share`` of a log's diameter above its underside scoop it; for a log on the ground at most
    ``GROUND_SCOOP_SHARE`` counts.  ``row_span_factor`` bounds the span of a row over what the jaws get under,
    ``capacity_factor`` the wood over what they hold.  Tips pass over a log up to ``pass_over_share`` of its radius
    above its axis.  Heights may be off by ``slack_m``.  Tips that ride up over a log do not come down on one whose axis
    is lower than its top by more than ``pass_over_m``.
    """

    scoop_share: float
    row_span_factor: float
    capacity_factor: float
    pass_over_share: float
    slack_m: float
    pass_over_m: float


GROUND_SCOOP_SHARE: Final = 0.35
STRICT_RULE: Final = CaptureRule(GROUND_SCOOP_SHARE, 1.0, 1.0, 1.0, 0.01, 0.02)
LAYER_RULE: Final = CaptureRule(0.5, 1.0, 1.0, 0.2, 0.03, 0.05)
"""Also takes logs that lie deep between others below them: the tips brush these and roll up what they pinch."""
WIDE_RULE: Final = CaptureRule(0.35, 1.35, 1.35, 1.0, 0.01, 0.02)
"""Also squeezes a row that the jaws may not get under, or more than they hold: often some of it comes up."""


@dataclass(frozen=True, slots=True)
class GraspScores:
    """Scores of candidates: ``captured`` (..., n) bool, ``safe`` and ``balance`` (...), ``mass_kg`` and ``count`` of
    what comes up.

    ``safe``: (a) to (d) and the moment of (e) hold.  ``balance`` is 0 to 1, greatest when held in the middle.  All but
    ``captured`` are 0 where a jaw comes down on a log, nothing is captured or it does not fit.
    """

    captured: np.ndarray
    safe: np.ndarray
    balance: np.ndarray
    mass_kg: np.ndarray
    count: np.ndarray


def rests_upon(world: Cylinders) -> np.ndarray:
    """Tell whether log j (last) lies on log i (n, n), by points of its axis above the other's."""
    off = axis_offsets(world)
    radii = (world.radius[:, None] + world.radius[None, :])[..., None]
    thicker = (world.radius[None, :] - world.radius[:, None])[..., None]
    near = np.linalg.norm(off, axis=-1) < radii + CONTACT_M
    upon: np.ndarray = np.any(
        near & (off[..., 2] > np.maximum(SUPPORT_RISE_SHARE * radii, thicker + SUPPORT_RISE_M)), axis=-1
    )
    return upon


@dataclass(frozen=True, slots=True)
class BladeSections:
    """Every log where it passes between the blades of a candidate (..., n): its extent along the opening axis, the
    heights of its underside, top and axis there, whether any of it is inside, and how it lies.
    """

    low_u: np.ndarray
    high_u: np.ndarray
    bottom: np.ndarray
    top: np.ndarray
    middle: np.ndarray
    inside: np.ndarray
    good: np.ndarray
    """Whether it passes the whole width of the blades, and squarely enough."""
    along: np.ndarray
    """Distance of its centre from the grapple's middle along the blades."""
    obliquity_sq: np.ndarray
    """Squared sine of the angle between its level direction and the blades."""


def blade_sections(jaws: Jaws, world: Cylinders, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> BladeSections:
    """Compute the sections of candidates of one shape (...) with logs whose leading axes broadcast to it."""
    cu, su = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    dx, dy = world.center[..., 0] - x[..., None], world.center[..., 1] - y[..., None]
    du, dv = cu * dx + su * dy, cu * dy - su * dx
    ax, ay, az = (world.axis[..., k] for k in range(3))
    au, av = cu * ax + su * ay, cu * ay - su * ax
    half, r = world.length / 2, world.radius
    w = jaws.blade_m / 2
    # The part of every axis between the planes of the blades' edges.
    over = 1.0 / np.where(np.abs(av) < 1e-3, np.copysign(1e-3, av), av)
    middle_s, reach_s = -dv * over, np.abs(w * over)
    s0, s1 = np.clip(middle_s - reach_s, -half, half), np.clip(middle_s + reach_s, -half, half)
    inside = s1 - s0 > 1e-6
    part = 0.5 * (s1 - s0)
    center_u = du + 0.5 * (s0 + s1) * au
    wide = part * np.abs(au) + r * np.sqrt(np.maximum(1.0 - au * au, 0.0))
    middle = world.center[..., 2] + 0.5 * (s0 + s1) * az
    high = part * np.abs(az) + r
    level_axis = np.maximum(np.sqrt(1.0 - az * az), 1e-6)
    good = (part > 0.9 * np.minimum(reach_s, half)) & (np.abs(au) < MAX_AXIS_OBLIQUITY * level_axis)
    askew = (au / level_axis) ** 2
    return BladeSections(
        center_u - wide, center_u + wide, middle - high, middle + high, middle, inside, good, dv, askew
    )


def score_grasps(
    jaws: Jaws,
    world: Cylinders,
    upon: np.ndarray,
    at: BladeSections,
    level: np.ndarray,
    rule: CaptureRule = STRICT_RULE,
) -> GraspScores:
    """Score candidates with known sections (..., n) at heights ``level`` (...), which broadcast; ``upon`` is
    ``rests_upon``.
    """
    r, tip, gap = world.radius, level[..., None] + TIP_HEIGHT_M, jaws.half_gap_m
    over = at.inside & (at.middle + rule.pass_over_share * (at.top - at.middle) > tip - jaws.plate_m / 2)
    farthest, nearest = np.maximum(-at.low_u, at.high_u), np.maximum(at.low_u, -at.high_u)
    scoop = np.where(upon.any(axis=0), rule.scoop_share, min(rule.scoop_share, GROUND_SCOOP_SHARE))
    taken = at.bottom + 2.0 * scoop * r >= level[..., None] + _tip_clearance_m(2.0 * r) - rule.slack_m
    captured = over & taken & (farthest < gap)
    swept = np.max(np.where(at.inside & ~captured & (nearest < gap), at.top, -np.inf), axis=-1)
    captured &= at.middle > swept[..., None] - rule.pass_over_m
    clear = ~over | captured | (nearest > gap + jaws.plate_m)
    fits = (farthest < jaws.half_width_at(at.middle - tip)) & (at.top - tip < jaws.room_m) & at.good
    safe = np.all(clear & (fits | ~captured), axis=-1) & np.any(captured, axis=-1)
    scores = GraspScores(captured, safe, *(np.zeros(safe.shape) for _ in range(3)))
    safe_index = np.nonzero(safe)  # most candidates are excluded by now
    parts = (at.bottom, at.low_u, at.high_u, at.along, world.length, r, level[..., None])
    bottom, low_u, high_u, along, length, r, level = (np.broadcast_to(p, captured.shape)[safe_index] for p in parts)
    captured = captured[safe_index]
    share = captured.astype(float)
    below = np.sum((share @ upon.astype(float)) * (1.0 - share), axis=-1)
    wood = DENSITY_KG_M3 * pi * r * r * length * share
    total = np.sum(wood, axis=-1)
    tilt = np.abs(np.sum(wood * along, axis=-1))
    # The outer logs of the lowest row, pushed together, must be near enough for the tips to get under them.
    row = captured & ((bottom < level + LOWEST_ROW_M) | ~upon.any(axis=0))
    in_row = np.maximum(np.sum(row, axis=-1), 1)
    apart = np.sum(np.where(row, 2.0 * r, 0.0), axis=-1) * (in_row - 1) / in_row
    # What lies on the row wedges it apart, and may hide another log in it: it does not get much narrower than it lies.
    middle_u = 0.5 * (low_u + high_u)
    lying = np.max(np.where(row, middle_u, -np.inf), axis=-1) - np.min(np.where(row, middle_u, np.inf), axis=-1)
    wedged = np.any(captured & ~row, axis=-1)
    apart = np.where(wedged, np.maximum(apart, WEDGED_SHARE * lying), apart)
    holds = (np.sum(share * pi * r * r, axis=-1) < rule.capacity_factor * jaws.capacity_m2) & (
        apart < rule.row_span_factor * jaws.scoop_span_m
    )
    holds &= GRAVITY_M_S2 * tilt < FRICTION_COEFFICIENT * jaws.tip_force_n * jaws.blade_m
    farthest_m = np.max(share * np.abs(along), axis=-1)
    safe[safe_index] = (below == 0.0) & holds
    scores.balance[safe_index] = np.exp(
        -((tilt / np.maximum(total, 1e-6) / LEVER_SCALE_M) ** 2) - (farthest_m / OFF_CENTRE_SCALE_M) ** 2
    )
    scores.mass_kg[safe_index], scores.count[safe_index] = total, np.sum(captured, axis=-1)
    return scores


def _tip_clearance_m(diameter_m: np.ndarray) -> np.ndarray:
    """Compute ``grapple_heights.tip_clearance_m`` for arrays."""
    low, high = TIP_CLEARANCE_M
    return np.clip((HALF_PLATE_M + SCOOP_SHARE * diameter_m) / 2.0, low, high)


# -- Geometry of the open grapple for planning: the space between its jaws, where the tips come down, what it holds.
#
# A jaw is a chord from pivot to tip that bulges outward.  Its shape over the chord and the width of its blades are
# those of the C4 grapple (docs/reference/machines.md section 1.5); a larger grapple scales them.  Lengths in m in
# the grapple's own frame: ``u`` along the opening axis from the middle, ``v`` across it, heights above the open
# tips.

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
        """Compute the inner half width at heights above the open tips; below the tips, their half gap."""
        width: np.ndarray = np.interp(height_m, self.height_m, self.half_width_m)
        return width


def jaws_of(profile: Profile) -> Jaws:
    """Derive the grapple from a profile; the pivots follow from its table of tip positions."""
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
