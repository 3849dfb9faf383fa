"""Training pictures on disk in shards of SHARD pictures; the content of a shard depends only on its number.

A shard is a folder of numpy files that are memory-mapped: rgb uint8, depth_mm uint16 (0 unknown), ids uint8, logs
float32 (SHARD, MAX_LOGS, ROW; rows beyond a picture's logs are 0), lens float32 (fx, fy, cx, cy), height_mm int16 (over
the dominant plane of the whole picture, UNKNOWN_MM unknown).
"""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.perception.segmentation.ground_plane import height_over_plane
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused
from training.pictures.drawing import MAX_LOGS, draw
from training.pictures.labels import ID, ROW, Labelled
from training.pictures.piles import HELD_OUT, MACHINES, Pile, chunk

FORMAT_VERSION: Final = 3
SHARD: Final = 256
TRAINING_CHUNKS: Final = 12  # chunks of piles from which training pictures are drawn
MM: Final = 1000.0
UNKNOWN_MM, MAX_MM = -32768, 30000


@dataclass(frozen=True, slots=True)
class Shard:
    """Memory-mapped arrays of SHARD pictures."""

    rgb: np.ndarray
    depth_mm: np.ndarray
    ids: np.ndarray
    logs: np.ndarray
    lens: np.ndarray
    height_mm: np.ndarray


def shard(folder: Path, number: int, size_px: int = 304, tick: Callable[[], None] = lambda: None) -> Shard:
    """Open shard ``number`` of ``folder``; draw it when it is missing, with a call of ``tick`` after each picture.

    Shards from HELD_OUT on use piles that no training shard uses.

    Raises:
        InputRefused: the shard is damaged.
    """
    path = folder / f"logs-{size_px}-{number:07d}-e{FORMAT_VERSION}"
    if not path.is_dir():
        _write_shard(path, number, size_px, tick)
    try:
        arrays = [np.load(path / f"{name}.npy", mmap_mode="r") for name in Shard.__dataclass_fields__]
    except (OSError, EOFError, ValueError) as error:
        raise InputRefused(
            "dataset.bad-shard", f"{path} is not a shard of pictures ({error}); delete it to have it drawn again"
        ) from None
    if arrays[0].shape != (SHARD, size_px, size_px, 3):
        raise InputRefused(
            "dataset.bad-shard",
            f"{path} holds pictures of shape {arrays[0].shape}; delete it to have it drawn again",
        )
    return Shard(*arrays)


def drawn_pictures(number: int, size_px: int) -> Iterator[Labelled]:
    """Draw the pictures of a shard."""
    rng = random.Random(f"shard {number} {size_px}")
    piles = _piles(number, rng)
    for i in range(SHARD):
        yield draw(rng.choice(piles), number * SHARD + i, size_px)


def _piles(number: int, rng: random.Random) -> list[Pile]:
    """Return the piles of two chunks of each machine, so that a shard mixes many piles but reads few files."""
    if number >= HELD_OUT:
        return [pile for machine in MACHINES for pile in chunk(machine, HELD_OUT + number % 2)]
    return [pile for machine in MACHINES for k in range(2) for pile in chunk(machine, rng.randrange(TRAINING_CHUNKS))]


def _write_shard(path: Path, number: int, size_px: int, tick: Callable[[], None]) -> None:
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.mkdir(parents=True, exist_ok=True)
    square = (SHARD, size_px, size_px)
    arrays: dict[str, np.ndarray] = {
        "rgb": np.zeros((*square, 3), np.uint8),
        "depth_mm": np.zeros(square, np.uint16),
        "ids": np.zeros(square, np.uint8),
        "logs": np.zeros((SHARD, MAX_LOGS, ROW), np.float32),
        "lens": np.zeros((SHARD, 4), np.float32),
        "height_mm": np.zeros(square, np.int16),
    }
    for i, sample in enumerate(drawn_pictures(number, size_px)):
        pin = sample.intrinsics
        arrays["rgb"][i] = sample.rgb
        arrays["depth_mm"][i] = np.nan_to_num(np.minimum(sample.depth_m * MM, 65535.0), nan=0.0)
        arrays["ids"][i] = sample.ids
        arrays["logs"][i, : len(sample.logs)] = sample.logs
        arrays["height_mm"][i] = _to_millimetres(height_over_plane(sample.depth_m, pin))
        arrays["lens"][i] = (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px)
        tick()
    for name, array in arrays.items():
        np.save(part / f"{name}.npy", array)
    if path.is_dir():
        shutil.rmtree(part)
    else:
        part.rename(path)


def _to_millimetres(height_m: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(height_m), np.clip(height_m * MM, -MAX_MM, MAX_MM), UNKNOWN_MM).astype(np.int16)


def picture(shards: Callable[[int], Shard], index: int) -> Labelled:
    """Read picture ``index``, counted over all shards; ``shards`` returns a shard by its number."""
    own, i = shards(index // SHARD), index % SHARD
    depth = own.depth_mm[i].astype(np.float32) * np.float32(1.0 / MM)
    height = own.height_mm[i].astype(np.float32) * np.float32(1.0 / MM)
    depth[own.depth_mm[i] == 0] = np.nan
    height[own.height_mm[i] == UNKNOWN_MM] = np.nan
    logs = own.logs[i]
    h, w = depth.shape
    pin = Intrinsics(w, h, *(float(x) for x in own.lens[i]))
    return Labelled(own.rgb[i], depth, own.ids[i], logs[logs[:, ID] > 0], pin, height)


def pictures(folder: Path, size_px: int = 304) -> Callable[[int], Labelled]:
    """Make a function that returns the pictures of ``folder`` by number; a missing shard is drawn on first use."""
    shards = lru_cache(maxsize=None)(lambda number: shard(folder, number, size_px))
    return lambda index: picture(shards, index)
