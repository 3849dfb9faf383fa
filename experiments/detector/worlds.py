"""Pictures to judge by: piles nobody trained on, drawn by the other renderer as oval, bumpy logs on grassy ground.

Nothing is shared with the training pictures but the machines' cameras: other piles, other grounds, pybullet's renderer
with its own light and colours, meshes instead of round cones.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from machine.optics import Intrinsics, intrinsics
from sim.camera.geometry import View, look_at
from sim.camera.ground_cover import Clutter, Density
from sim.camera.mesh_renderer import TinyRenderer
from sim.camera.scene import Boxes, SceneBuilder
from sim.scenes.settled_logs import stereo
from training.pictures.piles import HELD_OUT, Pile, chunk, ground_of, profile_of
from training.pictures.props import Steel

SIZE_PX: Final = 608
LEAST_PX: Final = 100  # of a log: of one that shows less nobody knows that it is there, it does not count
CHUNK_OF_TESTS: Final = HELD_OUT + 1
LITTER: Final = Density(0.12, 0.06)
LITTER_M: Final = 2.5  # grass and branches lie on the tiles that come so near to what the camera looks at


@dataclass(frozen=True, slots=True)
class TestPicture:
    """rgb (H, W, 3) uint8, depth_m (H, W) float32 as stereo gives it, mask (H, W) int16 with the logs' instances 1, 2,
    ..., range [m] from the camera to what it looks at."""

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray
    intrinsics: Intrinsics
    machine: str
    kind: str
    camera: str
    range_m: float

    def truths(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Mask (H, W) of every log that shows, and which (M,) of them show too little to count."""
        sizes = np.bincount(np.maximum(self.mask, 0).ravel())[:1000]
        own = [i for i in range(1, len(sizes)) if sizes[i]]
        return [self.mask == i for i in own], np.array([sizes[i] < LEAST_PX for i in own], bool)


def picture(machine: str, number: int, seed: int, truth: str = "nominal") -> TestPicture:
    """Test picture ``number`` of a machine; ``seed`` draws everything but the pile, ``truth`` says how depth errs."""
    piles = chunk(machine, CHUNK_OF_TESTS)
    pile = piles[number % len(piles)]
    rng = random.Random(f"test picture {machine} {number} {seed}")
    camera = rng.choice(sorted(profile_of(machine).cameras))
    view, target = _view(pile, camera, rng)
    ground = ground_of(pile)
    b = SceneBuilder(ground)
    for log in pile.logs:
        b.log(log)
    bare = b.build()
    litter = Clutter(ground, LITTER, rng.getrandbits(16)).around(target[0], target[1], LITTER_M)
    scene = replace(bare, rods=bare.rods + litter, boxes=_steel(pile, target, rng))
    renderer = TinyRenderer(scene, rng.uniform(0.002, 0.006), rng.uniform(0.03, 0.12), rng.getrandbits(16))
    try:
        exact = renderer.render(view)
    finally:
        renderer.close()
    depth = stereo(profile_of(machine), camera, f"{number} {seed}", truth, seed).apply(exact, view.intrinsics, 0)
    away = float(np.linalg.norm(view.position_m - target))
    return TestPicture(exact.rgb, depth, exact.mask, view.intrinsics, machine, pile.kind, camera, away)


def _view(pile: Pile, camera: str, rng: random.Random) -> tuple[View, np.ndarray]:
    """From where the machine's camera would look, over the bonnet, from the stick or straight down; and at what."""
    pin = intrinsics(profile_of(pile.machine).cameras[camera]).letterbox(SIZE_PX).inner
    mark = pile.logs[rng.randrange(len(pile.logs))].position_m
    target = np.array([mark[0] + rng.gauss(0.0, 0.3), mark[1] + rng.gauss(0.0, 0.3), mark[2]])
    azimuth = rng.uniform(-math.pi, math.pi)
    if camera == "front":
        flat = rng.uniform(3.0, 8.5)
        height = 2.4 + rng.gauss(0.0, 0.1)
    elif camera == "d435":
        flat, height = rng.uniform(0.05, 0.6), rng.uniform(2.6, 3.4)
    else:
        reach, elevation = rng.uniform(2.5, 5.5), math.radians(rng.uniform(25.0, 75.0))
        flat, height = reach * math.cos(elevation), reach * math.sin(elevation)
    eye = target + np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), height])
    eye[2] = max(eye[2], ground_of(pile).height(eye[0], eye[1]) + 1.2)
    return look_at(eye, target, pin), target


def _steel(pile: Pile, target: np.ndarray, rng: random.Random) -> Boxes:
    """The bunk of logs that lie in it; in a quarter of the pictures a grapple above the logs."""
    steel, profile = Steel(rng), profile_of(pile.machine)
    if pile.kind == "bunk":
        steel.bunk(profile, np.zeros(3), 0.0)
    if rng.random() < 0.25:
        above = target + np.array([rng.gauss(0.0, 0.5), rng.gauss(0.0, 0.5), rng.uniform(1.0, 2.0)])
        steel.grapple(profile, above, rng.uniform(-math.pi, math.pi), rng.random())
    return steel.build()
