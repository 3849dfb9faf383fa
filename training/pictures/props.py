"""Steel around the logs of a training picture: a grapple above them, a boom across them, a bunk, crates."""

from __future__ import annotations

import math
import random
from functools import cache
from typing import Final

import numpy as np

from machine.geometry.optics import rpy_matrix
from machine.profile import Profile
from sim.camera.geometry import quaternion_matrix
from sim.camera.scene import BUNK, CARRIER, CRANE, Boxes, LogPose
from sim.geometry import Shape
from sim.mechanics.grapple import PIVOT_Y_M, grapple_shapes, jaw_geometry
from sim.wood.bunk import bunk_shapes
from training.pictures.piles import profile_of

COLOURS: Final = ((0.95, 0.72, 0.1), (0.45, 0.47, 0.5), (0.2, 0.2, 0.22), (0.8, 0.2, 0.15), (0.2, 0.45, 0.25))


class Steel:
    """Collects boxes at poses; ``build`` packs them for the renderer."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, tuple[float, ...], int]] = []

    def box(
        self, size_m: tuple[float, ...], at_m: np.ndarray, axes: np.ndarray, colour: tuple[float, ...], instance: int
    ) -> None:
        """Add a box: full edge lengths, middle (3,), axes as columns (3, 3)."""
        self._rows.append((np.asarray(at_m, float), axes, np.asarray(size_m, float) / 2, colour, instance))

    def shape(self, shape: Shape, at_m: np.ndarray, axes: np.ndarray, instance: int) -> None:
        """Add a box of the plant; the frame of its link is at ``at_m`` with ``axes``."""
        middle = at_m + axes @ np.asarray(shape.position_m)
        self.box(shape.size_m, middle, axes @ quaternion_matrix(shape.quaternion), shape.colour, instance)

    def grapple(self, profile: Profile, at_m: np.ndarray, yaw_rad: float, opening: float) -> None:
        """Add a grapple with its rotator at ``at_m``; ``opening`` is 0 closed to 1 open."""
        jaws, k = jaw_geometry(profile), profile.kinematics
        hang = rpy_matrix((self._rng.gauss(0.0, 0.05), self._rng.gauss(0.0, 0.05), yaw_rad))
        angle = (1.0 - opening) * jaws.closed_rad
        frames = {"rotator": (np.zeros(3), np.eye(3))}
        frames["fork"] = (np.array([0.0, 0.0, k.fork_to_rotator_m]), np.eye(3))
        frames["hanger"] = (np.array([0.0, 0.0, k.fork_to_rotator_m + k.hanger_to_fork_m]), np.eye(3))
        for side, link in ((-1, "tong_left"), (1, "tong_right")):
            pivot = np.array([side * jaws.pivot_x_m, PIVOT_Y_M, -jaws.pivot_z_m])
            frames[link] = (pivot, rpy_matrix((0.0, side * angle, 0.0)))
        for shape in _grapple(profile.name):
            at, turn = frames[shape.link]
            self.shape(shape, at_m + hang @ at, hang @ turn, CRANE)

    def holding(self, profile: Profile, log: LogPose) -> None:
        """Add a grapple that is closed around the middle of a log."""
        rng, jaws = self._rng, jaw_geometry(profile)
        opening, along = rng.uniform(0.12, 0.35), quaternion_matrix(log.quaternion)[:, 2]
        turn = (1.0 - opening) * jaws.closed_rad
        tip_m = jaws.pivot_z_m + jaws.out_m * math.sin(turn) + jaws.down_m * math.cos(turn)
        up_m = tip_m - log.diameter_m / 2 - rng.uniform(0.0, 0.08)
        middle = np.asarray(log.position_m) + rng.gauss(0.0, 0.1) * along
        yaw = math.atan2(along[1], along[0]) - math.pi / 2
        self.grapple(profile, middle + np.array([0.0, 0.0, up_m]), yaw, opening)

    def boom(self, middle_m: np.ndarray) -> None:
        """Add a beam of a crane through ``middle_m`` in a random direction."""
        rng = self._rng
        axes = rpy_matrix((rng.uniform(-0.3, 0.3), rng.uniform(-1.0, 1.0), rng.uniform(-math.pi, math.pi)))
        size = (rng.uniform(1.5, 4.0), rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.3))
        self.box(size, middle_m, axes, rng.choice(COLOURS), CRANE)

    def bunk(self, profile: Profile, at_m: np.ndarray, yaw_rad: float) -> None:
        """Add a bunk; the frame of its link is at ``at_m``."""
        axes = rpy_matrix((0.0, 0.0, yaw_rad))
        for shape in bunk_shapes(profile):
            self.shape(shape, at_m, axes, BUNK)

    def block(self, at_m: np.ndarray) -> None:
        """Add a part of a carrier, a crate or a stone: a box on the ground."""
        rng = self._rng
        size = tuple(rng.uniform(0.2, 1.5) for _ in range(3))
        grey = rng.uniform(0.2, 0.7)
        colour = rng.choice((*COLOURS, (grey, grey, grey)))
        axes = rpy_matrix((0.0, 0.0, rng.uniform(-3.0, 3.0)))
        self.box(size, at_m + np.array([0.0, 0.0, size[2] / 3]), axes, colour, CARRIER)

    def build(self) -> Boxes:
        """Pack the boxes."""
        n = len(self._rows)
        at, axes, half, colours, instances = zip(*self._rows, strict=True) if n else [()] * 5
        return Boxes(
            np.array(at, float).reshape(n, 3),
            np.array(axes, float).reshape(n, 3, 3),
            np.array(half, float).reshape(n, 3),
            np.array(colours, float).reshape(n, 3),
            np.array(instances, np.int16),
        )


@cache
def _grapple(machine: str) -> list[Shape]:
    return grapple_shapes(profile_of(machine))
