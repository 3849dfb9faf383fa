"""Flat pictures of logs without a renderer: strips on a slanted ground."""

import math

import numpy as np

from machine.geometry.optics import Intrinsics
from training.pictures.labels import ROW, Labelled, elongation, seen_along


def strip(shape, centre, angle, length, width):
    """Mask (H, W) of a strip."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    along = (u - centre[0]) * math.cos(angle) + (v - centre[1]) * math.sin(angle)
    across = (v - centre[1]) * math.cos(angle) - (u - centre[0]) * math.sin(angle)
    return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)


def ground_depth(pin, height_m=3.0, pitch=0.9):
    """Depth (H, W) of a level ground seen from ``height_m``, looking down by ``pitch``."""
    v = (np.arange(pin.height_px)[:, None] - pin.cy_px) / pin.fy_px
    return np.broadcast_to(height_m / (math.sin(pitch) + v * math.cos(pitch)), (pin.height_px, pin.width_px)).astype(
        np.float32
    )


def picture(*logs, size=160):
    """A labelled picture of strips (centre, angle, length, width); later ones lie on earlier ones."""
    pin = Intrinsics(size, size, size * 0.9, size * 0.9, (size - 1) / 2, (size - 1) / 2)
    ids = np.zeros((size, size), np.uint8)
    for i, (centre, angle, length, width) in enumerate(logs, 1):
        ids[strip(ids.shape, centre, angle, length, width)] = i
    rows = []
    for i, (centre, angle, length, width) in enumerate(logs, 1):
        v, u = np.nonzero(ids == i)
        axis = np.array([math.cos(angle), math.sin(angle)])
        middle, extent = seen_along(u, v, axis)
        ends = (*(np.array(centre) - axis * length / 2), *(np.array(centre) + axis * length / 2))
        inside = [float(0 <= ends[k] < size and 0 <= ends[k + 1] < size) for k in (0, 2)]
        rows.append((i, *middle, *ends, *inside, angle % math.pi, elongation(extent, width)))
    rgb = np.full((size, size, 3), 90, np.uint8)
    rgb[ids > 0] = (180, 130, 80)
    depth = ground_depth(pin) - 0.2 * (ids > 0)
    return Labelled(rgb, depth.astype(np.float32), ids, np.array(rows, np.float32).reshape(-1, ROW), pin)


def perfect_maps(maps, logits=(0, 1, 6, 7)):
    """The network's outputs for targets: logits where there are probabilities."""
    out = maps.copy()
    for i in logits:
        p = np.clip(maps[i], 1e-3, 1.0 - 1e-3)
        out[i] = np.log(p / (1.0 - p))
    return out
