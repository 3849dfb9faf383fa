"""From a scene's description to placed shapes with looks; numpy only, shared by both renderers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from training.pictures.traced import shapes
from training.pictures.traced.shapes import Shape

FAR_M: Final = 160.0
Look = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Piece:
    """A shape at a place: ``looks`` of its slots, each with ``what``: bark, end, ground, leaf or paint; ``number`` of
    its instance, 0 for what is no log.  Pieces of one ``shape`` object share it.
    """

    shape: Shape
    looks: tuple[Look, ...]
    position_m: tuple[float, ...]
    turn: np.ndarray
    scale: float = 1.0
    number: int = 0
    bevelled: bool = False


def pieces(scene: Mapping[str, Any]) -> Iterator[Piece]:
    """Yield everything in a scene but camera and light."""
    rng = np.random.default_rng(scene["seed"])
    look, upright = scene["ground"], np.eye(3)
    h = np.array(look["heights_m"])
    earth = ({**look, "what": "ground", "heights_m": None},)
    near = shapes.field(look["x0_m"], look["y0_m"], look["cell_m"], h, look["finer"], look["rough_m"], rng)
    yield Piece(near, earth, (0.0, 0.0, 0.0), upright)
    yield Piece(_far(look, h), earth, (0.0, 0.0, 0.0), upright)
    for log in scene["logs"]:
        bark = {**scene["barks"][log["bark"]], "what": "bark"}
        end = {**bark, "what": "end", "radius_m": float(np.mean(log["radii_m"])), "seed": bark["seed"] + log["number"]}
        points, radii = _refined(log["spine_m"], log["radii_m"])
        body = shapes.stem(points, radii, rng, log["oval"], log["bump"], flare=log["flare"], knots=log["knots"])
        yield Piece(body, (bark, end), tuple(log["position_m"]), np.array(log["turn"]), number=log["number"])
    surface = _Surface(look, h)
    for crowd in scene["crowds"]:
        yield from _crowd(crowd, surface, rng)
    for piece in scene["boxes"]:
        tones = [[0.6 * c for c in piece["colour"]], piece["colour"], piece["colour"]]
        paint = {"what": "paint", "tones": tones, "scale": 0.6, "relief": 0.05, "metal": 0.1, "rough": 0.5}
        yield Piece(
            shapes.box(piece["half_m"]), (paint,), tuple(piece["centre_m"]), np.array(piece["turn"]), bevelled=True
        )


class _Surface:
    """The ground's height at a place."""

    def __init__(self, look: Look, heights: np.ndarray) -> None:
        self.x0, self.y0, self.cell, self.h = look["x0_m"], look["y0_m"], look["cell_m"], heights

    def at(self, x: float, y: float) -> float:
        """Return the height [m], outside the grid that of its edge."""
        i = min(max(round((x - self.x0) / self.cell), 0), self.h.shape[0] - 1)
        j = min(max(round((y - self.y0) / self.cell), 0), self.h.shape[1] - 1)
        return float(self.h[i, j])


def _far(look: Look, h: np.ndarray) -> Shape:
    """Make the ground beyond the grid, out to FAR_M."""
    half = 0.5 * look["cell_m"] * (min(h.shape) - 1)
    middle = (look["x0_m"] + half, look["y0_m"] + half, float(h.mean()))
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ring = np.array([(c * r, s * r, z) for r, z in ((half - 0.3, -0.04), (FAR_M, -1.2)) for c, s in corners])
    return shapes.shape_of(ring + middle, [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)])


def _refined(spine: Any, radii: Any) -> tuple[np.ndarray, np.ndarray]:
    points, r = np.array(spine), np.array(radii)
    at, fine = np.linspace(0.0, 1.0, len(points)), np.linspace(0.0, 1.0, shapes.RINGS)
    return np.stack([np.interp(fine, at, points[:, k]) for k in range(3)], axis=1), np.interp(fine, at, r)


def _crowd(crowd: Look, surface: _Surface, rng: np.random.Generator) -> Iterator[Piece]:
    """Strew many things of one kind over the ground."""
    kinds = [_thing(crowd, rng) for _ in range(crowd["shapes"])]
    cx, cy = crowd["middle_m"]
    keep = np.array(crowd["keep_clear_m"], float).reshape(-1, 3)
    clump, stands = rng.uniform(0.0, 6.28, 2), crowd["kind"] not in ("stones", "twigs", "slash")
    for _ in range(crowd["count"]):
        for _ in range(8):
            x, y = cx + rng.uniform(-1, 1) * crowd["reach_m"], cy + rng.uniform(-1, 1) * crowd["reach_m"]
            bare = math.sin(1.3 * x + clump[0]) * math.cos(0.9 * y + clump[1]) < rng.normal(0.1, 0.15)
            taken = len(keep) and (np.hypot(keep[:, 0] - x, keep[:, 1] - y) < keep[:, 2]).any()
            if not (crowd["clumps"] and bare) and not taken:
                break
        else:
            continue
        shape, looks = kinds[rng.integers(len(kinds))]
        turn = shapes.spin(rng.uniform(0.0, 6.28))
        if not stands:
            tilt = rng.normal(0.0, 0.12)
            c, s = math.cos(tilt), math.sin(tilt)
            turn = turn @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        at = (x, y, surface.at(x, y) + rng.uniform(*crowd["lifts_m"]))
        yield Piece(shape, looks, at, turn, rng.uniform(*crowd["scales"]))


def _thing(crowd: Look, rng: np.random.Generator) -> tuple[Shape, tuple[Look, ...]]:
    """Make one shape of a crowd and the looks of its slots."""
    kind, size, tones = crowd["kind"], crowd["size_m"], crowd["tones"]
    leaf = {"what": "leaf", "tones": tones}
    if kind == "grass":
        return shapes.tuft(rng, crowd["parts"], size, crowd["thick_m"], crowd["lean"]), (leaf,)
    if kind == "fern":
        return shapes.fern(rng, crowd["parts"], size), (leaf,)
    if kind == "leaves":
        return shapes.leaves(rng, crowd["parts"], size, crowd["thick_m"]), (leaf,)
    if kind == "stones":
        half = [size * rng.uniform(0.6, 1.3), size * rng.uniform(0.6, 1.3), size * rng.uniform(0.4, 0.9)]
        return shapes.stone(rng, half), ({"what": "paint", "tones": tones, "scale": 1.0, "relief": 0.5},)
    if kind in ("twigs", "slash"):
        wood = {"what": "paint", "tones": [tones[0], tones[-1], tones[-1]], "scale": 4.0, "relief": 0.3}
        radius = crowd["thick_m"] * rng.uniform(0.5, 1.0)
        shape = shapes.twig(rng, size * rng.uniform(0.5, 1.0), radius, crowd["parts"], kind == "slash")
        return shape, (wood, {"what": "leaf", "tones": crowd.get("needle_tones", tones)})
    bark = {**crowd["bark"], "what": "bark"}
    radius, high = crowd["thick_m"] * rng.uniform(0.6, 1.4), size * rng.uniform(0.7, 1.3)
    z, lean = np.linspace(-0.3, high, 24), rng.normal(0.0, 0.02, 2)
    spine = np.stack([lean[0] * z, lean[1] * z, z], axis=1)
    taper = np.linspace(1.0, 0.6 if kind == "trees" else 0.9, 24) * radius
    shape = shapes.stem(spine, taper, rng, 0.06, 0.015, flare=0.5 if kind == "stumps" else 0.35)
    return shape, (bark, {**bark, "what": "end", "radius_m": radius})
