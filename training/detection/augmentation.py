"""Random changes of training pictures: window, scale, mirror, colours, failed sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from training.pictures.labels import CENTRE_U, CENTRE_V, Labelled, cropped, enlarged, mirrored

ENLARGED_SHARE: Final = 0.35  # of windows that are shown at twice the size, as the segmenter shows small logs
NO_DEPTH_SHARE, NO_COLOUR_SHARE = 0.1, 0.03  # of pictures in which a sensor fails


def augmented(sample: Labelled, rng: np.random.Generator, size_px: int) -> Labelled:
    """Cut a square window of ``size_px`` around one of the picture's logs, possibly mirrored, in other colours,
    sometimes without depth or colour."""
    if rng.random() < ENLARGED_SHARE:
        sample = enlarged(cropped(sample, *_window(sample, rng, size_px // 2), size_px // 2))
    else:
        sample = cropped(sample, *_window(sample, rng, size_px), size_px)
    if rng.random() < 0.5:
        sample = mirrored(sample)
    depth, height = sample.depth_m, sample.height_m
    if rng.random() < NO_DEPTH_SHARE:
        depth = np.full_like(depth, np.nan)
        height = None if height is None else depth
    rgb = np.zeros_like(sample.rgb) if rng.random() < NO_COLOUR_SHARE else recoloured(sample.rgb, rng)
    return replace(sample, rgb=rgb, depth_m=depth, height_m=height)


def _window(sample: Labelled, rng: np.random.Generator, size_px: int) -> tuple[int, int]:
    """Draw left and top: anywhere in a tenth of the pictures, otherwise with the centre of some log well inside."""
    room = np.array(sample.ids.shape[::-1]) - size_px
    if not len(sample.logs) or rng.random() < 0.1:
        left, top = rng.integers(0, room + 1)
    else:
        centre = sample.logs[rng.integers(len(sample.logs)), [CENTRE_U, CENTRE_V]]
        left, top = np.clip(centre - size_px * rng.uniform(0.25, 0.75, 2), 0, room).astype(int)
    return int(left), int(top)


def recoloured(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Recolour the picture (H, W, 3) float32 as of another camera: gains, hue, saturation, contrast, gamma, grain."""
    mix = np.eye(3, dtype=np.float32)
    if rng.random() < 0.3:
        turn = rng.uniform(-0.6, 0.6) if rng.random() < 0.7 else rng.uniform(-np.pi, np.pi)
        c, s, third = np.cos(turn), np.sin(turn), 1.0 / 3.0
        k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]], np.float32) * np.sqrt(third) * s
        mix = (c * np.eye(3) + (1.0 - c) * third + k).astype(np.float32)  # about the grey axis
    saturation = 0.0 if rng.random() < 0.1 else rng.uniform(0.5, 1.4)
    mix = (saturation * np.eye(3) + (1.0 - saturation) / 3.0).astype(np.float32) @ mix
    mix = mix * rng.uniform(0.8, 1.2, (3, 1)).astype(np.float32)
    gain, lift = rng.uniform(0.6, 1.4), rng.uniform(-30.0, 30.0)
    gamma = np.exp(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else 1.0
    table = np.clip(255.0 * gain * np.linspace(0.0, 1.0, 256) ** gamma + lift, 0.0, 255.0).astype(np.float32)
    x = table[rgb.reshape(-1, 3)] @ mix.T
    if rng.random() < 0.5:
        grain = rng.standard_normal(4096, np.float32) * rng.uniform(1.0, 12.0)
        x += np.resize(np.roll(grain, rng.integers(4096)), x.shape[0] * 3).reshape(x.shape)
    return np.asarray(np.clip(x, 0.0, 255.0, out=x).reshape(rgb.shape))
