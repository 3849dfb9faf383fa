"""The mask network's pictures: sets on disk and photographs, joined in the shares of the card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from PIL import Image

from machine.geometry.optics import Intrinsics, pinhole
from runtime.errors import InputRefused
from training.detection.masks.bank import WOOD, Bank, bank_of, joined
from training.pictures.labels import ROW
from training.pictures.samples import Sample, read, sample

SHARES: Final = {"traced": 0.55, "drawn": 0.2, "meshed": 0.2, "photographs": 0.05}
"""How often a picture of a set is drawn; without a set the others share its part."""
BARE_WOOD_SHARE, BARE_WEIGHT = 0.005, 1.0 / 3.0  # of a picture's pixels with hardly any wood; how often it is drawn
PHOTO_VIEW_RAD: Final = 1.4
IGNORED: Final = 255


def mixed(
    folder: Path, photographs: Sequence[tuple[np.ndarray, np.ndarray]] = (), shares: Mapping[str, float] = SHARES
) -> tuple[Bank, dict[str, int]]:
    """The pictures of ``folder`` with photographs (rgb, wood), and how many there are of each set.

    Raises:
        InputRefused: there are no traced pictures, or sizes differ.
    """
    banks: dict[str, Bank] = {}
    for name in ("traced", "drawn", "meshed"):
        rows = [read(file) for file in sorted(folder.glob(f"{name}*.npz"))]
        if rows:
            if len({one["ids"].shape[1:] for one in rows}) > 1:
                raise InputRefused("dataset.sizes-differ", f"{folder}: pictures of {name}*.npz differ in size")
            banks[name] = bank_of({key: np.concatenate([one[key] for one in rows]) for key in rows[0]})
    if "traced" not in banks:
        raise InputRefused(
            "dataset.no-traced", f"{folder} holds no traced*.npz; make them: timberhand train traced-pictures {folder}"
        )
    side = banks["traced"].ids.shape[-1]
    if photographs:
        shots = [photograph(rgb, wood, side) for rgb, wood in photographs]
        banks["photographs"] = bank_of(
            {key: np.stack([getattr(s, key) for s in shots]) for key in Sample.__dataclass_fields__}
        )
    if any(one.ids.shape[-1] != side for one in banks.values()):
        raise InputRefused("dataset.sizes-differ", f"{folder}: the sets have pictures of different sizes")
    for name, one in banks.items():
        weight = torch.where(wood_share(one) < BARE_WOOD_SHARE, BARE_WEIGHT, 1.0)
        one.share.copy_(shares[name] * weight / weight.sum())
    return joined(list(banks.values())), {name: len(one) for name, one in banks.items()}


def wood_share(bank: Bank) -> torch.Tensor:
    """The share (N,) of each picture that is wood."""
    return torch.stack([((ids > 0) & (ids != IGNORED)).float().mean() for ids in bank.ids])


def photograph(rgb: np.ndarray, wood: np.ndarray, side_px: int) -> Sample:
    """A photograph without depth, whose logs are not told apart, in a square that is ignored where it ends."""
    factor = side_px / max(rgb.shape[:2])
    height, width = (min(side_px, max(1, round(factor * n))) for n in rgb.shape[:2])
    picture = np.zeros((side_px, side_px, 3), np.uint8)
    ids = np.full((side_px, side_px), IGNORED, np.uint8)
    picture[:height, :width] = np.asarray(Image.fromarray(rgb).resize((width, height)))
    shown = np.asarray(Image.fromarray(wood.astype(np.uint8)).resize((width, height), Image.Resampling.NEAREST)) > 0
    ids[:height, :width] = np.where(shown, WOOD, 0)
    seen = pinhole(width, height, PHOTO_VIEW_RAD)
    lens = Intrinsics(side_px, side_px, seen.fx_px, seen.fy_px, seen.cx_px, seen.cy_px)
    unknown = np.full((side_px, side_px), np.nan, np.float32)
    return sample(picture, unknown, ids, np.zeros((0, ROW), np.float32), lens)
