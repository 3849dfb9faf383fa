"""A mask's border, and which of it outlines the log: not where something nearer cuts it, nor the rim of the picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.fitting.cylinder import Cylinder, CylinderBatch, depth, outline, pixel_rays
from machine.geometry.optics import Intrinsics

OUTLINE_POINTS: Final = 80
PROBE_PX: Final = 3  # this far outside the mask it is asked what is nearer
PROBE_MARGIN_M: Final = 0.08
RIM_PX: Final = 8  # a mask ends so near to the picture's rim without reaching it: that is no end of the log
SHARED_PX: Final = 1.5  # so near to another log's outline a border is not surely a log's own


@dataclass(frozen=True, slots=True)
class StereoSensor:
    """What is known of a stereo camera's depth: focal length times baseline [px m] of its own picture, and the
    standard deviation of its disparity [px]."""

    fb_px_m: float
    sigma_d_px: float = 0.2


@dataclass(frozen=True, slots=True)
class Contour:
    """Border points (N,) of a mask [px], whether each is the log's own outline, and the number of the mask that it
    touches there, 0 for none."""

    u_px: np.ndarray
    v_px: np.ndarray
    own: np.ndarray
    beside: np.ndarray

    def without(self, fitted: dict[int, Cylinder], pin: Intrinsics) -> Contour:
        """The points that are on the outline of a log beside it, by the fits so far, are that log's and not its own.

        What lies before it is mostly seen whole and told well; the guess of what is half hidden is not, and would take
        the other's outline for its own.
        """
        own = self.own.copy()
        for number, body in fitted.items():
            touch = np.flatnonzero(own & (self.beside == number))
            if len(touch):
                rays = pixel_rays(pin, self.u_px[touch], self.v_px[touch])
                own[touch] = outline(CylinderBatch.of(body), rays)[0] < -SHARED_PX * body.center_m[2] / pin.fx_px
        return Contour(self.u_px, self.v_px, own, self.beside)


def border(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Between every mask pixel and a neighbour outside it: the point between (u, v) (N,) [px] and the way out (N,).

    Half-way points err by less than half a pixel and without bias.  The picture's own rim is no border.
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
    """The mask's border, thinned to ``OUTLINE_POINTS``, and which of it is the log's own.

    ``window`` (left, top, right, bottom) is where the picture shows anything; ``labels`` (H, W) numbers the masks and
    ``others`` are the first guesses of the logs by their number.
    """
    u, v, du, dv = border(mask)
    if len(u) > OUTLINE_POINTS:
        pick = np.linspace(0, len(u) - 1, OUTLINE_POINTS).astype(int)
        order = np.argsort(np.arctan2(v - v.mean(), u - u.mean()), kind="stable")[pick]
        u, v, du, dv = u[order], v[order], du[order], dv[order]
    left, top, right, bottom = window
    pu = np.rint(u + (PROBE_PX - 0.5) * du).astype(int)
    pv = np.rint(v + (PROBE_PX - 0.5) * dv).astype(int)
    inside = (u >= left + RIM_PX) & (u < right - RIM_PX) & (v >= top + RIM_PX) & (v < bottom - RIM_PX)
    pu, pv = np.clip(pu, 0, mask.shape[1] - 1), np.clip(pv, 0, mask.shape[0] - 1)
    rays = pixel_rays(pin, u, v)
    bodies = CylinderBatch.of(body)
    own_m, there_m = depth(bodies, rays)[0], depth_m[pv, pu]
    margin = PROBE_MARGIN_M + 3.0 * own_m * own_m * sensor.sigma_d_px / sensor.fb_px_m
    own = inside & ~(there_m < own_m - margin)
    beside = np.zeros(len(u), int) if labels is None else labels[pv, pu]
    if others:
        for number, other in others.items():
            touch = beside == number
            if touch.any():
                theirs = depth(CylinderBatch.of(other), rays[touch])[0]
                own[touch] = inside[touch] & (theirs > own_m[touch] + 0.02)
    return Contour(u, v, own, beside)
