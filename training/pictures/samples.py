"""Pictures as the mask network's training keeps them: whole numbers, one row for each picture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.perception.segmentation.ground_plane import dominant_plane
from machine.geometry.optics import Intrinsics
from training.pictures.labels import ROW

MAX_LOGS: Final = 16
MM: Final = 1000.0
FARTHEST_MM: Final = 32000


@dataclass(frozen=True, slots=True)
class Sample:
    """A picture: rgb (S, S, 3) uint8; depth_mm (S, S) int16, 0 unknown, exact or the best there is; sensed_mm as a
    sensor saw it, and whether it did; ids (S, S) uint8; plane (3,), lens (4,), logs (MAX_LOGS, ROW) float32."""

    rgb: np.ndarray
    depth_mm: np.ndarray
    sensed_mm: np.ndarray
    sensed: np.ndarray
    ids: np.ndarray
    plane: np.ndarray
    lens: np.ndarray
    logs: np.ndarray


def sample(
    rgb: np.ndarray,
    depth_m: np.ndarray,
    ids: np.ndarray,
    logs: np.ndarray,
    pin: Intrinsics,
    sensed_m: np.ndarray | None = None,
) -> Sample:
    """Make a sample from a picture's parts; depth NaN where unknown, everywhere in a photograph."""
    h, w = depth_m.shape
    u = ((np.arange(w) - pin.cx_px) / pin.fx_px).astype(np.float32)
    v = ((np.arange(h) - pin.cy_px) / pin.fy_px).astype(np.float32)
    plane = dominant_plane(depth_m, u, v)
    rows = np.zeros((MAX_LOGS, ROW), np.float32)
    rows[: len(logs)] = logs
    return Sample(
        np.ascontiguousarray(rgb),
        in_mm(depth_m),
        in_mm(depth_m if sensed_m is None else sensed_m),
        np.array(sensed_m is not None),
        ids.astype(np.uint8),
        plane.astype(np.float32),
        np.array([pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px], np.float32),
        rows,
    )


def in_mm(depth_m: np.ndarray) -> np.ndarray:
    """Convert depth to int16 [mm], 0 unknown or too far."""
    mm = np.nan_to_num(depth_m.astype(np.float32) * MM, nan=0.0, posinf=0.0)
    return np.where(mm < FARTHEST_MM, mm, 0.0).astype(np.int16)


def write(file: Path, rows: Sequence[Sample], compressed: bool = True) -> None:
    """Write samples of one size, whole or not at all."""
    arrays = {f.name: np.stack([getattr(row, f.name) for row in rows]) for f in fields(Sample)}
    draft = file.with_suffix(f".{os.getpid()}.part")
    with draft.open("wb") as out:
        (np.savez_compressed if compressed else np.savez)(out, **arrays)  # type: ignore[arg-type]
    draft.replace(file)


def read(file: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file, by the names of ``Sample``."""
    with np.load(file, allow_pickle=False) as archive:
        return {f.name: archive[f.name] for f in fields(Sample)}
