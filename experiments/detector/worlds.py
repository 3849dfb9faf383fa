"""Test pictures: piles that were not used for training, drawn by another renderer as oval, bumpy logs on grassy ground.

Nothing is shared with the training pictures but the machines' cameras: other piles, other grounds, pybullet's renderer
with its own light and colours, meshes instead of round cones.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from machine.geometry.optics import Intrinsics, intrinsics
from sim.camera.geometry import View, look_at
from sim.camera.ground_cover import Density, GroundCover
from sim.camera.mesh_renderer import MeshRenderer
from sim.camera.scene import Boxes, SceneBuilder
from sim.scenes.settled_logs import stereo_noise
from training.pictures.piles import HELD_OUT, Pile, chunk, ground_of, profile_of
from training.pictures.props import Steel

SIZE_PX: Final = 608
MIN_LOG_PX: Final = 100  # a log with fewer pixels does not count
CHUNK_OF_TESTS: Final = HELD_OUT + 1
LITTER: Final = Density(0.12, 0.06)
LITTER_M: Final = 2.5  # grass and branches lie on the tiles within this distance of the camera's target


@dataclass(frozen=True, slots=True)
class TestPicture:
    """A test picture.

    rgb (H, W, 3) uint8, depth_m (H, W) float32 with stereo errors, mask (H, W) int16 with the instances 1, 2, ... of
    the logs, range [m] from the camera to its target.
    """

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray
    intrinsics: Intrinsics
    machine: str
    kind: str
    camera: str
    range_m: float

    def truths(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the masks (H, W) of all visible logs, and which (M,) of them have too few pixels to count."""
        sizes = np.bincount(np.maximum(self.mask, 0).ravel())[:1000]
        own = [i for i in range(1, len(sizes)) if sizes[i]]
        return [self.mask == i for i in own], np.array([sizes[i] < MIN_LOG_PX for i in own], bool)


def picture(machine: str, number: int, seed: int, truth: str = "nominal") -> TestPicture:
    """Make test picture ``number`` of a machine; ``seed`` draws all but the pile, ``truth`` gives depth errors."""
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
    litter = GroundCover(ground, LITTER, rng.getrandbits(16)).around(target[0], target[1], LITTER_M)
    scene = replace(bare, rods=bare.rods + litter, boxes=_steel(pile, target, rng))
    renderer = MeshRenderer(scene, rng.uniform(0.002, 0.006), rng.uniform(0.03, 0.12), rng.getrandbits(16))
    try:
        exact = renderer.render(view)
    finally:
        renderer.close()
    depth = stereo_noise(profile_of(machine), camera, f"{number} {seed}", truth, seed).apply(exact, view.intrinsics, 0)
    away = float(np.linalg.norm(view.position_m - target))
    return TestPicture(exact.rgb, depth, exact.mask, view.intrinsics, machine, pile.kind, camera, away)


def _view(pile: Pile, camera: str, rng: random.Random) -> tuple[View, np.ndarray]:
    """Choose the view of the machine's camera (over the bonnet, from the stick or straight down), target (3,) [m]."""
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
    return look_at(eye.tolist(), target.tolist(), pin), target


def _steel(pile: Pile, target: np.ndarray, rng: random.Random) -> Boxes:
    """Build the bunk around logs that lie in it; in a quarter of the pictures a grapple above the logs."""
    steel, profile = Steel(rng), profile_of(pile.machine)
    if pile.kind == "bunk":
        steel.bunk(profile, np.zeros(3), 0.0)
    if rng.random() < 0.25:
        above = target + np.array([rng.gauss(0.0, 0.5), rng.gauss(0.0, 0.5), rng.uniform(1.0, 2.0)])
        steel.grapple(profile, above, rng.uniform(-math.pi, math.pi), rng.random())
    return steel.build()
