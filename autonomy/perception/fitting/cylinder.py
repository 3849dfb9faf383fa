"""A finite cylinder before a pinhole: what it looks like, and a first guess of it from a mask and its depth.

All in the optical frame.  A ray is (x, y, 1) so that its parameter is the depth.  The model is the *visible* surface:
what depth shows lies a radius nearer than the axis, and the outline is where rays touch the body.  Depth errs by about
z^2 sigma_d / (f B), alike over neighbouring pixels: at 5 m as much as half a log's radius, so that normals of single
points say nothing; the guess takes the radius from the mask's width and the tilt from a line through disparities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from machine.geometry.optics import Intrinsics

MIN_PIXELS: Final = 24
"""A mask with fewer pixels of known depth is no log to be measured."""
PAIRS: Final = 48
_SMALL: Final = 1e-12


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A point on the axis (3,) [m], the unit axis (3,), where it starts and ends along the axis from there [m], its
    radius at the point [m] and by how much that grows along the axis [m/m]."""

    point_m: np.ndarray
    axis: np.ndarray
    start_m: float
    end_m: float
    radius_m: float
    growth: float = 0.0

    @property
    def length_m(self) -> float:
        """From end to end [m]."""
        return self.end_m - self.start_m

    @property
    def center_m(self) -> np.ndarray:
        """Middle of the axis (3,) [m]."""
        return self.point_m + 0.5 * (self.start_m + self.end_m) * self.axis

    def centered(self) -> Cylinder:
        """The same body with its middle as the point."""
        half, move = 0.5 * self.length_m, 0.5 * (self.start_m + self.end_m)
        radius = self.radius_m + self.growth * move
        return Cylinder(self.center_m, self.axis, -half, half, radius, self.growth)


def cross(a: Sequence[float], b: Sequence[float]) -> np.ndarray:
    """Cross product (3,) of two vectors; numpy's costs ten times as much for so few numbers."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


def across_view(axis: np.ndarray, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors across the axis (3,): the first across the line of sight to ``point_m``, the second as nearly along
    it as can be."""
    along, sight = axis.tolist(), point_m.tolist()
    first = cross(sight, along)
    size = math.sqrt(float(first @ first))
    if size < 0.05 * math.hypot(*sight):  # looks along the axis: any first will do
        first = cross((1.0, 0.0, 0.0) if abs(along[0]) < 0.9 else (0.0, 1.0, 0.0), along)
        size = math.sqrt(float(first @ first))
    first /= size
    return first, cross(along, first.tolist())


@dataclass(frozen=True, slots=True)
class CylinderBatch:
    """K cylinders: ``line`` (K, 2, 3) is a point on each axis and the axis; ``size`` (4, K, 1) start, end, radius and
    growth.  What ``outline`` and ``depth`` take, for all rays at once.
    """

    line: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, body: Cylinder) -> CylinderBatch:
        """One body."""
        return cls(np.array([[body.point_m, body.axis]]), _size(body))

    @classmethod
    def around(cls, body: Cylinder, steps: np.ndarray) -> CylinderBatch:
        """``body`` changed by K steps (K, 8): across the view, along it, the two tilts, start, end, radius, growth."""
        frame = np.array(across_view(body.axis, body.point_m))
        line = steps[:, :4].reshape(-1, 2, 2) @ frame + (body.point_m, body.axis)
        axis = line[:, 1]
        axis /= np.sqrt((axis * axis).sum(axis=1))[:, None]
        return cls(line, _size(body) + steps[:, 4:].T[:, :, None])

    def one(self, i: int) -> Cylinder:
        """Number ``i``."""
        start, end, radius, growth = self.size[:, i, 0].tolist()
        return Cylinder(self.line[i, 0], self.line[i, 1], start, end, radius, growth)


def _size(body: Cylinder) -> np.ndarray:
    return np.array([[[v]] for v in (body.start_m, body.end_m, body.radius_m, body.growth)])


@dataclass(frozen=True, slots=True)
class _Closest:
    """Of K bodies and N rays (K, N): ray along axis, its square across, depth, place along and squared distance of the
    closest approach to the axis, radius there; the point's own place (K, 1)."""

    along: np.ndarray
    across: np.ndarray
    depth: np.ndarray
    place: np.ndarray
    dist2: np.ndarray
    radius: np.ndarray
    point: np.ndarray

    @classmethod
    def of(cls, bodies: CylinderBatch, rays: np.ndarray) -> _Closest:
        line, (start, end, radius, growth) = bodies.line, bodies.size
        onto = line.reshape(-1, 3) @ rays.T
        lean, along = onto[::2], onto[1::2]
        inner = (line[:, :1] * line).sum(axis=2)  # of the point with itself and with the axis
        pa = inner[:, 1:]
        across = np.maximum((rays * rays).sum(axis=1) - along * along, _SMALL)
        lean = lean - along * pa
        t = lean / across
        place = t * along - pa
        at = np.minimum(np.maximum(place, start), end)
        dist2 = np.maximum(inner[:, :1] - pa * pa - lean * t, 0.0)
        return cls(along, across, t, place, dist2, radius + growth * at, pa)

    def part(self, which: slice) -> _Closest:
        """Those of some rays."""
        columns = (self.along, self.across, self.depth, self.place, self.dist2, self.radius)
        return _Closest(*(c[:, which] for c in columns), self.point)


def outline(bodies: CylinderBatch, rays: np.ndarray) -> np.ndarray:
    """How far outside each body (K) each ray (N) passes [m], negative inside, 0 on the outline: the least over the ray
    of the larger of the distances beyond the side and beyond the ends."""
    return _outline(bodies, _Closest.of(bodies, rays))


def depth(bodies: CylinderBatch, rays: np.ndarray) -> np.ndarray:
    """Depth [m] of each body (K) along each ray (N); where the ray misses, that of its closest approach."""
    return _depth(bodies, _Closest.of(bodies, rays))


def outline_and_depth(bodies: CylinderBatch, rays: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """``outline`` of the first so many rays, ``depth`` along the others."""
    near = _Closest.of(bodies, rays)
    return _outline(bodies, near.part(slice(first))), _depth(bodies, near.part(slice(first, None)))


def places(body: Cylinder, rays: np.ndarray, first: int) -> np.ndarray:
    """Where along the axis from its point (N,) [m] the first so many rays pass nearest to the body, and where the
    others meet its surface."""
    bodies = CylinderBatch.of(body)
    near = _Closest.of(bodies, rays)
    met = _depth(bodies, near) * near.along - near.point
    at = np.concatenate([near.place[0, :first], met[0, first:]])
    return np.clip(at, body.start_m, body.end_m)


def _outline(bodies: CylinderBatch, near: _Closest) -> np.ndarray:
    dist, r, dist2 = np.sqrt(near.dist2), near.radius, near.dist2
    beyond = np.maximum(bodies.size[0] - near.place, near.place - bodies.size[1])
    # Past an end, the ray comes nearer to it the further it goes from the axis: where both are alike is the least.
    q, steep = r + beyond, np.abs(near.along)
    gap = q * q - dist2
    root = np.sqrt(np.maximum(near.across * gap + steep * steep * dist2, 0.0))
    tau = gap / np.maximum(steep * q + root, _SMALL)
    beside = dist - r
    return np.where(beside >= beyond, beside, beyond - steep * tau)


def _depth(bodies: CylinderBatch, near: _Closest) -> np.ndarray:
    in_m = np.sqrt(np.maximum(near.radius * near.radius - near.dist2, 0.0) / near.across)
    entry = near.depth - in_m
    s = entry * near.along - near.point
    start, end = bodies.size[:2]
    near_end = np.where(near.along > 0.0, start, end)
    cap = (near.point + near_end) / np.where(np.abs(near.along) < 1e-6, 1e-6, near.along)
    on_side = (s >= start) & (s <= end)
    hits_cap = ~on_side & (np.abs(cap - near.depth) <= in_m)
    return np.where(on_side, entry, np.where(hits_cap, cap, near.depth))


def pixel_rays(pin: Intrinsics, u_px: np.ndarray, v_px: np.ndarray) -> np.ndarray:
    """Rays (N, 3), z = 1, of pixels (N,)."""
    return np.stack([(u_px - pin.cx_px) / pin.fx_px, (v_px - pin.cy_px) / pin.fy_px, np.ones(len(u_px))], axis=1)


def sigma_z_m(z_m: float, fb_px_m: float, sigma_d_px: float) -> float:
    """Standard deviation [m] of stereo depth: z^2 sigma_d / (f B)."""
    return z_m * z_m * sigma_d_px / fb_px_m


def initial_cylinder(mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, slack_1_m: float, seed: int = 0) -> Cylinder | None:
    """A first cylinder from a mask (H, W) bool and depth (H, W) [m]; None when too little depth is known.

    The axis in the picture is the mask's principal one; a line through inverse depths along it is found by RANSAC over
    ``PAIRS`` pairs, inliers within ``slack_1_m`` [1/m], and fitted to them; the radius is half the mask's width.
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
    a, b = line(along[known], inverse[known], slack_1_m, seed)
    low, high = float(along.min()) - 0.5, float(along.max()) + 0.5
    width_px = min(len(u) / (high - low), math.sqrt(12.0 * max(values[0], 0.1)) * 1.3)
    far = 0.02 * max(a, 0.02)

    def axis_point(t: float) -> np.ndarray:
        return pin.deproject(middle[0] + t * way[0], middle[1] + t * way[1], 1.0 / max(a + b * t, far))

    span = axis_point(high) - axis_point(low)
    mid = axis_point(0.5 * (low + high))
    # Seen along its axis, the mask reaches past both ends' middles by what shows of the discs.
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


def line(x: np.ndarray, y: np.ndarray, slack: float, seed: int) -> tuple[float, float]:
    """y = a + b x through most of the points: RANSAC, then least squares over its inliers."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, len(x), (2, PAIRS))
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
    slope = float(from_middle @ y) / max(float(from_middle @ from_middle), _SMALL)
    return float(y.mean()) - slope * float(x.mean()), slope
