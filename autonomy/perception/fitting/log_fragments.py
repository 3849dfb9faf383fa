"""One log behind another's middle shows as two masks: which fits are pieces of one log, and which are none.

Pieces lie on one line, are as wide as each other and miss the ends that face each other.  Paper A's two failures with
real logs came from a width greater than the length, and so an axis 90 degrees off: such fits are refused.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from autonomy.perception.fitting.cylinder import Cylinder
from autonomy.perception.fitting.cylinder_fit import CylinderFit

ANGLE_RAD: Final = math.radians(6.0)
GAP_M: Final = 1.5
RADII: Final = 0.35  # by how much of the larger one radii may differ
DIRECTION_RAD: Final = 0.25  # standard deviation of an axis that says nothing of where a log lies
THINNEST_M, THICKEST_M = 0.02, 0.45  # radius of anything that is lifted
LONGEST_M: Final = 8.0  # of logs that a crane loads


def refused(fit: CylinderFit) -> str:
    """Why a fit is no log; empty when it may be one."""
    body = fit.body
    if 2.0 * body.radius_m >= body.length_m:
        return f"{2 * body.radius_m:.2f} m wide and {body.length_m:.2f} m long, which is no log"
    if not THINNEST_M <= body.radius_m <= THICKEST_M:
        return f"{2 * body.radius_m:.2f} m wide, which no log here is"
    if body.length_m > LONGEST_M:
        return f"{body.length_m:.1f} m long, which no log here is"
    if fit.explained < 0.5:
        return f"only {100 * fit.explained:.0f} % of its outline is a cylinder's"
    if math.sqrt(max(np.diag(fit.covariance)[2:4].max(), 0.0)) > DIRECTION_RAD:
        return "so little is seen of it that its direction is not determined"
    return ""


def same_log(a: CylinderFit, b: CylinderFit) -> bool:
    """Whether two fits are pieces of one log with something before its middle."""
    first, second = a.body, b.body
    between = second.center_m - first.center_m
    way = between / max(1e-9, float(np.linalg.norm(between)))
    tilt = ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(a.covariance)[2:4].max(), 0.0))
    tilt_b = ANGLE_RAD + 2.0 * math.sqrt(max(np.diag(b.covariance)[2:4].max(), 0.0))
    # The shorter a piece, the less its own axis says: the line between the middles must lie along both.
    if _angle(first.axis, way) > tilt or _angle(second.axis, way) > tilt_b:
        return False
    wide, narrow = max(first.radius_m, second.radius_m), min(first.radius_m, second.radius_m)
    if wide - narrow > RADII * wide:
        return False
    gap = float(np.linalg.norm(between)) - 0.5 * (first.length_m + second.length_m)
    facing_a = a.ends_seen[1] if first.axis @ way > 0.0 else a.ends_seen[0]
    facing_b = b.ends_seen[0] if second.axis @ way > 0.0 else b.ends_seen[1]
    return gap < GAP_M and not facing_a and not facing_b


def joined(a: Cylinder, b: Cylinder) -> Cylinder:
    """A first guess of the log whose pieces two cylinders are: from the far end of one to that of the other."""
    way = b.center_m - a.center_m
    ends = np.concatenate([_ends(a), _ends(b)])
    along = ends @ way
    start, end = ends[np.argmin(along)], ends[np.argmax(along)]
    length = float(np.linalg.norm(end - start))
    radius = (a.radius_m * a.length_m + b.radius_m * b.length_m) / (a.length_m + b.length_m)
    return Cylinder(0.5 * (start + end), (end - start) / length, -0.5 * length, 0.5 * length, radius)


def groups(fits: list[CylinderFit | None]) -> list[list[int]]:
    """The numbers of the fits, those of one log together; a fit that is None belongs to no group."""
    owner = {i: i for i, fit in enumerate(fits) if fit is not None}
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
