"""Projection model of finite cylinders in front of a pinhole camera: outline and depth along rays.

Everything is in the optical frame.  A ray is (x, y, 1), so that its parameter is the depth.  The model is that of the
*visible* surface: measured depth lies a radius nearer than the axis, and the outline is where rays touch the body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from machine.geometry.optics import Intrinsics

MIN_PIXELS: Final = 24
"""A mask with fewer pixels of known depth is not measured."""
_EPSILON: Final = 1e-12


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A point on the axis (3,) [m], the unit axis (3,), both ends along the axis from that point [m], the radius at the
    point [m] and the growth of the radius along the axis [m/m] (taper)."""

    point_m: np.ndarray
    axis: np.ndarray
    start_m: float
    end_m: float
    radius_m: float
    growth: float = 0.0

    @property
    def length_m(self) -> float:
        """Distance between the ends [m]."""
        return self.end_m - self.start_m

    @property
    def center_m(self) -> np.ndarray:
        """Middle of the axis (3,) [m]."""
        return self.point_m + 0.5 * (self.start_m + self.end_m) * self.axis

    def centered(self) -> Cylinder:
        """Return the same body with its middle as the point."""
        half, move = 0.5 * self.length_m, 0.5 * (self.start_m + self.end_m)
        radius = self.radius_m + self.growth * move
        return Cylinder(self.center_m, self.axis, -half, half, radius, self.growth)


def cross(a: Sequence[float], b: Sequence[float]) -> np.ndarray:
    """Compute the cross product (3,) of two vectors; ten times as fast as numpy's for single vectors."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


def across_view(axis: np.ndarray, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute two unit vectors across the axis (3,): the first is across the line of sight to ``point_m``, the second
    as close to the line of sight as possible."""
    along, sight = axis.tolist(), point_m.tolist()
    first = cross(sight, along)
    size = math.sqrt(float(first @ first))
    if size < 0.05 * math.hypot(*sight):  # the view is along the axis: any direction serves as the first
        first = cross((1.0, 0.0, 0.0) if abs(along[0]) < 0.9 else (0.0, 1.0, 0.0), along)
        size = math.sqrt(float(first @ first))
    first /= size
    return first, cross(along, first.tolist())


@dataclass(frozen=True, slots=True)
class CylinderBatch:
    """K cylinders:  ``line`` (K, 2, 3) holds a point on each axis and the axis; ``size`` (4, K, 1) start, end, radius
    and growth.
    """

    line: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, body: Cylinder) -> CylinderBatch:
        """Make a batch of one cylinder."""
        return cls(np.array([[body.point_m, body.axis]]), _size(body))

    @classmethod
    def around(cls, body: Cylinder, steps: np.ndarray) -> CylinderBatch:
        """Change ``body`` by K steps (K, 8): across the view, along it, two tilts, start, end, radius, growth."""
        frame = np.array(across_view(body.axis, body.point_m))
        line = steps[:, :4].reshape(-1, 2, 2) @ frame + (body.point_m, body.axis)
        axis = line[:, 1]
        axis /= np.sqrt((axis * axis).sum(axis=1))[:, None]
        return cls(line, _size(body) + steps[:, 4:].T[:, :, None])

    def one(self, i: int) -> Cylinder:
        """Return cylinder ``i``."""
        start, end, radius, growth = self.size[:, i, 0].tolist()
        return Cylinder(self.line[i, 0], self.line[i, 1], start, end, radius, growth)


def _size(body: Cylinder) -> np.ndarray:
    return np.array([[[v]] for v in (body.start_m, body.end_m, body.radius_m, body.growth)])


@dataclass(frozen=True, slots=True)
class _Closest:
    """The closest approach of N rays to the axes of K cylinders (K, N).

    ``along``: component of the ray along the axis; ``across``: square of the component across it; ``depth``, ``place``
    (position along the axis) and ``dist2`` (squared distance) of the closest approach; ``radius`` there; ``point``
    (K, 1): position of the cylinder's point along the axis.
    """

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
        inner = (line[:, :1] * line).sum(axis=2)  # inner products of the point with itself and with the axis
        pa = inner[:, 1:]
        across = np.maximum((rays * rays).sum(axis=1) - along * along, _EPSILON)
        lean = lean - along * pa
        t = lean / across
        axial_position_m = t * along - pa
        at = np.minimum(np.maximum(axial_position_m, start), end)
        dist2 = np.maximum(inner[:, :1] - pa * pa - lean * t, 0.0)
        return cls(along, across, t, axial_position_m, dist2, radius + growth * at, pa)

    def part(self, which: slice) -> _Closest:
        """Return the same for some of the rays."""
        at = slice(None), which
        return _Closest(
            self.along[at], self.across[at], self.depth[at], self.place[at], self.dist2[at], self.radius[at], self.point
        )


def outline_distance(bodies: CylinderBatch, rays: np.ndarray) -> np.ndarray:
    """Compute signed distances (K, N) [m] of rays (N, 3) from K cylinders' outlines: negative inside, 0 on them.

    It is the minimum over the ray of the larger of the distances beyond the side and beyond the ends.
    """
    return _outline_distance(bodies, _Closest.of(bodies, rays))


def surface_depth(bodies: CylinderBatch, rays: np.ndarray) -> np.ndarray:
    """Compute surface depth (K, N) [m] of K cylinders along rays (N, 3); of the closest approach where a ray misses."""
    return _surface_depth(bodies, _Closest.of(bodies, rays))


def distance_and_depth(bodies: CylinderBatch, rays: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute ``outline_distance`` of the first ``first`` rays and ``surface_depth`` of the others."""
    near = _Closest.of(bodies, rays)
    return _outline_distance(bodies, near.part(slice(first))), _surface_depth(bodies, near.part(slice(first, None)))


def axial_positions(body: Cylinder, rays: np.ndarray, first: int) -> np.ndarray:
    """Compute positions (N,) [m] along the axis from the cylinder's point: of the closest approach of the first
    ``first`` rays, and of the intersection of the other rays with the surface."""
    bodies = CylinderBatch.of(body)
    near = _Closest.of(bodies, rays)
    met = _surface_depth(bodies, near) * near.along - near.point
    at = np.concatenate([near.place[0, :first], met[0, first:]])
    return np.asarray(np.clip(at, body.start_m, body.end_m))


def _outline_distance(bodies: CylinderBatch, near: _Closest) -> np.ndarray:
    dist, r, dist2 = np.sqrt(near.dist2), near.radius, near.dist2
    beyond = np.maximum(bodies.size[0] - near.place, near.place - bodies.size[1])
    # Beyond an end, the ray approaches the end while it leaves the axis: the minimum is where both distances are equal.
    q, steep = r + beyond, np.abs(near.along)
    gap = q * q - dist2
    root = np.sqrt(np.maximum(near.across * gap + steep * steep * dist2, 0.0))
    tau = gap / np.maximum(steep * q + root, _EPSILON)
    beside = dist - r
    return np.asarray(np.where(beside >= beyond, beside, beyond - steep * tau))


def _surface_depth(bodies: CylinderBatch, near: _Closest) -> np.ndarray:
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
    """Compute rays (N, 3) with z = 1 of pixels (N,)."""
    return np.stack([(u_px - pin.cx_px) / pin.fx_px, (v_px - pin.cy_px) / pin.fy_px, np.ones(len(u_px))], axis=1)
