"""The contour of a mask, and which of its points are the log's own outline.

Contour points where something nearer cuts the mask, or at the edge of the picture, are not the log's own outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.fitting.cylinder import (
    Cylinder,
    CylinderBatch,
    outline_distance,
    pixel_rays,
    surface_depth,
)
from machine.geometry.optics import Intrinsics

MAX_CONTOUR_POINTS: Final = 80
PROBE_PX: Final = 3  # distance outside the mask at which the depth of the neighbour is read
PROBE_MARGIN_M: Final = 0.08
EDGE_PX: Final = 8  # masks end this close to the edge of the picture without reaching it; this is no end of the log
SHARED_PX: Final = 1.5  # contour points this close to the outline of another log may belong to that log
NEIGHBOUR_MARGIN_M: Final = 0.02  # by which a neighbouring log must be farther away to be behind this one


@dataclass(frozen=True, slots=True)
class StereoSensor:
    """Depth accuracy of a stereo camera: focal length times baseline [px m] in its own picture, and the standard
    deviation of its disparity [px]."""

    fb_px_m: float
    sigma_d_px: float = 0.2


@dataclass(frozen=True, slots=True)
class Contour:
    """Contour points (N,) of a mask [px]; ``own``: whether each is on the log's own outline; ``beside``: the number of
    the mask that it touches there, 0 for none."""

    u_px: np.ndarray
    v_px: np.ndarray
    own: np.ndarray
    beside: np.ndarray

    def without(self, fitted: dict[int, Cylinder], pin: Intrinsics) -> Contour:
        """Return the contour without the points on the outlines of neighbouring logs ``fitted`` (by mask number).

        A log in front is mostly seen whole and fitted well.  The initial cylinder of a half hidden log is not, and
        would take the neighbour's outline for its own.
        """
        own = self.own.copy()
        for number, body in fitted.items():
            touch = np.flatnonzero(own & (self.beside == number))
            if len(touch):
                rays = pixel_rays(pin, self.u_px[touch], self.v_px[touch])
                shared_m = SHARED_PX * body.center_m[2] / pin.fx_px
                own[touch] = outline_distance(CylinderBatch.of(body), rays)[0] < -shared_m
        return Contour(self.u_px, self.v_px, own, self.beside)


def mask_border(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find points u, v (N,) [px] half-way between mask pixels and neighbours outside, and the outward direction (N,).

    Half-way points err by less than half a pixel and without bias.  The edge of the picture is not part of the border.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = max(0, int(rows[0]) - 1), max(0, int(columns[0]) - 1)
    m = mask[top : rows[-1] + 2, left : columns[-1] + 2]
    right, down = m[:, :-1] != m[:, 1:], m[:-1] != m[1:]
    v1, u1 = np.nonzero(right)
    v2, u2 = np.nonzero(down)
    out_u = np.where(m[v1, u1], 1, -1)
    out_v = np.where(m[v2, u2], 1, -1)
    u = np.concatenate([u1 + 0.5, u2]) + left
    v = np.concatenate([v1, v2 + 0.5]) + top
    zero_1, zero_2 = np.zeros(len(u1), int), np.zeros(len(u2), int)
    return u, v, np.concatenate([out_u, zero_2]), np.concatenate([zero_1, out_v])


def log_contour(
    mask: np.ndarray,
    depth_m: np.ndarray,
    pin: Intrinsics,
    body: Cylinder,
    sensor: StereoSensor,
    window: tuple[int, int, int, int],
    labels: np.ndarray | None = None,
    others: dict[int, Cylinder] | None = None,
) -> Contour:
    """Find the contour of a mask (H, W) bool, thinned to ``MAX_CONTOUR_POINTS``, with the log's own outline marked.

    Args:
        mask: (H, W) bool.
        depth_m: (H, W) [m].
        pin: intrinsics of this part of the picture.
        body: the log's initial cylinder.
        sensor: accuracy of the depth.
        window: left, top, right, bottom of the picture without black bars.
        labels: (H, W), the numbers of all masks.
        others: the initial cylinders of other logs by the number of their mask.
    """
    u, v, du, dv = mask_border(mask)
    if len(u) > MAX_CONTOUR_POINTS:
        pick = np.linspace(0, len(u) - 1, MAX_CONTOUR_POINTS).astype(int)
        order = np.argsort(np.arctan2(v - v.mean(), u - u.mean()), kind="stable")[pick]
        u, v, du, dv = u[order], v[order], du[order], dv[order]
    left, top, right, bottom = window
    pu = np.rint(u + (PROBE_PX - 0.5) * du).astype(int)
    pv = np.rint(v + (PROBE_PX - 0.5) * dv).astype(int)
    inside = (u >= left + EDGE_PX) & (u < right - EDGE_PX) & (v >= top + EDGE_PX) & (v < bottom - EDGE_PX)
    pu, pv = np.clip(pu, 0, mask.shape[1] - 1), np.clip(pv, 0, mask.shape[0] - 1)
    rays = pixel_rays(pin, u, v)
    bodies = CylinderBatch.of(body)
    own_m, there_m = surface_depth(bodies, rays)[0], depth_m[pv, pu]
    margin = PROBE_MARGIN_M + 3.0 * own_m * own_m * sensor.sigma_d_px / sensor.fb_px_m
    own = inside & ~(there_m < own_m - margin)
    beside = np.zeros(len(u), int) if labels is None else labels[pv, pu]
    if others:
        for number, other in others.items():
            touch = beside == number
            if touch.any():
                theirs = surface_depth(CylinderBatch.of(other), rays[touch])[0]
                own[touch] = inside[touch] & (theirs > own_m[touch] + NEIGHBOUR_MARGIN_M)
    return Contour(u, v, own, beside)
