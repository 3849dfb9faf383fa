"""From linear light to a camera's picture: exposure, highlights, gamma; drawn from a seed."""

from __future__ import annotations

import random

import numpy as np


def developed(light: np.ndarray, rng: random.Random) -> np.ndarray:
    """Develop the picture (H, W, 3) uint8 of linear light (H, W, 3), exposed as a camera would, not always well."""
    light = np.maximum(light.astype(np.float32), 0.0)
    grey = light.mean(axis=2)
    middle = float(np.exp(np.log(grey + 1e-5).mean()))
    high = float(np.percentile(grey, 96))
    # A camera exposes for the middle but spares the highlights.
    level = min(rng.uniform(0.13, 0.26) / max(middle, 1e-5), rng.uniform(0.9, 1.8) / max(high, 1e-5))
    level *= 2.0 ** rng.gauss(0.0, 0.35)
    balance = np.array([2.0 ** rng.gauss(0.0, 0.12), 1.0, 2.0 ** rng.gauss(0.0, 0.15)], np.float32)
    x = level * light * balance
    if rng.random() < 0.6:  # a film curve with a soft shoulder, otherwise highlights clip
        x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14) * rng.uniform(0.95, 1.1)
    x = np.clip(x, 0.0, 1.0) ** (1.0 / rng.uniform(1.9, 2.4))
    mean = x.mean(axis=2, keepdims=True)
    x = mean + rng.uniform(0.75, 1.25) * (x - mean)
    return np.asarray(np.clip(255.0 * x + 0.5, 0.0, 255.0), np.uint8)
