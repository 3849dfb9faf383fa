"""A noise model of stereo matching: exact depth in, measured depth out.

Depth z errs by about z^2 sigma_d / (f B).  The error is correlated over neighbouring pixels, so averaging a small
window does not remove it.  Half of its variance (assumed) is new in every frame; the other half, of the texture that is
matched, stays while the camera rests, so that averaging its frames does not remove it.  A scale error lasts for the
run.  Near surfaces grow over those behind them.  Depth is NaN where only one of the two imagers sees a surface, in
blots on surfaces (more of them where there is no texture), and outside the camera's range.  Noise is looked up in a
periodic tile shifted by seeded offsets.
"""

from __future__ import annotations

import math
import random
from functools import cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numba import njit

from machine.geometry.optics import Intrinsics
from machine.profile import Camera
from sim.camera.geometry import View
from sim.camera.render import Picture
from sim.truth.sensors import CameraTruth

TILE_PX: Final = 1024
_MASK = TILE_PX - 1
BLOT_PX: Final = 12.0  # width of a hole in a surface
PATCH_PX: Final = 16  # texture is measured in squares this wide
REST_M: Final = 0.05
REST_RAD: Final = 0.02
"""A camera that moves or turns by this much matches other pixels."""
MIN_TEXTURE_STEP: Final = 5.0  # mean step of green from pixel to pixel below which a square has no texture


@cache
def _tile(length_px: float, seed: int) -> np.ndarray:
    """Make periodic Gaussian noise (TILE_PX, TILE_PX), unit variance, autocorrelation 1/e at ``length_px``."""
    f = np.fft.fftfreq(TILE_PX)
    reach = np.exp(-2.0 * (math.pi * length_px / 2.0) ** 2 * (f[:, None] ** 2 + f[None, : TILE_PX // 2 + 1] ** 2))
    white = np.random.default_rng(seed).standard_normal((TILE_PX, TILE_PX))
    tile = np.fft.irfft2(np.fft.rfft2(white) * reach, (TILE_PX, TILE_PX))
    normal: np.ndarray = ((tile - tile.mean()) / tile.std()).astype(np.float32)
    return normal


@njit(cache=True)
def _plain(rgb: np.ndarray) -> np.ndarray:
    """Tell for squares of PATCH_PX whether they lack texture."""
    rows, columns = rgb.shape[0] // PATCH_PX + 1, rgb.shape[1] // PATCH_PX + 1
    plain = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            total, count = np.int64(0), 0
            for row in range(i * PATCH_PX, min((i + 1) * PATCH_PX, rgb.shape[0]), 4):
                for x in range(j * PATCH_PX, min((j + 1) * PATCH_PX, rgb.shape[1] - 2)):
                    total += abs(np.int64(rgb[row, x + 2, 1]) - np.int64(rgb[row, x, 1]))
                    count += 1
            plain[i, j] = total < MIN_TEXTURE_STEP * count
    return plain


@njit(cache=True)
def _stamp(out: np.ndarray, row: int, x: int, s: float, radius: float, margin: float) -> None:
    """Let a near surface cover a disc of the surface behind it."""
    height, width = out.shape
    r2 = radius * radius
    whole = int(radius)
    for dy in range(-whole, whole + 1):
        y = row + dy
        if y < 0 or y >= height:
            continue
        half = int(math.sqrt(r2 - dy * dy))
        for k in range(max(0, x - half), min(width - 1, x + half) + 1):
            if out[y, k] < s - margin:
                out[y, k] = s


@njit(cache=True)
def _fatten(
    inverse: np.ndarray,
    jump: float,
    lowest: float,
    highest: float,
    tile: np.ndarray,
    shift_row: int,
    shift_column: int,
) -> np.ndarray:
    """Widen the near surfaces of inverse depth at every jump of more than ``jump``."""
    height, width = inverse.shape
    out = inverse.copy()
    for row in range(height - 1):
        for x in range(width - 1):
            s = inverse[row, x]
            right, down = inverse[row, x + 1] - s, inverse[row + 1, x] - s
            # Every other pixel of an edge is enough: the discs are wider than that.
            if (row + x) & 1 == 0 and (abs(right) > jump or abs(down) > jump):
                n = tile[(row + shift_row) & _MASK, (x + shift_column) & _MASK]
                share = min(max(0.5 + 0.4 * n, 0.0), 1.0)
                radius = lowest + (highest - lowest) * share
                if abs(right) > jump:
                    near = x + 1 if right > 0.0 else x
                    _stamp(out, row, near, inverse[row, near], radius, 0.5 * abs(right))
                if abs(down) > jump:
                    near = row + 1 if down > 0.0 else row
                    _stamp(out, near, x, inverse[near, x], radius, 0.5 * abs(down))
    return out


@njit(cache=True, error_model="numpy")
def _matched(
    inverse: np.ndarray,
    fb: float,
    zoom: float,
    sigma: float,
    scale: float,
    z_min: float,
    z_max: float,
    tile: np.ndarray,
    blots: np.ndarray,
    cut: float,
    plain_cut: float,
    plain: np.ndarray,
    shift: np.ndarray,
    out: np.ndarray,
) -> None:
    """Make noisy depth of ``inverse``; ``fb``: focal length x baseline [px m]; ``zoom``: delivered per native pixel."""
    height, width = inverse.shape
    root = sigma / math.sqrt(2.0)
    for row in range(height):
        a, b = tile[(row + shift[0]) & _MASK], tile[(row + shift[2]) & _MASK]
        c = blots[(row + shift[4]) & _MASK]
        hidden = 1e9
        for x in range(width - 1, -1, -1):
            s = inverse[row, x]
            disparity = fb * s
            other_eye = x / zoom - disparity
            seen = other_eye <= hidden + 0.75
            hidden = min(hidden, other_eye)
            first, second = a[(x + shift[1]) & _MASK], b[(x + shift[3]) & _MASK]
            z = scale * fb / (disparity + root * (first + second))
            blot = c[(x + shift[5]) & _MASK]
            valid = s > 0.0 and seen and z_min <= z <= z_max and blot < cut
            if valid and blot > plain_cut:
                # The squares' borders are frayed, so that they are not visible.
                i = min(max(row + int(5.0 * first), 0), height - 1) // PATCH_PX
                j = min(max(x + int(5.0 * second), 0), width - 1) // PATCH_PX
                valid = not plain[i, j]
            out[row, x] = z if valid else np.nan


class StereoNoise:
    """The depth errors of one camera in one run.  ``scale`` is the run's scale factor (1: no error)."""

    def __init__(self, camera: Camera, truth: CameraTruth, seed: int | str) -> None:
        self._camera, self._truth, self._seed = camera, truth, seed
        rng = random.Random(f"stereo {seed}")
        self.scale = 1.0 + rng.choice((-1.0, 1.0)) * rng.uniform(*truth.scale_bias)
        normal = NormalDist()
        self._cut = normal.inv_cdf(1.0 - truth.hole_share)
        self._plain_cut = normal.inv_cdf(1.0 - truth.plain_hole_share)

    def _resting(self, view: View) -> tuple[int, int]:
        """Choose the lasting errors of a camera that rests here."""
        places = (view.position_m / REST_M).round().astype(int).tolist()
        turns = (view.rotation[:, 1:] / REST_RAD).round().astype(int).ravel().tolist()
        rng = random.Random(f"stereo {self._seed} at {places} {turns}")
        return rng.randrange(TILE_PX), rng.randrange(TILE_PX)

    def apply(self, picture: Picture, pinhole: Intrinsics, frame: int, view: View | None = None) -> np.ndarray:
        """Return the depth (H, W) float32 [m] as the camera measures it, NaN where it has none.

        ``pinhole`` is the picture's (it may be smaller than the camera's own), ``frame`` selects this frame's errors,
        ``view`` those of a camera that rests there; without one all are the frame's.
        """
        camera, truth = self._camera, self._truth
        rng = random.Random(f"stereo {self._seed} {frame}")
        shift = np.array([rng.randrange(TILE_PX) for _ in range(8)])
        if view is not None:
            shift[:2] = self._resting(view)
        fb = camera.fx_px * camera.baseline_m
        tile, blots = _tile(truth.correlation_px, 1), _tile(BLOT_PX, 2)
        inverse = np.nan_to_num(1.0 / picture.depth_m, copy=False, nan=0.0)
        wide = _fatten(inverse, truth.edge_jump_px / fb, *truth.edge_px, blots, shift[6], shift[7])
        out = np.empty_like(inverse)
        _matched(
            wide,
            fb,
            pinhole.fx_px / camera.fx_px,
            truth.disparity_sigma_px,
            self.scale,
            camera.depth_min_m,
            camera.depth_max_m,
            tile,
            blots,
            self._cut,
            self._plain_cut,
            _plain(picture.rgb),
            shift,
            out,
        )
        return out
