"""Views of a labelled depth picture: the network's 300 x 300 window, its labels, and random copies."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import map_coordinates

from training.grasp.cornell import Rectangle, wrapped

SIDE_PX: Final = 300
ZOOM_RANGE: Final = (0.5, 1.0)
"""Share of the window's side that a random copy shows, as in the framework that paper A adopts (its [10])."""
MAX_SHIFT_PX: Final = 40.0
MAX_ATTEMPTS: Final = 200


@dataclass(frozen=True, slots=True)
class View:
    """A square window: its middle in the picture [px], its rotation, and picture pixels per window pixel."""

    u_px: float
    v_px: float
    turned_rad: float = 0.0
    zoom: float = 1.0


def central_view(depth_m: np.ndarray) -> View:
    """The paper's crop in the middle of the picture."""
    height, width = depth_m.shape
    return View((width - 1) / 2, (height - 1) / 2)


def random_view(depth_m: np.ndarray, grasps: tuple[Rectangle, ...], rng: np.random.Generator) -> View:
    """A random copy (paper A II-D: zooms, crops, rotations) with the middle of at least one grasp.

    Its middle lies near the line from the middle of the picture to the mean of the grasps.
    """
    plain = central_view(depth_m)
    start = np.array([plain.u_px, plain.v_px])
    way = np.mean([(g.u_px, g.v_px) for g in grasps], axis=0) - start
    for _ in range(MAX_ATTEMPTS):
        turned, zoom = rng.uniform(-math.pi, math.pi), rng.uniform(*ZOOM_RANGE)
        u, v = start + rng.uniform(0.0, 1.0) * way + rng.uniform(-MAX_SHIFT_PX, MAX_SHIFT_PX, 2)
        view = View(float(u), float(v), float(turned), float(zoom))
        if visible_grasps(grasps, view):
            return view
    return View(grasps[0].u_px, grasps[0].v_px)


def view_depth(depth_m: np.ndarray, view: View) -> np.ndarray:
    """The depth (300, 300) float32 [m] of a view, bilinear; the border of the picture repeats, NaN stays NaN."""
    across = (np.arange(SIDE_PX) - (SIDE_PX - 1) / 2) * view.zoom
    c, s = math.cos(view.turned_rad), math.sin(view.turned_rad)
    u = view.u_px + c * across[None, :] - s * across[:, None]
    v = view.v_px + s * across[None, :] + c * across[:, None]
    return np.asarray(map_coordinates(depth_m, [v, u], order=1, mode="nearest", output=np.float32))


def visible_grasps(grasps: Iterable[Rectangle], view: View) -> tuple[Rectangle, ...]:
    """The grasps with their middle inside the view, in pixels of the view."""
    c, s = math.cos(view.turned_rad), math.sin(view.turned_rad)
    found = []
    for g in grasps:
        du, dv = (g.u_px - view.u_px) / view.zoom, (g.v_px - view.v_px) / view.zoom
        u, v = c * du + s * dv + (SIDE_PX - 1) / 2, -s * du + c * dv + (SIDE_PX - 1) / 2
        if -0.5 <= u < SIDE_PX - 0.5 and -0.5 <= v < SIDE_PX - 0.5:
            theta = wrapped(g.theta_rad - view.turned_rad)
            found.append(Rectangle(u, v, theta, g.opening_px / view.zoom, g.jaw_px / view.zoom))
    return tuple(found)


def label_maps(grasps: Iterable[Rectangle]) -> np.ndarray:
    """Q, cos 2 theta, sin 2 theta (3, 300, 300) float32.

    Q is 1 inside the rectangles and 0 elsewhere (paper A II-D).  The direction is the mean of the rectangles that cover
    a pixel, and 0 where there is none.
    """
    v, u = np.mgrid[:SIDE_PX, :SIDE_PX]
    covered, cos2, sin2 = (np.zeros((SIDE_PX, SIDE_PX), np.float32) for _ in range(3))
    for g in grasps:
        c, s = math.cos(g.theta_rad), math.sin(g.theta_rad)
        along, across = c * (u - g.u_px) + s * (v - g.v_px), -s * (u - g.u_px) + c * (v - g.v_px)
        inside = (np.abs(along) <= g.opening_px / 2) & (np.abs(across) <= g.jaw_px / 2)
        covered[inside] += 1.0
        cos2[inside] += math.cos(2.0 * g.theta_rad)
        sin2[inside] += math.sin(2.0 * g.theta_rad)
    many = np.maximum(covered, 1.0)
    return np.stack([np.minimum(covered, 1.0), cos2 / many, sin2 / many])
