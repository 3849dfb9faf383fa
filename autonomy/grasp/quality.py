"""Is a grasp good?  The physical rule, for many candidates at once: what is captured, what is in the way, what is left.

A candidate is where the middle between the tips comes to, the direction of the opening axis, and a height above which
logs are taken: the ground, or the top of logs that are left lying.  The tips come down open and stay just above that
height while they sweep together.  The rule (a) to (f):

(a) what is captured fits between the tongs, under the beam and, closed, into them; (b) no tong comes down on a log that
reaches over its tip; (c) nothing that is left behind lies on what is captured; (d) every captured log lies across the
tongs, within the angle of friction; (e) its weight is held near its middle; (f) more wood is better.

The rule plans and labels.  It never judges: that does the plant's physics (docs/reference/perception.md section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan, pi, sin
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders, axis_offsets
from autonomy.grasp.grapple_heights import TIP_CLEARANCE_M, HALF_PLATE_M, SCOOP_SHARE
from autonomy.grasp.jaws import Jaws

FRICTION_COEFFICIENT: Final = 0.45
MAX_AXIS_OBLIQUITY: Final = sin(atan(FRICTION_COEFFICIENT))
"""Greatest component of a captured log's level axis along the opening axis."""
LEVER_SCALE_M: Final = 0.35
OFF_CENTRE_SCALE_M: Final = 0.7
"""Off its own middle by this much one log among others is held a third as well: it may turn in the tongs."""
DENSITY_KG_M3: Final = 550.0
GRAVITY_M_S2: Final = 9.81
TIP_HEIGHT_M: Final = 0.03
"""Height of the tips over what they sweep along, where that has to be low enough to pass over."""
LOWEST_ROW_M: Final = 0.08
"""Captured logs whose undersides are less than this over what the tips sweep along are of the lowest row."""
CONTACT_M: Final = 0.06
"""A log this near to another and over it lies on it."""
SUPPORT_RISE_SHARE: Final = 0.3
"""A log so much higher than another, over the sum of their radii, lies on it, ..."""
SUPPORT_RISE_M: Final = 0.05
"""... and its underside so much higher: a thick log beside a thin one on the ground does not."""


@dataclass(frozen=True, slots=True)
class CaptureRule:
    """How strict: tips under a share of a log's diameter above its underside scoop it, for a log on the ground at most
    ``GROUND_SCOOP_SHARE``; how far apart the outer logs of
    a row may be, over what the tongs get under; how much wood there may be, over what they hold; tips pass over a log
    up to this share of its radius over its axis; heights may be off by ``slack_m``.
    """

    scoop: float
    row: float
    wood: float
    passed: float
    slack_m: float


GROUND_SCOOP_SHARE: Final = 0.35
PASS_OVER_M: Final = 0.02
"""Tips that ride up over a log come down on nothing whose axis is lower than its top by more than this."""
STRICT_RULE: Final = CaptureRule(GROUND_SCOOP_SHARE, 1.0, 1.0, 1.0, 0.01)
LAYER_RULE: Final = CaptureRule(0.5, 1.0, 1.0, 0.2, 0.02)
"""Also takes logs that lie deep between others below them: the tips brush these and roll up what they pinch."""
WIDE_RULE: Final = CaptureRule(0.35, 1.35, 1.35, 1.0, 0.01)
"""Also squeezes a row that the tongs may not get under, or more than they hold: some of it comes up, often."""


@dataclass(frozen=True, slots=True)
class GraspScores:
    """For candidates: ``captured`` (..., n) bool, ``safe`` and ``lever`` (...), ``mass_kg`` and ``count`` of what comes
    up.  ``safe``: (a) to (d) and the moment of (e) hold; ``lever``: 0..1.  All but ``captured`` are 0 where a tong
    comes down on a log, nothing is captured or it does not fit.
    """

    captured: np.ndarray
    safe: np.ndarray
    lever: np.ndarray
    mass_kg: np.ndarray
    count: np.ndarray


def rests_upon(world: Cylinders) -> np.ndarray:
    """(n, n) bool: log j (last) lies on log i, by where any of some points of its axis are over the other's."""
    off = axis_offsets(world)
    radii = (world.radius[:, None] + world.radius[None, :])[..., None]
    thicker = (world.radius[None, :] - world.radius[:, None])[..., None]
    near = np.linalg.norm(off, axis=-1) < radii + CONTACT_M
    upon: np.ndarray = np.any(near & (off[..., 2] > np.maximum(SUPPORT_RISE_SHARE * radii, thicker + SUPPORT_RISE_M)), axis=-1)
    return upon


@dataclass(frozen=True, slots=True)
class BladeSections:
    """Every log where it passes between the blades of a candidate (..., n): from where to where along the opening axis,
    its underside, top and axis there; what of it is inside; how it lies.
    """

    low_u: np.ndarray
    high_u: np.ndarray
    bottom: np.ndarray
    top: np.ndarray
    middle: np.ndarray
    inside: np.ndarray
    good: np.ndarray
    """Whether it passes the whole width of the blades and squarely enough."""
    along: np.ndarray
    """Of its centre, from the grapple's middle."""
    askew: np.ndarray
    """Squared sine of its level direction's angle to the blades."""


def blade_sections(jaws: Jaws, world: Cylinders, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> BladeSections:
    """Candidates of one shape (...) against logs whose leading axes broadcast to it."""
    cu, su = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    dx, dy = world.center[..., 0] - x[..., None], world.center[..., 1] - y[..., None]
    du, dv = cu * dx + su * dy, cu * dy - su * dx
    ax, ay, az = (world.axis[..., k] for k in range(3))
    au, av = cu * ax + su * ay, cu * ay - su * ax
    half, r = world.length / 2, world.radius
    w = jaws.blade_m / 2
    # The part of every axis that is between the planes of the blades' edges.
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
    return BladeSections(center_u - wide, center_u + wide, middle - high, middle + high, middle, inside, good, dv, askew)


def score_grasps(
    jaws: Jaws, world: Cylinders, upon: np.ndarray, at: BladeSections, level: np.ndarray, rule: CaptureRule = STRICT_RULE
) -> GraspScores:
    """Candidates whose sections (..., n) are known, at heights ``level`` (...), which broadcast; ``upon`` is
    ``rests_upon``.
    """
    r, tip, gap = world.radius, level[..., None] + TIP_HEIGHT_M, jaws.half_gap_m
    over = at.inside & (at.middle + rule.passed * (at.top - at.middle) > tip - jaws.plate_m / 2)
    farthest, nearest = np.maximum(-at.low_u, at.high_u), np.maximum(at.low_u, -at.high_u)
    scoop = np.where(upon.any(axis=0), rule.scoop, min(rule.scoop, GROUND_SCOOP_SHARE))
    taken = at.bottom + 2.0 * scoop * r >= level[..., None] + _tip_clearance_m(2.0 * r) - rule.slack_m
    captured = over & taken & (farthest < gap)
    swept = np.max(np.where(at.inside & ~captured & (nearest < gap), at.top, -np.inf), axis=-1)
    captured &= at.middle > swept[..., None] - PASS_OVER_M
    clear = ~over | captured | (nearest > gap + jaws.plate_m)
    fits = (farthest < jaws.half_width_at(at.middle - tip)) & (at.top - tip < jaws.room_m) & at.good
    safe = np.all(clear & (fits | ~captured), axis=-1) & np.any(captured, axis=-1)
    found = GraspScores(captured, safe, *(np.zeros(safe.shape) for _ in range(3)))
    where = np.nonzero(safe)  # most are out by now
    parts = (at.bottom, at.along, world.length, r, level[..., None])
    bottom, along, length, r, level = (np.broadcast_to(p, captured.shape)[where] for p in parts)
    captured = captured[where]
    share = captured.astype(float)
    below = np.sum((share @ upon.astype(float)) * (1.0 - share), axis=-1)
    wood = DENSITY_KG_M3 * pi * r * r * length * share
    total = np.sum(wood, axis=-1)
    tilt = np.abs(np.sum(wood * along, axis=-1))
    # The outer logs of the lowest row, pushed together, must be so near that the tips get under them.
    row = captured & (bottom < level + LOWEST_ROW_M)
    in_row = np.maximum(np.sum(row, axis=-1), 1)
    apart = np.sum(np.where(row, 2.0 * r, 0.0), axis=-1) * (in_row - 1) / in_row
    holds = (np.sum(share * pi * r * r, axis=-1) < rule.wood * jaws.holds_m2) & (apart < rule.row * jaws.scoops_m)
    holds &= GRAVITY_M_S2 * tilt < FRICTION_COEFFICIENT * jaws.grip_n * jaws.blade_m
    farthest_m = np.max(share * np.abs(along), axis=-1)
    safe[where] = (below == 0.0) & holds
    found.lever[where] = np.exp(-((tilt / np.maximum(total, 1e-6) / LEVER_SCALE_M) ** 2) - (farthest_m / OFF_CENTRE_SCALE_M) ** 2)
    found.mass_kg[where], found.count[where] = total, np.sum(captured, axis=-1)
    return found


def _tip_clearance_m(diameter_m: np.ndarray) -> np.ndarray:
    """As ``direct.clearance``: how high over the support the tips are for a log."""
    low, high = TIP_CLEARANCE_M
    return np.clip((HALF_PLATE_M + SCOOP_SHARE * diameter_m) / 2.0, low, high)
