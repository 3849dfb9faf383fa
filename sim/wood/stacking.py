"""Clearance between logs at release, and how they are placed beside and upon each other.  Pure geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.wood.log_shape import LogSpec

GAP_M: Final = 0.004  # between logs, and to the ground, at release
STEP_M: Final = 0.002  # smallest step of the search for a free place
SPINE_POINT_COUNT: Final = 11

Array = NDArray[np.float64]


def spine(s: LogSpec) -> tuple[Array, Array]:
    """Compute points [SPINE, 3] of the pith at release, z over level ground, and the radii there [SPINE]."""
    points = np.array(s.spine(SPINE_POINT_COUNT))
    radii = np.array([s.radius(i / (SPINE_POINT_COUNT - 1) - 0.5) for i in range(SPINE_POINT_COUNT)])
    points += (s.x_m, s.y_m, s.z_m - float(np.min(points[:, 2] - radii)))
    return points, radii


def distances(p: Array, q: Array) -> Array:
    """Measure every straight piece of one polyline [n, 3] from every piece of another [m, 3]: distances [n-1, m-1]."""
    u, v = np.diff(p, axis=0)[:, None, :], np.diff(q, axis=0)[None, :, :]
    w = q[None, :-1, :] - p[:-1, None, :]
    uu, vv, uv, uw, vw = (np.sum(a * b, axis=2) for a, b in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    den = uu * vv - uv * uv
    s = np.clip(np.where(den > 1e-12, (uw * vv - vw * uv) / np.maximum(den, 1e-12), 0.0), 0.0, 1.0)
    t = np.clip((uv * s - vw) / vv, 0.0, 1.0)
    s = np.clip((uv * t + uw) / uu, 0.0, 1.0)
    gaps: Array = np.linalg.norm(w + t[..., None] * v - s[..., None] * u, axis=2)
    return gaps


def clearance(a: LogSpec, b: LogSpec) -> float:
    """Compute the gap [m] between two logs at release; negative when they overlap."""
    (p, rp), (q, rq) = spine(a), spine(b)
    radii = np.maximum(rp[:-1], rp[1:])[:, None] + np.maximum(rq[:-1], rq[1:])[None, :]
    return float(np.min(distances(p, q) - radii))


def footprint_gap(a: LogSpec, b: LogSpec) -> float:
    """Compute the gap [m] between two logs' footprints on the ground plane; negative when they overlap."""
    (p, _), (q, _) = spine(a), spine(b)
    flat = np.array([1.0, 1.0, 0.0])
    return float(np.min(distances(p * flat, q * flat))) - (a.diameter_m + b.diameter_m) / 2


def beside(s: LogSpec, others: Sequence[LogSpec]) -> LogSpec:
    """Shift the log to +y until it touches no other."""
    while (gap := min((clearance(s, o) for o in others), default=GAP_M)) < GAP_M:
        s = replace(s, y_m=s.y_m + max(STEP_M, GAP_M - gap))
    return s


def upon(s: LogSpec, others: Sequence[LogSpec]) -> LogSpec:
    """Raise the log until it touches no other."""
    while (gap := min((clearance(s, o) for o in others), default=GAP_M)) < GAP_M:
        s = replace(s, z_m=s.z_m + max(STEP_M, GAP_M - gap))
    return s
