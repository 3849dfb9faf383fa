"""A network's plan, as in Fig. 5 of paper A: the virtual depth picture and the quality map, with the grasp in both."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from autonomy.grasp.network import PixelGrasp

ZOOM: Final = 2
GAP_PX: Final = 8
QUALITY_RGB: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Colours of a quality of 0, 0.25, 0.5, 0.75 and 1 times the greatest one, which counts as 1 at least (viridis)."""
GRASP_RGB: Final = (226, 87, 58)
_JAW_SHARE: Final = 0.25
"""Half the width of a jaw, of half the opening."""


def write_plan(path: Path, depth_m: np.ndarray, quality: np.ndarray, grasp: PixelGrasp, opening_px: float) -> None:
    """Write a PNG: the depth (H, W) [m], near things bright, beside the quality (h, w) on the same square.

    ``opening_px``: opening of the grapple in pixels of the depth picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, columns = depth_m.shape
    near, far = float(np.nanmin(depth_m)), float(np.nanmax(depth_m))
    grey = 255.0 * (far - np.nan_to_num(depth_m, nan=far)) / max(far - near, 1e-6)
    anchors = np.linspace(0.0, max(1.0, float(np.max(quality))), len(QUALITY_RGB))
    coloured = np.stack([np.interp(quality, anchors, channel) for channel in np.transpose(QUALITY_RGB)], axis=-1)
    size = (ZOOM * columns, ZOOM * rows)
    sheet = Image.new("RGB", (2 * size[0] + GAP_PX, size[1]), "white")
    for left_px, picture in ((0, Image.fromarray(grey.astype(np.uint8))), (size[0] + GAP_PX, _rgb(coloured))):
        sheet.paste(picture.resize(size, Image.Resampling.NEAREST), (left_px, 0))
        _draw_grasp(ImageDraw.Draw(sheet), left_px, grasp, ZOOM * opening_px / 2.0)
    sheet.save(path, "PNG")


def _rgb(coloured: np.ndarray) -> Image.Image:
    return Image.fromarray(coloured.astype(np.uint8))


def _draw_grasp(draw: ImageDraw.ImageDraw, left_px: int, grasp: PixelGrasp, half_px: float) -> None:
    """A dot in the middle, a thin line across the opening, a thick one for each jaw."""
    u, v = left_px + ZOOM * grasp.u_px, ZOOM * grasp.v_px
    c, s, wide_px = math.cos(grasp.theta_rad), math.sin(grasp.theta_rad), _JAW_SHARE * half_px
    draw.line([(u - half_px * c, v - half_px * s), (u + half_px * c, v + half_px * s)], GRASP_RGB, 1)
    for side_px in (-half_px, half_px):
        jaw_u, jaw_v = u + side_px * c, v + side_px * s
        ends = [(jaw_u + wide_px * s, jaw_v - wide_px * c), (jaw_u - wide_px * s, jaw_v + wide_px * c)]
        draw.line(ends, GRASP_RGB, 4)
    draw.ellipse([u - 4, v - 4, u + 4, v + 4], GRASP_RGB, "white")
