"""A visible scene as arrays: rods (logs, twigs, blades of grass), boxes (machine, bunk) and the ground.

A ``SceneBuilder`` makes a scene without physics; ``scene_from_world`` reads one from a running plant.  World frame,
metres.  A log is a chain of cone frusta with mitred joints along a parabolic bow, so a swept log has no gaps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from sim.camera.geometry import quaternion_matrix
from sim.ground.terrain import surface_height
from sim.mechanics.carrier import CARRIER_LINKS, carrier_links
from sim.mechanics.crane import crane_shapes
from sim.wood.bunk import bunk_shapes
from sim.wood.log_shape import STRAIGHT_M

if TYPE_CHECKING:
    from sim.world import World

SKY, GROUND, CRANE, BUNK, CARRIER, COVER = -1, 0, 1001, 1002, 1003, 1004  # instance ids; logs are 1, 2, ...
BARK, TWIG, GRASS = 0, 1, 2  # surfaces of a rod
Style = Literal["asphalt", "forest"]
Vector = Sequence[float]


@dataclass(frozen=True, slots=True)
class Ground:
    """A grid of heights as in ``sim.ground.terrain.Terrain``: ``heights_m[i, j]`` at (x0 + i cell, y0 + j cell).

    A cell is two triangles that meet on the diagonal from (i + 1, j) to (i, j + 1).
    """

    x0_m: float
    y0_m: float
    cell_m: float
    heights_m: np.ndarray

    @classmethod
    def flat(cls, z_m: float = 0.0, edge_m: float = 120.0) -> Ground:
        """Make a level square around the origin."""
        return cls(-edge_m / 2, -edge_m / 2, edge_m, np.full((2, 2), float(z_m)))

    @property
    def mean_m(self) -> float:
        """Mean height [m]: that of the plane beyond the grid."""
        return float(self.heights_m.mean())

    def height(self, x_m: float, y_m: float) -> float:
        """Return the height [m] of the surface; outside the grid that of its edge."""
        return surface_height(x_m, y_m, self.x0_m, self.y0_m, self.cell_m, self.heights_m)


@dataclass(frozen=True, slots=True)
class Rods:
    """S frusta.  ``normal_start`` and ``normal_end`` point along the rod and cut its joints; ``caps`` bit 0 is a closed
    start, bit 1 a closed end; ``side`` is where the bark's angle is 0, ``along_m`` the bark's start.
    """

    start_m: np.ndarray
    end_m: np.ndarray
    radius_start_m: np.ndarray
    radius_end_m: np.ndarray
    normal_start: np.ndarray
    normal_end: np.ndarray
    side: np.ndarray
    along_m: np.ndarray
    caps: np.ndarray
    surface: np.ndarray
    tint: np.ndarray
    instance: np.ndarray

    def moved(self, rotation: np.ndarray, position_m: np.ndarray) -> Rods:
        """Turn every rod by its ``rotation`` (S, 3, 3) and shift it to its ``position_m`` (S, 3)."""

        def turn(v: np.ndarray) -> np.ndarray:
            turned: np.ndarray = np.einsum("sij,sj->si", rotation, v)
            return turned

        start, end = turn(self.start_m) + position_m, turn(self.end_m) + position_m
        normals = {"normal_start": turn(self.normal_start), "normal_end": turn(self.normal_end)}
        return replace(self, start_m=start, end_m=end, side=turn(self.side), **normals)

    def __add__(self, other: Rods) -> Rods:
        columns = (f.name for f in fields(self))
        return Rods(*(np.concatenate([getattr(self, c), getattr(other, c)]) for c in columns))


@dataclass(frozen=True, slots=True)
class Boxes:
    """B boxes: centre (B, 3), axes as columns (B, 3, 3), half edge lengths (B, 3), colour 0..1 (B, 3)."""

    centre_m: np.ndarray
    axes: np.ndarray
    half_m: np.ndarray
    colour: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True, slots=True)
class LogPose:
    """One log in the log frame of ``sim.wood.log_shape``.

    Origin at the pith at half length, z along the chord towards the thin end, x towards the side it bows to; mid
    diameter, diameter lost per metre, sagitta of the bow.
    """

    instance: int
    position_m: Vector
    quaternion: Vector
    length_m: float
    diameter_m: float
    taper_m_m: float = 0.0
    sweep_m: float = 0.0

    @property
    def axis(self) -> np.ndarray:
        """Unit vector (3,) along the log, butt to top."""
        axis: np.ndarray = quaternion_matrix(self.quaternion)[:, 2]
        return axis

    @property
    def pieces(self) -> int:
        """Number of straight pieces in which the log is drawn, as in its body."""
        return 3 if self.sweep_m <= STRAIGHT_M else 5

    def spine(self, pieces: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute points (pieces + 1, 3) of the bowed pith in the world and the radii (pieces + 1,) there."""
        s = np.linspace(-0.5, 0.5, pieces + 1)
        local = np.stack([-4.0 * self.sweep_m * s * s, np.zeros_like(s), s * self.length_m], axis=1)
        points = local @ quaternion_matrix(self.quaternion).T + np.asarray(self.position_m)
        return points, np.maximum(0.002, (self.diameter_m - self.taper_m_m * s * self.length_m) / 2)


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that a camera may see; ``links`` are the machine's link poses (position, quaternion) by name."""

    rods: Rods
    boxes: Boxes
    ground: Ground
    style: Style
    logs: tuple[LogPose, ...]
    links: Mapping[str, tuple[Vector, Vector]]


class SceneBuilder:
    """Collects logs, rods and boxes; ``build`` packs them."""

    def __init__(self, ground: Ground, style: Style = "asphalt") -> None:
        self.ground = ground
        self.style: Style = style
        self._rods: list[tuple[object, ...]] = []
        self._boxes: list[tuple[object, ...]] = []
        self._logs: list[LogPose] = []

    def log(self, log: LogPose, tint: Vector = (1.0, 1.0, 1.0)) -> None:
        """Add a log, its bark coloured by ``tint``."""
        points, radii = log.spine(log.pieces)
        self._logs.append(log)
        self._chain(points, radii, quaternion_matrix(log.quaternion)[:, 1], BARK, tint, log.instance)

    def rod(self, points_m: np.ndarray, radii_m: Vector, surface: int, tint: Vector, instance: int = COVER) -> None:
        """Add a chain of frusta through ``points_m`` (N, 3) with the radii there: a twig, a blade of grass."""
        points = np.asarray(points_m, float)
        chord = points[-1] - points[0]
        side = np.cross(chord, (0.0, 0.0, 1.0) if abs(chord[2]) < 0.9 * np.linalg.norm(chord) else (1.0, 0.0, 0.0))
        self._chain(points, np.asarray(radii_m, float), side / np.linalg.norm(side), surface, tint, instance)

    def _chain(
        self, points: np.ndarray, radii: np.ndarray, side: np.ndarray, surface: int, tint: Vector, instance: int
    ) -> None:
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        directions = steps / lengths[:, None]
        joints = np.vstack([directions[:1], directions[:-1] + directions[1:], directions[-1:]])
        joints /= np.linalg.norm(joints, axis=1)[:, None]
        along, last = 0.0, len(steps) - 1
        for i in range(len(steps)):
            caps = (i == 0) | 2 * (i == last)
            ends = (points[i], points[i + 1], radii[i], radii[i + 1], joints[i], joints[i + 1])
            self._rods.append((*ends, side, along, caps, surface, tint, instance))
            along += float(lengths[i])

    def box(self, size_m: Vector, position_m: Vector, quaternion: Vector, colour: Vector, instance: int) -> None:
        """Add a box: full edge lengths, pose in the world."""
        half = np.asarray(size_m, float) / 2
        self._boxes.append((np.asarray(position_m, float), quaternion_matrix(quaternion), half, colour, instance))

    def build(self, links: Mapping[str, tuple[Vector, Vector]] | None = None) -> Scene:
        """Return the packed scene."""
        n, m = len(self._rods), len(self._boxes)
        rod = list(zip(*self._rods, strict=True)) if n else [()] * 12
        box = list(zip(*self._boxes, strict=True)) if m else [()] * 5
        wide = (3, 3, 0, 0, 3, 3, 3, 0, 0, 0, 3, 0)
        kinds = (float,) * 8 + (np.uint8, np.int8, float, np.int16)
        rods = [np.array(c, k).reshape((n, w) if w else (n,)) for c, w, k in zip(rod, wide, kinds, strict=True)]
        boxes = Boxes(
            np.array(box[0], float).reshape(m, 3),
            np.array(box[1], float).reshape(m, 3, 3),
            np.array(box[2], float).reshape(m, 3),
            np.array(box[3], float).reshape(m, 3),
            np.array(box[4], np.int16).reshape(m),
        )
        return Scene(Rods(*rods), boxes, self.ground, self.style, tuple(self._logs), links or {})


class WorldScenes:
    """The scenes of a running plant: each call reads its poses from the ``World``."""

    def __init__(self, world: World) -> None:
        profile, terrain = world.profile, world.terrain
        self._world = world
        self.style: Style = "asphalt" if profile.carrier is None else "forest"
        self.ground = Ground(*terrain.origin_m, terrain.cell_m, terrain.heights)
        shapes = [(s, CRANE) for s in crane_shapes(profile, world.truth.steel)]
        shapes += [(s, BUNK) for s in bunk_shapes(profile)]
        if profile.carrier is not None:
            under, _ = carrier_links(profile, world.truth)
            shapes += [(s, CARRIER) for link in under if link.name in CARRIER_LINKS for s in link.shapes]
        self._links = tuple(dict.fromkeys(s.link for s, _ in shapes))
        self._of_link = np.array([self._links.index(s.link) for s, _ in shapes])
        local = SceneBuilder(self.ground, self.style)
        for s, instance in shapes:
            local.box(s.size_m, s.position_m, s.quaternion, s.colour, instance)
        for i, spec in enumerate(world.log_bodies.scene):
            size = (spec.length_m, spec.diameter_m, spec.taper_m_m, spec.sweep_m)
            # No two logs have quite the same bark.
            tint = 0.88 + 0.24 * ((i * 0.618) % 1.0)
            local.log(LogPose(i + 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), *size), (tint, tint, tint))
        self._local = local.build()

    def __call__(self) -> Scene:
        """Return the scene now."""
        links = self._world.link_poses()
        turns = np.stack([quaternion_matrix(links[n][1]) for n in self._links])[self._of_link]
        at = np.array([links[n][0] for n in self._links])[self._of_link]
        boxes = self._local.boxes
        centres = np.einsum("bij,bj->bi", turns, boxes.centre_m) + at
        boxes = replace(boxes, centre_m=centres, axes=turns @ boxes.axes)
        states = self._world.log_bodies.states()
        logs = tuple(
            LogPose(i + 1, s.position_m, s.quaternion, s.length_m, s.diameter_m, s.taper_m_m, s.sweep_m)
            for i, s in enumerate(states)
        )
        rods = self._local.rods
        if logs:
            owner = rods.instance - 1
            turns = np.stack([quaternion_matrix(log.quaternion) for log in logs])[owner]
            rods = rods.moved(turns, np.array([log.position_m for log in logs])[owner])
        return Scene(rods, boxes, self.ground, self.style, logs, links)


def scene_from_world(world: World) -> Scene:
    """Return the present scene of a running plant."""
    return WorldScenes(world)()
