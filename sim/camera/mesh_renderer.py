"""A second renderer that shares no geometry code with the first: pybullet's TinyRenderer on meshes.

It checks the analytic renderer, and draws pictures of held-out logs: oval ones with bumpy bark, which the analytic
renderer cannot draw.  Slow: a tenth of a second or more per picture.  Colours are plain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim.bullet.client import new_client
from sim.camera.geometry import View
from sim.camera.render import Picture
from sim.camera.scene import GROUND, SKY, LogPose, Rods, Scene

NEAR_M, FAR_M = 0.1, 60.0
TUBE_SIDE_COUNT = 32
GROUND_REACH_M = 12.0  # radius around the logs in which rough ground is drawn
GROUND_COLOUR, BARK_COLOUR = (0.45, 0.45, 0.43), (0.58, 0.40, 0.26)


Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices (N, 3), triangles (M, 3) and normals (N, 3)."""


def _tube(points: np.ndarray, radii: np.ndarray, bump_m: float, oval: float, rng: np.random.Generator) -> Mesh:
    """Make a closed tube around a spine: vertices, triangles and normals."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(along, (0.0, 0.0, 1.0) if abs(along[0, 2]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across, axis=1)[:, None]
    upward = np.cross(across, along)
    angle = np.linspace(0.0, 2.0 * math.pi, TUBE_SIDE_COUNT, endpoint=False)
    out = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * upward[:, None]
    r = radii[:, None] * (1.0 + oval * np.cos(2.0 * angle + rng.uniform(0.0, math.pi)))
    r = r + bump_m * rng.standard_normal(r.shape)
    side = points[:, None] + r[..., None] * out
    n = len(points)
    # The ends have rims of their own, whose normals point along the log.
    rims, ends = side[[0, -1]].reshape(-1, 3), points[[0, -1]]
    vertices = np.concatenate([side.reshape(-1, 3), rims, ends])
    looks = np.repeat(np.stack([-along[0], along[-1]]), TUBE_SIDE_COUNT, axis=0)
    normals = np.concatenate([out.reshape(-1, 3), looks, np.stack([-along[0], along[-1]])])
    i, j = np.meshgrid(np.arange(n - 1), np.arange(TUBE_SIDE_COUNT), indexing="ij")
    a, b = (i * TUBE_SIDE_COUNT + j).ravel(), (i * TUBE_SIDE_COUNT + (j + 1) % TUBE_SIDE_COUNT).ravel()
    faces = [np.stack([a, b, a + TUBE_SIDE_COUNT], 1), np.stack([b, b + TUBE_SIDE_COUNT, a + TUBE_SIDE_COUNT], 1)]
    k = np.arange(TUBE_SIDE_COUNT)
    for end in (0, 1):
        rim, middle = (n + end) * TUBE_SIDE_COUNT, (n + 2) * TUBE_SIDE_COUNT + end
        turn = [np.full(TUBE_SIDE_COUNT, middle), rim + k, rim + (k + 1) % TUBE_SIDE_COUNT]
        faces.append(np.stack(turn if end else [turn[0], turn[2], turn[1]], 1))
    return vertices, np.concatenate(faces)[:, ::-1], normals


class MeshRenderer:
    """One scene in a client of its own.

    ``bump_m`` roughens the bark, ``oval`` flattens logs (fraction of the radius); ``seed`` draws both.  Call ``close``
    when done.
    """

    def __init__(self, scene: Scene, bump_m: float = 0.0, oval: float = 0.0, seed: int = 0) -> None:
        self._p = new_client()
        self._of_body: dict[int, int] = {-1: SKY}
        rng = np.random.default_rng(seed)
        for log in scene.logs:
            points, radii = _fine(log)
            self._mesh(_tube(points, radii, bump_m, oval, rng), BARK_COLOUR, log.instance)
        self._loose_rods(scene.rods, {log.instance for log in scene.logs}, rng)
        b = scene.boxes
        for i in range(len(b.instance)):
            self._box(b.half_m[i], b.centre_m[i], b.axes[i], tuple(b.colour[i]), int(b.instance[i]))
        self._ground(scene)

    def close(self) -> None:
        """Release the client."""
        if self._p.isConnected():
            self._p.disconnect()

    def _loose_rods(self, rods: Rods, logs: set[int], rng: np.random.Generator) -> None:
        for i in range(len(rods.instance)):
            if int(rods.instance[i]) not in logs:
                points = np.stack([rods.start_m[i], rods.end_m[i]])
                radii = np.array([rods.radius_start_m[i], rods.radius_end_m[i]])
                self._mesh(_tube(points, radii, 0.0, 0.0, rng), tuple(rods.tint[i] / 255.0), int(rods.instance[i]))

    def _body(self, shape: int, instance: int, at: Sequence[float], turn: Sequence[float]) -> None:
        body = self._p.createMultiBody(0.0, -1, shape, basePosition=at, baseOrientation=turn)
        self._of_body[body] = instance

    def _mesh(self, mesh: Mesh, colour: Sequence[float], instance: int) -> None:
        vertices, faces, normals = mesh
        shape = self._p.createVisualShape(
            self._p.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=faces.ravel().tolist(),
            normals=normals.tolist(),
            rgbaColor=[*colour, 1.0],
        )
        self._body(shape, instance, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

    def _box(
        self, half: np.ndarray, centre: np.ndarray, axes: np.ndarray, colour: Sequence[float], instance: int
    ) -> None:
        p = self._p
        shape = p.createVisualShape(p.GEOM_BOX, halfExtents=half.tolist(), rgbaColor=[*colour, 1.0])
        self._body(shape, instance, tuple(centre), _quaternion(axes))

    def _ground(self, scene: Scene) -> None:
        g, h = scene.ground, scene.ground.heights_m
        span = range(len(scene.logs))
        middle = np.mean([scene.logs[i].position_m for i in span], axis=0) if scene.logs else np.zeros(3)
        (i0, i1), (j0, j1) = (
            (
                max(0, int((m - GROUND_REACH_M - low) / g.cell_m)),
                min(n - 1, int((m + GROUND_REACH_M - low) / g.cell_m) + 1),
            )
            for m, low, n in ((middle[0], g.x0_m, h.shape[0]), (middle[1], g.y0_m, h.shape[1]))
        )
        i, j = np.meshgrid(np.arange(i0, i1 + 1), np.arange(j0, j1 + 1), indexing="ij")
        vertices = np.stack([g.x0_m + i * g.cell_m, g.y0_m + j * g.cell_m, h[i0 : i1 + 1, j0 : j1 + 1]], axis=-1)
        columns = j1 - j0 + 1
        a = (np.arange(i1 - i0)[:, None] * columns + np.arange(j1 - j0)).ravel()
        faces = [np.stack([a, a + columns, a + 1], 1), np.stack([a + columns, a + columns + 1, a + 1], 1)]
        flat = vertices.reshape(-1, 3)
        normals = np.tile((0.0, 0.0, 1.0), (len(flat), 1))
        self._mesh((flat, np.concatenate(faces), normals), GROUND_COLOUR, GROUND)

    def render(self, view: View) -> Picture:
        """Render the scene, in the form of the first renderer's ``render``."""
        pin, eye, turn = view.intrinsics, view.position_m, view.rotation
        w, h = pin.width_px, pin.height_px
        to_gl = np.eye(4)
        to_gl[:3, :3] = (turn * (1.0, -1.0, -1.0)).T
        to_gl[:3, 3] = -to_gl[:3, :3] @ eye
        lens = np.zeros((4, 4))
        lens[0, 0], lens[1, 1] = 2.0 * pin.fx_px / w, 2.0 * pin.fy_px / h
        # TinyRenderer samples a pixel at its lower left corner, not at its middle.
        lens[0, 2] = 1.0 - 2.0 * pin.cx_px / w
        lens[1, 2] = 2.0 * (pin.cy_px + 1.0) / h - 1.0
        lens[2, 2], lens[2, 3] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
        lens[3, 2] = -1.0
        p = self._p
        _, _, rgba, buffer, bodies = p.getCameraImage(
            w, h, to_gl.T.ravel().tolist(), lens.T.ravel().tolist(), renderer=p.ER_TINY_RENDERER, shadow=0
        )
        bodies = np.asarray(bodies).reshape(h, w)
        buffer = np.asarray(buffer, float).reshape(h, w)
        depth = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * buffer)
        depth[bodies < 0] = np.nan
        table = np.array([self._of_body[b] for b in range(-1, len(self._of_body) - 1)], np.int16)
        rgb = np.asarray(rgba, np.uint8).reshape(h, w, 4)[..., :3]
        return Picture(np.ascontiguousarray(rgb), depth.astype(np.float32), table[bodies + 1])


def _fine(log: LogPose) -> tuple[np.ndarray, np.ndarray]:
    """Compute the spine in many pieces, for a smooth bow and for bumps."""
    return log.spine(24)


def _quaternion(m: np.ndarray) -> tuple[float, float, float, float]:
    """Compute the quaternion (x, y, z, w) of a rotation matrix."""
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0.0, 0.0, 0.0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0.0, 0.0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0.0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return (float(x), float(y), float(z), float(w))
