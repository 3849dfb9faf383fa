"""Draws scenes: ``python -m training.pictures.traced.blender.worker FOLDER THREADS NUMBER COUNT``.

Reads FOLDER/scenes/*.json, of which it takes every COUNTth from NUMBER, and writes FOLDER/pictures/NAME-VIEW.npz, each
whole or not at all; what is there is not drawn again.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from training.pictures.traced.blender import camera, stage
from training.pictures.traced.blender.matching import matched_depth


def main(folder: Path, threads: int, number: int, count: int) -> None:
    """Draw what is missing."""
    target = folder / "pictures"
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for file in sorted((folder / "scenes").glob("*.json"))[number::count]:
            scene = json.loads(file.read_text())
            missing = [k for k in range(len(scene["views"])) if not (target / f"{file.stem}-{k}.npz").is_file()]
            if not missing:
                continue
            began = time.monotonic()
            stage.build(scene)
            print(f"{file.stem}: built in {time.monotonic() - began:.1f} s", flush=True)
            camera.prepare(threads)
            for k in missing:
                began = time.monotonic()
                _keep(target / f"{file.stem}-{k}.npz", draw(scene["views"][k], Path(scratch)))
                print(f"{file.stem}-{k}: {time.monotonic() - began:.1f} s", flush=True)


def draw(view: Mapping[str, Any], scratch: Path) -> dict[str, np.ndarray]:
    """Draw the arrays of one picture: light float16 (linear), depth_m, ids, and matched_m with a second eye."""
    camera.light(view["light"])
    camera.aim(view)
    light = camera.shoot(scratch, view["samples"], view["seed"])
    depth, ids = camera.measure(scratch)
    arrays = {"light": np.clip(light, 0.0, 6e4).astype(np.float16), "depth_m": depth.astype(np.float32), "ids": ids}
    if view["baseline_m"]:
        camera.aim(view, view["baseline_m"])
        other = camera.shoot(scratch, view["samples"], view["seed"] + 1)
        arrays["matched_m"] = matched_depth(light, other, view["focal_px"], view["baseline_m"], view["seed"])
    return arrays


def _keep(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    draft = file.with_suffix(f".{os.getpid()}.part")
    with draft.open("wb") as out:
        np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    draft.replace(file)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
