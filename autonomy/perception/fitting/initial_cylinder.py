"""The initial cylinder of a fit, from a mask and its depth.

Stereo depth errs by about z^2 sigma_d / (f B), and neighbouring pixels err alike: at 5 m by as much as half a log's
radius.  Surface normals of single points are useless at that noise.  Therefore the radius comes from the width of the
mask and the tilt from a line through disparities.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from autonomy.perception.fitting.cylinder import MIN_PIXELS, Cylinder, across_view
from machine.geometry.optics import Intrinsics

RANSAC_PAIRS: Final = 48
_EPSILON: Final = 1e-12


def initial_cylinder(
    mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, slack_1_m: float, seed: int = 0
) -> Cylinder | None:
    """A cylinder from a mask (H, W) bool and depth (H, W) [m]; None when too little depth is known.

    The axis in the picture is the mask's principal axis.  A line through inverse depth along it is found by RANSAC over
    ``RANSAC_PAIRS`` pairs with inliers within ``slack_1_m`` [1/m].  The radius is half the mask's width.
    """
    v, u = np.nonzero(mask)
    if len(u) < MIN_PIXELS:
        return None
    middle = np.array([u.mean(), v.mean()])
    du, dv = u - middle[0], v - middle[1]
    values, vectors = np.linalg.eigh(np.array([[du @ du, du @ dv], [du @ dv, dv @ dv]]) / len(u))
    way = vectors[:, 1]
    along, inverse = du * way[0] + dv * way[1], 1.0 / depth_m[v, u]
    known = np.isfinite(inverse)
    if np.count_nonzero(known) < MIN_PIXELS:
        return None
    a, b = ransac_line(along[known], inverse[known], slack_1_m, seed)
    low, high = float(along.min()) - 0.5, float(along.max()) + 0.5
    width_px = min(len(u) / (high - low), math.sqrt(12.0 * max(values[0], 0.1)) * 1.3)
    far = 0.02 * max(a, 0.02)

    def axis_point(t: float) -> np.ndarray:
        return pin.deproject(middle[0] + t * way[0], middle[1] + t * way[1], 1.0 / max(a + b * t, far))

    span = axis_point(high) - axis_point(low)
    mid = axis_point(0.5 * (low + high))
    # Seen along its axis, the mask extends beyond the middle of both ends by the visible part of the end faces.
    slant = abs(float(span @ mid)) / float(np.linalg.norm(span) * np.linalg.norm(mid))
    inset = min(0.5 * width_px * slant, 0.4 * (high - low))
    start, end = axis_point(low + inset), axis_point(high - inset)
    mid = 0.5 * (start + end)
    axis, length = end - start, float(np.linalg.norm(end - start))
    if not math.isfinite(length) or length < 1e-6:
        return None
    axis /= length
    radius = 0.5 * width_px * float(mid[2]) / pin.fx_px
    deeper = across_view(axis, mid)[1]
    mid = mid + radius * deeper * math.copysign(1.0, float(deeper @ mid))
    return Cylinder(mid, axis, -0.5 * length, 0.5 * length, radius)


def ransac_line(x: np.ndarray, y: np.ndarray, slack: float, seed: int) -> tuple[float, float]:
    """Intercept a and slope b of y = a + b x through most of the points: RANSAC, then least squares over inliers."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, len(x), (2, RANSAC_PAIRS))
    apart = x[j] - x[i]
    ok = np.abs(apart) > 0.2 * (x.max() - x.min())
    slopes = np.where(ok, (y[j] - y[i]) / np.where(ok, apart, 1.0), 0.0)
    starts = np.where(ok, y[i] - slopes * x[i], np.median(y))
    step = max(1, len(x) // 100)
    counts = np.count_nonzero(np.abs(y[::step] - starts[:, None] - slopes[:, None] * x[::step]) < slack, axis=1)
    best = int(np.argmax(counts))
    inside = np.abs(y - starts[best] - slopes[best] * x) < slack
    x, y = x[inside], y[inside]
    if len(x) < 3:
        return float(starts[best]), float(slopes[best])
    from_middle = x - x.mean()
    slope = float(from_middle @ y) / max(float(from_middle @ from_middle), _EPSILON)
    return float(y.mean()) - slope * float(x.mean()), slope
