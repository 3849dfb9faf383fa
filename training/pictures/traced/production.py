"""Sets of samples: scenes drawn by the own tracer, and piles drawn by the analytic renderer, in parallel, resumable."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from training.pictures.drawing import draw, labelled
from training.pictures.piles import Pile, chunk
from training.pictures.samples import Sample, sample, write
from training.pictures.traced.blender.matching import matched_depth
from training.pictures.traced.developing import developed
from training.pictures.traced.scenes import Assets, Format, describe, log_poses, view_of
from training.pictures.traced.tracer import Tracer, library

DRAWN_OF_A_FILE: Final = 8
FIRST_DRAWN: Final = 48  # scenes before them, while the analytic renderer is being compiled
SAMPLES: Final = (20, 20, 28, 48)  # of a pixel, drawn for each view


def finished(
    light: np.ndarray, depth_m: np.ndarray, numbers: np.ndarray, scene: Mapping[str, Any], view: Mapping[str, Any],
    matched_m: np.ndarray | None,
) -> Sample:  # fmt: skip
    """The sample of a rendered view, whichever renderer it came from."""
    seen = view_of(view)
    ids, logs = labelled(numbers.astype(np.int16), seen, log_poses(scene))
    rgb = developed(light, random.Random(view["seed"]))
    return sample(rgb, depth_m, ids, logs, seen.intrinsics, matched_m)


def traced_scene(scene: Mapping[str, Any], code: Any) -> list[Sample]:
    """All views of a scene by the own tracer."""
    tracer = Tracer(code, scene)
    found = []
    try:
        for view in scene["views"]:
            samples = view["samples"] or random.Random(view["seed"]).choice(SAMPLES)
            light, depth, numbers = tracer.draw(view, samples)
            matched = None
            if view["baseline_m"] and find_spec("cv2"):  # without OpenCV depth stays exact
                other, _, _ = tracer.draw(view, samples, view["baseline_m"], seed=1)
                matched = matched_depth(light, other, view["focal_px"], view["baseline_m"], view["seed"])
            found.append(finished(light, depth, numbers, scene, view, matched))
    finally:
        tracer.close()
    return found


def traced_file(folder: Path, number: int, piles: Sequence[Pile], form: Format, code: Any) -> Path:
    """The file of scene ``number``; drawn when it is missing."""
    file = folder / f"traced{number:05d}.npz"
    if not file.is_file():
        rng = random.Random(f"traced set {number}")
        scene = describe(rng.choice(list(piles)), number, Assets(), form)
        write(file, traced_scene(json.loads(json.dumps(scene)), code), compressed=False)
    return file


def drawn_file(folder: Path, number: int, piles: Sequence[Pile], size_px: int) -> Path:
    """The file of DRAWN_OF_A_FILE pictures by the analytic renderer; drawn when it is missing."""
    file = folder / f"drawn{number:05d}.npz"
    if not file.is_file():
        rng, rows = random.Random(f"drawn set {number}"), []
        for k in range(DRAWN_OF_A_FILE):
            one = draw(rng.choice(list(piles)), 1_000_000 + number * DRAWN_OF_A_FILE + k, size_px)
            rows.append(sample(one.rgb, one.depth_m, one.ids, one.logs, one.intrinsics, one.depth_m))
        write(file, rows, compressed=False)
    return file


def produce(
    folder: Path, traced: Sequence[int], drawn: Sequence[int], chunks: Mapping[str, Sequence[int]], form: Format,
    workers: int, tell: Callable[[str], None] = lambda _: None, stop: Callable[[], bool] = lambda: False,
) -> None:  # fmt: skip
    """Draw the files of these numbers in ``workers`` processes; ``stop`` ends it early."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [("traced", n) for n in traced]
    step = max(1, len(jobs) // max(1, len(drawn)))
    for i, n in enumerate(drawn):  # among each other, so that an early end leaves some of both
        jobs.insert(min(len(jobs), FIRST_DRAWN + i * (step + 1)), ("drawn", n))
    context = get_context("spawn")
    with context.Pool(workers, _begin, (folder, dict(chunks), form)) as pool:
        for name in pool.imap_unordered(_one, jobs):
            tell(name)
            if stop():
                pool.terminate()
                return


_STATE: dict[str, Any] = {}


def _begin(folder: Path, chunks: Mapping[str, Sequence[int]], form: Format) -> None:
    piles = [pile for machine, numbers in chunks.items() for n in numbers for pile in chunk(machine, n)]
    _STATE.update(folder=folder, piles=piles, form=form, code=library(folder / "compiled"))


def _one(job: tuple[str, int]) -> str:
    kind, number = job
    if kind == "traced":
        return traced_file(_STATE["folder"], number, _STATE["piles"], _STATE["form"], _STATE["code"]).name
    return drawn_file(_STATE["folder"], number, _STATE["piles"], _STATE["form"].size_px).name
