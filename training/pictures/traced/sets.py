"""The picture sets of the mask network: path-traced by the own tracer or by Blender, analytic, and by pybullet."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from runtime.errors import InputRefused
from training.pictures import meshed
from training.pictures.drawing import draw, labelled
from training.pictures.piles import MACHINES, Pile, chunk
from training.pictures.samples import Sample, sample, write
from training.pictures.traced.blender.matching import matched_depth
from training.pictures.traced.developing import developed
from training.pictures.traced.scenes import Format, describe, log_poses, view_of
from training.pictures.traced.tracer import Tracer, compiler, library

# -- Sets of samples: scenes drawn by the own tracer, and piles drawn by the analytic renderer, in parallel,
# resumable.


DRAWN_OF_A_FILE: Final = 8
FIRST_DRAWN: Final = 48  # scenes before them, while the analytic renderer is being compiled
SAMPLES: Final = (20, 20, 28, 48)  # of a pixel, drawn for each view


def finished(
    light: np.ndarray,
    depth_m: np.ndarray,
    numbers: np.ndarray,
    scene: Mapping[str, Any],
    view: Mapping[str, Any],
    matched_m: np.ndarray | None,
) -> Sample:
    """Make the sample of a rendered view, whichever renderer it came from."""
    camera_view = view_of(view)
    ids, logs = labelled(numbers.astype(np.int16), camera_view, log_poses(scene))
    rgb = developed(light, random.Random(view["seed"]))
    return sample(rgb, depth_m, ids, logs, camera_view.intrinsics, matched_m)


def traced_scene(scene: Mapping[str, Any], code: Any) -> list[Sample]:
    """Draw all views of a scene by the own tracer."""
    tracer = Tracer(code, scene)
    view_samples = []
    try:
        for view in scene["views"]:
            samples = view["samples"] or random.Random(view["seed"]).choice(SAMPLES)
            light, depth, numbers = tracer.draw(view, samples)
            matched = None
            if view["baseline_m"] and find_spec("cv2"):  # without OpenCV depth stays exact
                other, _, _ = tracer.draw(view, samples, view["baseline_m"], seed=1)
                matched = matched_depth(light, other, view["focal_px"], view["baseline_m"], view["seed"])
            view_samples.append(finished(light, depth, numbers, scene, view, matched))
    finally:
        tracer.close()
    return view_samples


def traced_file(folder: Path, number: int, piles: Sequence[Pile], form: Format, code: Any) -> Path:
    """Return the file of scene ``number``; draw it when it is missing."""
    file = folder / f"traced{number:05d}.npz"
    if not file.is_file():
        rng = random.Random(f"traced set {number}")
        scene = describe(rng.choice(list(piles)), number, form)
        write(file, traced_scene(json.loads(json.dumps(scene)), code), compressed=False)
    return file


def drawn_file(folder: Path, number: int, piles: Sequence[Pile], size_px: int) -> Path:
    """Return the file of DRAWN_OF_A_FILE pictures by the analytic renderer; draw it when it is missing."""
    file = folder / f"drawn{number:05d}.npz"
    if not file.is_file():
        rng, rows = random.Random(f"drawn set {number}"), []
        for k in range(DRAWN_OF_A_FILE):
            picture = draw(rng.choice(list(piles)), 1_000_000 + number * DRAWN_OF_A_FILE + k, size_px)
            rows.append(
                sample(picture.rgb, picture.depth_m, picture.ids, picture.logs, picture.intrinsics, picture.depth_m)
            )
        write(file, rows, compressed=False)
    return file


def produce(
    folder: Path,
    traced: Sequence[int],
    drawn: Sequence[int],
    chunks: Mapping[str, Sequence[int]],
    form: Format,
    workers: int,
    tell: Callable[[str], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> None:
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


# -- The picture sets of the mask network


OWN, BLENDER, ANY = "own", "blender", "any"
RENDERERS: Final = (ANY, OWN, BLENDER)
NUMBERS_OF_A_SEED: Final = 100_000
STEREO_SHARE: Final = 0.22
BLENDER_SAMPLES: Final = 10
WORKER: Final = "training.pictures.traced.blender.worker"


@dataclass(frozen=True, slots=True)
class SetPlan:
    """How much of which set: traced scenes of ``views`` pictures, analytic and pybullet pictures, their side [px],
    chunks of piles of each machine, and the seed."""

    scenes: int = 707
    drawn: int = 1080
    meshed: int = 250
    seed: int = 0
    size_px: int = 512
    views: int = 2
    chunks: int = 2

    def numbers(self, pictures: int, of_a_file: int = 1) -> range:
        """Return the numbers of the files that hold so many pictures."""
        first = self.seed * NUMBERS_OF_A_SEED
        return range(first, first + -(-pictures // of_a_file))


def renderer(asked: str, blender_python: Path | None = None) -> str:
    """Choose the path tracer to use: the one that is asked for, otherwise the first that is installed.

    Raises:
        InputRefused: it is not installed.
    """
    own = compiler() is not None
    blender = blender_python is not None or find_spec("bpy") is not None
    if asked in (OWN, ANY) and own:
        return OWN
    if asked in (BLENDER, ANY) and blender:
        return BLENDER
    needs = {
        OWN: "the own path tracer needs a compiler: install g++ (or CUDA's nvcc beside a GPU)",
        BLENDER: "Blender's path tracer needs its Python package: pip install bpy==4.2.0 in an environment of its own, "
        "then --blender-python ITS/bin/python",
        ANY: "no path tracer is installed: install g++ (or CUDA's nvcc beside a GPU), or Blender's Python package "
        "bpy==4.2.0 in an environment of its own, then --blender-python ITS/bin/python",
    }
    raise InputRefused("dataset.no-renderer", needs[asked])


def produce_sets(
    folder: Path,
    plan: SetPlan,
    which: str,
    workers: int,
    blender_python: Path | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Draw what is missing of the sets in ``folder``; what is there is not drawn again.

    Raises:
        InputRefused: the renderer is not installed or failed, or the piles cannot be read.
    """
    chosen = renderer(which, blender_python)
    folder.mkdir(parents=True, exist_ok=True)
    numbers = range(plan.chunks)
    piles = [pile for machine in MACHINES for n in numbers for pile in chunk(machine, n, tick=lambda: tell("pile"))]
    own = chosen == OWN
    if own and plan.scenes:
        try:
            library(folder / "compiled")  # here, so that an error is told once and not by each process
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputRefused("dataset.tracer-not-compiled", f"the path tracer was not compiled: {error}") from None
    form = Format(plan.size_px, 0 if own else BLENDER_SAMPLES, plan.views, STEREO_SHARE)
    drawn = plan.numbers(plan.drawn, DRAWN_OF_A_FILE)
    chunks = dict.fromkeys(MACHINES, numbers)
    produce(folder, plan.numbers(plan.scenes) if own else (), drawn, chunks, form, workers, tell)
    if not own:
        blender_files(folder, plan, piles, form, workers, blender_python or Path(sys.executable), tell)
    for k in plan.numbers(plan.meshed, meshed.PER_FILE):
        tell(meshed.one_file(folder, k, piles, plan.size_px).name)


def blender_files(
    folder: Path,
    plan: SetPlan,
    piles: list[Pile],
    form: Format,
    workers: int,
    python: Path,
    tell: Callable[[str], None],
) -> None:
    """Write the traced files, drawn by Blender in processes of their own: ``bpy`` is never imported here."""
    missing_numbers = [k for k in plan.numbers(plan.scenes) if not (folder / f"traced{k:05d}.npz").is_file()]
    work = folder / "blender"
    (work / "scenes").mkdir(parents=True, exist_ok=True)
    for k in missing_numbers:
        scene = describe(random.Random(f"traced set {k}").choice(piles), k, form)
        (work / "scenes" / f"{k:05d}.json").write_text(json.dumps(scene))
    root = Path(__file__).parents[3]
    threads = max(1, (os.cpu_count() or 1) // workers)
    environment = {**os.environ, "PYTHONPATH": str(root)}
    running = [
        subprocess.Popen([str(python), "-m", WORKER, str(work), str(threads), str(n), str(workers)], env=environment)
        for n in range(workers if missing_numbers else 0)
    ]
    try:
        failed = [process for process in running if process.wait()]
    finally:
        for process in running:
            process.terminate()
    if failed:
        raise InputRefused(
            "dataset.blender-failed", f"{len(failed)} of {workers} Blender processes failed; what they said is above"
        )
    for k in missing_numbers:
        write(folder / f"traced{k:05d}.npz", list(blender_views(work, k)), compressed=False)
        (work / "scenes" / f"{k:05d}.json").unlink()
        tell(f"traced{k:05d}.npz")
    shutil.rmtree(work)


def blender_views(work: Path, number: int) -> Iterator[Any]:
    """Yield the samples of a scene that Blender's worker drew in ``work``."""
    scene = json.loads((work / "scenes" / f"{number:05d}.json").read_text())
    for j, view in enumerate(scene["views"]):
        with np.load(work / "pictures" / f"{number:05d}-{j}.npz", allow_pickle=False) as archive:
            matched = archive["matched_m"] if "matched_m" in archive.files else None
            light = archive["light"].astype(np.float32)
            yield finished(light, archive["depth_m"], archive["ids"], scene, view, matched)
