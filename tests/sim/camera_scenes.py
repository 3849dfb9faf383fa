"""Scenes without physics for the camera tests."""

import math
import random

from machine.geometry.optics import pinhole
from sim.camera.geometry import look_at
from sim.camera.scene import BUNK, CRANE, Ground, LogPose, Scene, SceneBuilder

LENS = pinhole(320, 240, math.radians(80.0))
ABOVE = look_at((-3.0, -2.5, 2.6), (0.0, 0.0, 0.0), LENS)


def lying(yaw: float) -> tuple[float, float, float, float]:
    """Orientation of a level log whose thin end points along ``yaw``."""
    c, s, r = math.cos(yaw / 2), math.sin(yaw / 2), math.sqrt(0.5)
    return (-s * r, c * r, s * r, c * r)


def log(
    instance: int, x: float, y: float, yaw: float = 0.0, diameter: float = 0.2, length: float = 2.5, **shape
) -> LogPose:
    return LogPose(instance, (x, y, diameter / 2), lying(yaw), length, diameter, **shape)


def site(logs: int, seed: int = 0, ground: Ground | None = None, machine: bool = True) -> Scene:
    """Logs at random, a bunk beside them and a boom across them."""
    rng = random.Random(f"site {seed}")
    b = SceneBuilder(ground or Ground.flat())
    for i in range(logs):
        x, y = rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5)
        d = rng.uniform(0.1, 0.3)
        at = (x, y, b.ground.height(x, y) + d / 2)
        bow = rng.choice((0.0, 0.06))
        b.log(LogPose(i + 1, at, lying(rng.uniform(-3.0, 3.0)), 2.5, d, rng.uniform(0.0, 0.012), bow))
    if machine:
        b.box((2.4, 1.2, 0.3), (0.0, 3.0, 0.15), (0.0, 0.0, 0.0, 1.0), (0.35, 0.37, 0.4), BUNK)
        b.box((0.16, 3.0, 0.22), (-1.4, 0.0, 1.5), (0.0, 0.0, 0.2955, 0.9553), (0.95, 0.72, 0.1), CRANE)
    return b.build()
