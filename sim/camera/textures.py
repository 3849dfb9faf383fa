"""Surfaces as small periodic pictures, made once per seed from filtered noise; the renderer only looks them up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

GROUND_PX: Final = 512
GROUND_TEXEL_M: Final = 0.006
MIP_LEVEL_COUNT: Final = 6
PATCH_PX: Final = 256
PATCH_TEXEL_M: Final = 0.10
BARK_PX: Final = 256  # around the log and along BARK_LENGTH_M
BARK_LENGTH_M: Final = 1.0
END_PX: Final = 128
HORIZON_PX: Final = (128, 2048)  # elevation 0..HORIZON_RAD, azimuth
HORIZON_RAD: Final = 0.5
VARIANT_COUNT: Final = 6  # number of appearances; a seed selects one


def noise(
    rng: np.random.Generator, shape: tuple[int, int], wave_px: tuple[float, float], slope: float = 1.0
) -> np.ndarray:
    """Make periodic noise, mean 0 and unit variance, with features about ``wave_px`` (rows, columns) long.

    A larger ``slope`` leaves less fine structure.
    """
    fy, fx = np.fft.fftfreq(shape[0])[:, None] * wave_px[0], np.fft.rfftfreq(shape[1])[None, :] * wave_px[1]
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) / (1.0 + (fy * fy + fx * fx) ** slope)
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, shape)
    normal: np.ndarray = field / field.std()
    return normal


def _mix(base: tuple[float, ...], other: tuple[float, ...], weight: np.ndarray) -> np.ndarray:
    w = np.clip(weight, 0.0, 1.0)[..., None]
    mixed: np.ndarray = np.asarray(base) * (1.0 - w) + np.asarray(other) * w
    return mixed


def _bytes(picture: np.ndarray) -> np.ndarray:
    whole: np.ndarray = np.clip(picture, 0.0, 255.0).astype(np.uint8)
    return whole


def _pyramid(picture: np.ndarray) -> np.ndarray:
    """Compute all levels (MIP_LEVEL_COUNT, size, size, 3) of a square picture, each stored in its top left corner."""
    out = np.zeros((MIP_LEVEL_COUNT, *picture.shape), np.uint8)
    level = picture
    for i in range(MIP_LEVEL_COUNT):
        n = level.shape[0]
        out[i, :n, :n] = _bytes(level)
        level = level.reshape(n // 2, 2, n // 2, 2, 3).mean(axis=(1, 3))
    return out


def _asphalt(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    size = (GROUND_PX, GROUND_PX)
    stones, worn = noise(rng, size, (4, 4), 2.0), noise(rng, size, (90, 90))
    clean = _mix((78, 79, 82), (150, 148, 144), 0.28 + 0.16 * stones + 0.07 * worn)
    clean -= (
        55.0
        * np.clip(1.0 - 9.0 * np.abs(noise(rng, size, (300, 300), 1.6)), 0.0, 1.0)[..., None]
        * (worn[..., None] > 0.6)
    )
    litter = noise(rng, size, (22, 9), 2.0)
    dirty = _mix((104, 94, 82), (150, 118, 84), 0.35 + 0.2 * stones + 0.1 * worn)
    dirty = np.where((litter > 1.5)[..., None], (128.0, 84.0, 50.0) + 14.0 * stones[..., None], dirty)
    return clean, dirty


def _forest(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    size = (GROUND_PX, GROUND_PX)
    blades = np.maximum(
        noise(rng, size, (26, 3), 1.6), np.maximum(noise(rng, size, (5, 22), 1.6), noise(rng, size, (14, 6), 1.6))
    )
    grass = _mix((52, 62, 26), (136, 152, 74), 0.1 + 0.3 * blades)
    grass = np.where((blades > 2.4)[..., None], (176.0, 170.0, 112.0), grass)
    crumbs, humus = noise(rng, size, (6, 6), 1.5), noise(rng, size, (70, 70))
    soil = _mix((62, 46, 33), (132, 106, 80), 0.35 + 0.2 * crumbs + 0.12 * humus)
    needles = np.maximum(noise(rng, size, (30, 3), 2.0), noise(rng, size, (3, 30), 2.0))
    soil = np.where((needles > 2.0)[..., None], (148.0, 112.0, 70.0), soil)
    return grass, soil


def _bark(rng: np.random.Generator, style: str) -> np.ndarray:
    """Draw bark (along, around, 3): pine for ``asphalt``, birch for ``forest``."""
    size = (BARK_PX, BARK_PX)
    fine = noise(rng, size, (6, 4), 1.5)
    if style == "asphalt":
        plates, furrows = noise(rng, size, (60, 18), 1.6), noise(rng, size, (46, 10), 1.6)
        bark = _mix((150, 104, 72), (196, 150, 112), 0.45 + 0.3 * plates + 0.12 * fine)
        bark *= _mix((0, 0, 0), (1, 1, 1), 1.0 - 0.62 * np.clip(1.0 - 2.2 * np.abs(furrows), 0.0, 1.0))
        return bark
    slits, stains = noise(rng, size, (4, 34), 2.0), noise(rng, size, (50, 30))
    bark = _mix((176, 168, 156), (226, 222, 214), 0.5 + 0.25 * stains + 0.12 * fine)
    bark = np.where((slits > 1.55)[..., None], (58.0, 52.0, 48.0), bark)
    return np.where((noise(rng, size, (26, 40), 2.0) > 2.1)[..., None], (44.0, 40.0, 38.0), bark)


def _end_grain(rng: np.random.Generator) -> np.ndarray:
    """Draw an end (END_PX, END_PX, 3): growth rings, darker heart, drying cracks; the bark is its rim."""
    y, x = np.mgrid[0:END_PX, 0:END_PX] / (END_PX / 2) - 1.0
    wobble = noise(rng, (END_PX, END_PX), (60, 60))
    r, angle = np.hypot(x, y) + 0.012 * wobble, np.arctan2(y, x)
    rings = 0.5 + 0.5 * np.sin(r * 85.0)
    wood = _mix((206, 168, 116), (238, 210, 164), 0.7 - 0.35 * rings + 0.1 * wobble)
    wood *= (1.0 - 0.16 * np.clip(1.6 - 3.2 * r, 0.0, 1.0))[..., None]
    for crack in rng.uniform(-np.pi, np.pi, 3):
        wood *= (1.0 - 0.5 * ((np.abs(np.sin(angle - crack)) * r < 0.012) & (np.cos(angle - crack) > 0) & (r < 0.7)))[
            ..., None
        ]
    return np.where((r > 0.93)[..., None], (92.0, 66.0, 48.0), wood)


def _horizon(rng: np.random.Generator) -> np.ndarray:
    """Draw a horizon (elevation, azimuth, 3): a wall of trees under a sky."""
    rows, columns = HORIZON_PX
    up = np.linspace(0.0, 1.0, rows)[:, None]
    sky = _mix((214, 222, 230), (150, 182, 220), np.repeat(up, columns, 1) + 0.08 * noise(rng, HORIZON_PX, (20, 90)))
    crowns = 0.34 + 0.09 * noise(rng, (1, columns), (1, 320))[0] + 0.07 * noise(rng, (1, columns), (1, 18), 1.2)[0]
    leaves, trunks = noise(rng, HORIZON_PX, (12, 8), 1.2), noise(rng, (1, columns), (1, 8), 1.5)
    trees = _mix((28, 38, 24), (78, 96, 58), 0.4 + 0.28 * leaves + 0.25 * up)
    trees = np.where(((trunks > 1.5) & (up < 0.22))[..., None], (86.0, 72.0, 58.0), trees)
    return np.where((up < crowns[None, :])[..., None], trees, sky)


@dataclass(frozen=True, slots=True)
class Textures:
    """Textures of a style, all uint8.

    ``ground`` (MIP_LEVEL_COUNT, GROUND_PX, GROUND_PX, 6) holds two colours that ``patch`` (PATCH_PX, PATCH_PX) mixes;
    ``bark``, ``end`` (grain) and ``horizon`` are single pictures.
    """

    ground: np.ndarray
    patch: np.ndarray
    bark: np.ndarray
    end: np.ndarray
    horizon: np.ndarray


@cache
def _variant(style: str, variant: int) -> Textures:
    rng = np.random.default_rng([variant, len(style)])
    pair = _asphalt(rng) if style == "asphalt" else _forest(rng)
    cut = 0.9 if style == "asphalt" else 0.3
    patch = noise(rng, (PATCH_PX, PATCH_PX), (24, 24), 1.4)
    return Textures(
        np.ascontiguousarray(np.concatenate([_pyramid(p) for p in pair], axis=-1)),
        _bytes(255.0 / (1.0 + np.exp(-3.5 * (patch - cut)))),
        _bytes(_bark(rng, style)),
        _bytes(_end_grain(rng)),
        _bytes(_horizon(rng)),
    )


def textures(style: str, seed: int) -> Textures:
    """Return the surfaces of a style ("asphalt" with pine, "forest" with birch) in one of VARIANT_COUNT appearances."""
    return _variant(style, seed % VARIANT_COUNT)
