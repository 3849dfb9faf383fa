"""Training pictures by pybullet's renderer: oval, bumpy logs in plain colours, with the views of the drawn pictures."""

from __future__ import annotations

import math
import random
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim.camera.ground_cover import Density, GroundCover
from sim.camera.mesh_renderer import MeshRenderer
from sim.scenes.settled_logs import varied_stereo_noise
from training.pictures import drawing
from training.pictures.piles import MACHINES, Pile, chunk, ground_of, profile_of
from training.pictures.samples import Sample, sample, write

COVER_M = 2.5
PER_FILE = 10


def meshed(pile: Pile, seed: int, size_px: int) -> Sample:
    """Draw a picture of ``pile`` from ``seed``; depth exact and as the machine's camera senses it."""
    rng = random.Random(f"meshed {pile.machine} {pile.number} {seed}")
    scene, keep = drawing.bare_scene(pile, rng, held=False)
    camera = rng.choice(list(profile_of(pile.machine).cameras))
    view = drawing.random_view(pile, keep, camera, rng, size_px, scene.ground)
    boxes = drawing.steel_around(pile, keep, view, rng, held=False)
    target = np.asarray(rng.choice(keep).position_m)
    density = Density(0.12 * rng.random(), 0.06 * rng.random())
    litter = GroundCover(ground_of(pile), density, rng.getrandbits(10)).around(target[0], target[1], COVER_M)
    scene = replace(scene, boxes=boxes, rods=scene.rods + litter)
    renderer = MeshRenderer(scene, rng.uniform(0.001, 0.007), rng.uniform(0.0, 0.14), rng.getrandbits(16))
    try:
        exact = renderer.render(view)
    finally:
        renderer.close()
    noise = varied_stereo_noise(
        profile_of(pile.machine),
        camera,
        rng.getrandbits(20),
        sigma=math.exp(rng.uniform(-1.0, 0.4)),
        edges=(rng.uniform(0.3, 1.1), rng.uniform(0.3, 1.1)),
        holes=math.exp(rng.uniform(-1.0, 2.0)),
        plain_holes=rng.uniform(0.01, 0.25),
        correlation_px=float(rng.choice((6, 10, 14))),
    )
    ids, rows = drawing.labelled(exact.mask, view, keep)
    return sample(exact.rgb, exact.depth_m, ids, rows, view.intrinsics, noise.apply(exact, view.intrinsics, 0))


def main(folder: Path, files: int, number: int, count: int, size_px: int, chunks: int) -> None:
    """Draw every ``count``th file from ``number``; what is there is not drawn again."""
    piles = [pile for machine in MACHINES for k in range(chunks) for pile in chunk(machine, k)]
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(number, files, count):
        one_file(folder, k, piles, size_px)


def one_file(folder: Path, number: int, piles: list[Pile], size_px: int) -> Path:
    """Return the file of PER_FILE pictures of this number; draw it when it is missing."""
    file = folder / f"meshed{number:05d}.npz"
    if not file.is_file():
        rng = random.Random(f"meshed set {number}")
        write(file, [meshed(rng.choice(piles), PER_FILE * number + j, size_px) for j in range(PER_FILE)])
    return file


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(x) for x in sys.argv[2:7]))
