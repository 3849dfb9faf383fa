"""Ground truth of a picture: for training and evaluation, never for the machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.camera.geometry import View
from sim.camera.render import Picture, surfaces_of
from sim.camera.scene import LogPose, Scene
from sim.camera.visibility import NEAR_M

Box = tuple[int, int, int, int]
RING_POINT_COUNT = 12  # points around a log whose projection bounds it


@dataclass(frozen=True, slots=True)
class Label:
    """One log in one picture.

    ``box_visible`` bounds its visible pixels: left, top, right, bottom, the last two exclusive; None when hidden.
    ``box_full`` bounds the whole log without occlusion and beyond the picture's edges, None when it is behind the
    camera.  ``visible_share`` is its visible pixels over those it would have inside the picture alone.
    """

    log: LogPose
    box_visible: Box | None
    box_full: Box | None
    visible_share: float

    @property
    def instance(self) -> int:
        """Its value in the mask."""
        return self.log.instance


def labels(scene: Scene, view: View, picture: Picture) -> tuple[Label, ...]:
    """Label all logs of the scene, in scene order; ``picture`` is the scene rendered at ``view``."""
    return tuple(_label(scene, view, picture.mask, log) for log in scene.logs)


def _label(scene: Scene, view: View, mask: np.ndarray, log: LogPose) -> Label:
    seen = mask == log.instance
    alone = int(np.count_nonzero(surfaces_of(scene, view, log.instance)))
    visible = int(np.count_nonzero(seen))
    share = min(1.0, visible / alone) if alone else 0.0
    return Label(log, _bounds(seen) if visible else None, _extent(view, log), share)


def _bounds(seen: np.ndarray) -> Box:
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)


def _extent(view: View, log: LogPose) -> Box | None:
    points, radii = log.spine(log.pieces)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(along, (0.0, 0.0, 1.0) if abs(along[0, 2]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across, axis=1)[:, None]
    upward = np.cross(across, along)
    angle = np.linspace(0.0, 2.0 * np.pi, RING_POINT_COUNT, endpoint=False)[:, None, None]
    ring = points + radii[:, None] * (np.cos(angle) * across + np.sin(angle) * upward)
    optical = view.to_optical(ring.reshape(-1, 3))
    ahead = optical[optical[:, 2] > NEAR_M]
    if not len(ahead):
        return None
    pixels = view.intrinsics.project(ahead)
    (left, top), (right, bottom) = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    return (int(left), int(top), int(right) + 1, int(bottom) + 1)
