"""Plausibility of fits, and fits that are fragments of one log.

A log that lies behind another one can show as two masks.  Fragments of one log lie on one line, have the same width,
and miss the ends that face each other.  Paper A's two failures with real logs came from a width greater than the
length, which turns the axis by 90 degrees: such fits are rejected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.fitting.cylinder import Cylinder
from autonomy.perception.fitting.cylinder_fit import CylinderFit

MAX_ANGLE_RAD: Final = math.radians(6.0)  # between the axes of fragments, beside their uncertainty
MAX_GAP_M: Final = 1.5
MAX_RADIUS_DIFFERENCE: Final = 0.35  # of two fragments, as a share of the larger radius
MAX_DIRECTION_SIGMA_RAD: Final = 0.25  # of a usable axis
MIN_RADIUS_M, MAX_RADIUS_M = 0.02, 0.45  # of anything that the crane lifts
MAX_LENGTH_M: Final = 8.0  # of logs that a crane loads
MIN_EXPLAINED: Final = 0.5  # share of the contour


@dataclass(frozen=True, slots=True)
class Implausibility:
    """Why a fit is not a log."""

    code: str
    sentence: str


def implausibility(fit: CylinderFit) -> Implausibility | None:
    """Why a fit is not a log; None when it is plausible."""
    body = fit.body
    if 2.0 * body.radius_m >= body.length_m:
        return Implausibility("too-wide", f"{2 * body.radius_m:.2f} m wide and {body.length_m:.2f} m long: not a log")
    if not MIN_RADIUS_M <= body.radius_m <= MAX_RADIUS_M:
        return Implausibility("bad-width", f"{2 * body.radius_m:.2f} m wide: outside the range of logs")
    if body.length_m > MAX_LENGTH_M:
        return Implausibility("too-long", f"{body.length_m:.1f} m long: longer than any log")
    if fit.explained < MIN_EXPLAINED:
        return Implausibility("bad-contour", f"a cylinder explains only {100 * fit.explained:.0f} % of its contour")
    if math.sqrt(max(np.diag(fit.covariance)[2:4].max(), 0.0)) > MAX_DIRECTION_SIGMA_RAD:
        return Implausibility("unknown-direction", "too little of it is visible to determine its direction")
    return None


def same_log(a: CylinderFit, b: CylinderFit) -> bool:
    """Whether two fits are fragments of one log whose middle is hidden."""
    first, second = a.body, b.body
    between = second.center_m - first.center_m
    way = between / max(1e-9, float(np.linalg.norm(between)))
    tilt = MAX_ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(a.covariance)[2:4].max(), 0.0))
    tilt_b = MAX_ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(b.covariance)[2:4].max(), 0.0))
    # The shorter a fragment, the less certain its own axis: the line between the middles must lie along both.
    if _angle(first.axis, way) > tilt or _angle(second.axis, way) > tilt_b:
        return False
    wide, narrow = max(first.radius_m, second.radius_m), min(first.radius_m, second.radius_m)
    if wide - narrow > MAX_RADIUS_DIFFERENCE * wide:
        return False
    gap = float(np.linalg.norm(between)) - 0.5 * (first.length_m + second.length_m)
    facing_a = a.ends_seen[1] if first.axis @ way > 0.0 else a.ends_seen[0]
    facing_b = b.ends_seen[0] if second.axis @ way > 0.0 else b.ends_seen[1]
    return gap < MAX_GAP_M and not facing_a and not facing_b


def joined_cylinder(a: Cylinder, b: Cylinder) -> Cylinder:
    """The initial cylinder of a log with two fragments: from the far end of one to the far end of the other."""
    way = b.center_m - a.center_m
    ends = np.concatenate([_ends(a), _ends(b)])
    along = ends @ way
    start, end = ends[np.argmin(along)], ends[np.argmax(along)]
    length = float(np.linalg.norm(end - start))
    radius = (a.radius_m * a.length_m + b.radius_m * b.length_m) / (a.length_m + b.length_m)
    return Cylinder(0.5 * (start + end), (end - start) / length, -0.5 * length, 0.5 * length, radius)


def fragment_groups(fits: Mapping[int, CylinderFit]) -> list[list[int]]:
    """The numbers of the fits, in groups of one log each; the numbers ascend."""
    owner = {i: i for i in fits}
    for i in owner:
        for j in owner:
            if i < j and owner[i] != owner[j] and same_log(fits[i], fits[j]):
                old = owner[j]
                owner.update({k: owner[i] for k, group in owner.items() if group == old})
    return [[i for i in owner if owner[i] == group] for group in sorted(set(owner.values()))]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.acos(min(1.0, abs(float(a @ b))))


def _ends(body: Cylinder) -> np.ndarray:
    return np.stack([body.point_m + body.start_m * body.axis, body.point_m + body.end_m * body.axis])
