"""Paper A's grasp network (section II-D, Table I): a depth image in, grasp quality and closing direction out.

The network itself is `training.grasp.network_training.GraspNetwork`.  Its heads stand before the last upsampling, which
gives the same function as in Table I and a grasp without the upsampled maps.  (Merging the first two convolutions into
one of 17 x 17 would not: the zero padding between them is lost, and objects at the border of an image then attract the
grasp.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.networks import SHIPPED, Interface, OpenVinoNet, Weights, load
from runtime.errors import InputRefused

SIDE_PX: Final = 300
"""Side of the depth image and of the full maps."""
POOL: Final = 3
"""The network works at a third of the image's side."""
SHAPE: Final = (1, 1, SIDE_PX, SIDE_PX)
HEADS: Final = ("q", "cos2", "sin2")
CANDIDATE_COUNT: Final = 32
NOT_FINITE: Final = "the quality map is not finite: no grasp can be chosen from it"
PRECISIONS: Final = ("f32", "mixed")
WEIGHTS: Final = SHIPPED / "grasp_cornell.onnx"
RELIEF_SCALE: Final = 0.005
"""Relief, as a share of the ground's distance, at which the arsinh bends: twice as much is not twice as salient."""
MAX_RELIEF: Final = 0.5
"""Relief is clipped here."""
GROUND_STEP_PX: Final = 6
ROBUST_SCALES: Final = (0.2, 0.1, 0.05, 0.03, 0.02, 0.015, 0.01, 0.01, 0.01, 0.01)
FARTHER_FACTOR: Final = 3.0
RIDGE_TERM: Final = np.diag([0.0, 1e-6, 1e-6])

PAPER: Final = Interface("grasp", 1, {"norm6": 32, "heads": len(HEADS), "maps": len(HEADS)})
"""``maps`` at every pixel; ``heads``, the same at a third of the side; ``norm6``, the features before both."""


@dataclass(frozen=True, slots=True)
class GraspMaps:
    """Quality and direction at every pixel: ``q``, ``cos2``, ``sin2`` (H, W), one entry every ``scale_px`` pixels of
    the 300 x 300 image.

    The jaws close along (cos theta, sin theta) in pixels, x right and y down, theta = atan2(sin2, cos2) / 2.
    """

    q: np.ndarray
    cos2: np.ndarray
    sin2: np.ndarray
    scale_px: int = 1


@dataclass(frozen=True, slots=True)
class PixelGrasp:
    """Eq. 4: the pixel of the greatest quality, the closing direction in [-pi/2, pi/2] and the quality there."""

    u_px: float
    v_px: float
    theta_rad: float
    q: float


def best_pixel(maps: GraspMaps) -> PixelGrasp:
    """Find the grasp of eq. 4.

    Maps at a third of the side give the same grasp as the full ones: bilinear interpolation by an odd factor keeps
    every sample and never exceeds it.

    Raises:
        InputRefused: the quality is not finite everywhere.
    """
    if not (np.isfinite(maps.q).all() and maps.q.size):
        raise InputRefused("grasp.quality-not-finite", NOT_FINITE)
    return _at(maps, int(np.argmax(maps.q)))


def _at(maps: GraspMaps, place: int) -> PixelGrasp:
    v, u = divmod(place, maps.q.shape[1])
    middle = (maps.scale_px - 1) / 2
    theta = 0.5 * math.atan2(float(maps.sin2[v, u]), float(maps.cos2[v, u]))
    return PixelGrasp(u * maps.scale_px + middle, v * maps.scale_px + middle, theta, float(maps.q[v, u]))


def normalized_relief(depth_m: np.ndarray) -> np.ndarray:
    """Make the network's input (H, W) float32 from depth [m], NaN where unknown: the relief of things above the ground.

    The ground is the plane that most of the image lies on or before.  Relief is a share of the ground's distance, so
    that a scene and its copy at another scale and slant give the same image: what the network learned from hand-sized
    objects on a table holds for logs.  An arsinh keeps both a pen and a crate visible.  Unknown pixels count as ground;
    an image without ground behind its objects must be given one.

    Raises:
        InputRefused: no pixel is known.
    """
    known = np.isfinite(depth_m) & (depth_m > 0.0)
    if not known.any():
        raise InputRefused("grasp.no-depth", "the depth image holds no known pixel; check the camera and its view")
    out = 1.0 - np.where(known, depth_m, 1.0).astype(np.float32) * _ground(depth_m, known)
    return np.where(
        known, np.arcsinh(np.clip(out, -MAX_RELIEF, MAX_RELIEF) / np.float32(RELIEF_SCALE)), np.float32(0.0)
    )


def _ground(depth_m: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Estimate the inverse depth (H, W) float32 [1/m] of the ground: a plane is linear there.

    Reweighted least squares over every sixth pixel with a shrinking scale; nearer pixels lose weight sooner than
    farther ones, because things lie on the ground.
    """
    height, width = depth_m.shape
    u, v = (np.arange(n) / max(height, width) - 0.5 for n in (width, height))
    step = GROUND_STEP_PX if known[::GROUND_STEP_PX, ::GROUND_STEP_PX].any() else 1
    rows, columns = np.nonzero(known[::step, ::step])
    inverse = 1.0 / depth_m[::step, ::step][rows, columns].astype(np.float64)
    terms = np.stack([np.ones(len(inverse)), u[::step][columns], v[::step][rows]])
    weight = np.ones(len(inverse))
    for scale in ROBUST_SCALES:
        weighted = terms * weight
        plane = np.linalg.solve(weighted @ terms.T + weight.sum() * RIDGE_TERM, weighted @ inverse)
        ground = plane @ terms
        if ground.min() <= 0.0:  # the plane passes the camera, so it is not the ground: assume level ground
            plane = np.array([np.median(inverse), 0.0, 0.0])
            ground = plane @ terms
        miss = inverse / ground - 1.0
        weight = 1.0 / (1.0 + (miss / np.where(miss > 0.0, scale, FARTHER_FACTOR * scale)) ** 2)
    plane_inverse_depth = (plane[0] + plane[1] * u)[None, :] + (plane[2] * v)[:, None]
    ground_inverse: np.ndarray = np.maximum(plane_inverse_depth, 1e-3 * inverse.min()).astype(np.float32)
    return ground_inverse


class GraspNet:
    """The network as it runs on the machine: full maps for display, and the grasp alone from maps at a third of the
    side.

    Args:
        weights: weights of ``PAPER``; the shipped ones by default.
        precision: "f32", or "mixed": bf16 where the processor has it, and f32 for the decision.

    Raises:
        InputRefused: the weights are missing, damaged or of another network, or the precision is unknown.
    """

    def __init__(self, weights: Path = WEIGHTS, precision: str = "f32") -> None:
        if precision not in PRECISIONS:
            raise InputRefused("grasp.unknown-precision", f"precision {precision!r} is none of {', '.join(PRECISIONS)}")
        self._weights = load(weights, PAPER)
        self.facts = self._weights.facts
        self._full: OpenVinoNet | None = None
        self._infer = pixel_grasp_inference(self._weights, precision)

    def maps(self, depth_m: np.ndarray) -> GraspMaps:
        """Compute the maps of all pixels of a 300 x 300 depth image [m], f32.

        Raises:
            InputRefused: another size, or no depth at all (``InputRefused``).
        """
        self._full = self._full or OpenVinoNet(self._weights, SHAPE, outputs=("maps",))
        return grasp_maps(self._full(_picture(depth_m))["maps"][0])

    def best(self, depth_m: np.ndarray) -> PixelGrasp:
        """Find the grasp of eq. 4 in a 300 x 300 depth image [m].

        Raises:
            InputRefused: another size, or no depth at all (``InputRefused``).
        """
        return self._infer(_picture(depth_m))


def pixel_grasp_inference(weights: Weights, precision: str = "f32") -> Callable[[np.ndarray], PixelGrasp]:
    """Return a function from a prepared image (1, 1, 300, 300) to its grasp, by maps at a third of the side.

    "mixed" runs everything in bf16, in which neighbouring pixels of a flat quality become equal and the grasp would
    wander; the last convolution and the heads are therefore repeated in f32 at the best pixels, and these decide.
    """
    if precision == "f32":
        net = OpenVinoNet(weights, SHAPE, outputs=("heads",))
        return lambda picture: best_pixel(grasp_maps(net(picture)["heads"][0]))
    front = OpenVinoNet(weights, SHAPE, "bf16", ("norm6", "heads"))
    arrays = weights.arrays()
    weight = arrays["conv7.weight"].reshape(len(arrays["conv7.bias"]), -1).T
    heads = np.concatenate([arrays[f"{head}.weight"] for head in HEADS])[:, :, 0, 0].T
    heads_bias = np.concatenate([arrays[f"{head}.bias"] for head in HEADS])

    def infer(picture: np.ndarray) -> PixelGrasp:
        outputs = front(picture)
        quality = outputs["heads"][0, 0]
        if not np.isfinite(quality).all():
            raise InputRefused("grasp.quality-not-finite", NOT_FINITE)
        v, u = np.divmod(np.argpartition(quality, -CANDIDATE_COUNT, axis=None)[-CANDIDATE_COUNT:], quality.shape[1])
        hidden = np.maximum(_patches(outputs["norm6"][0], v, u) @ weight + arrays["conv7.bias"], 0.0)
        refined_heads = hidden @ heads + heads_bias
        maps = np.full((len(HEADS), *quality.shape), -np.inf, np.float32)
        maps[:, v, u] = refined_heads.T
        return _at(GraspMaps(maps[0], maps[1], maps[2], POOL), int(np.argmax(maps[0])))

    return infer


def _patches(features: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Collect inputs of the last 5 x 5 convolution at places of the doubled features (C, H, W): (places, C * 25)."""
    sides = []
    for at, size in ((v, features.shape[1]), (u, features.shape[2])):
        places = at[:, None] + np.arange(-2, 3)
        source = np.maximum((places + 0.5) / 2 - 0.5, 0.0)
        low = np.minimum(source.astype(int), size - 1)
        share = (source - low).astype(np.float32)
        inside = ((places >= 0) & (places < 2 * size)).astype(np.float32)
        sides.append((low, np.minimum(low + 1, size - 1), (1.0 - share) * inside, share * inside))
    (v0, v1, a0, a1), (u0, u1, b0, b1) = sides
    rows = [(v0[:, :, None], a0[:, :, None]), (v1[:, :, None], a1[:, :, None])]
    columns = [(u0[:, None, :], b0[:, None, :]), (u1[:, None, :], b1[:, None, :])]
    interpolated = sum(features[:, y, x] * (a * b) for y, a in rows for x, b in columns)
    patches: np.ndarray = interpolated.transpose(1, 0, 2, 3).reshape(len(v), -1)
    return patches


def grasp_maps(heads: np.ndarray) -> GraspMaps:
    """Return the HEADS (3, h, w) by name, at whatever scale they are."""
    return GraspMaps(heads[0], heads[1], heads[2], SIDE_PX // heads.shape[1])


def _picture(depth_m: np.ndarray) -> np.ndarray:
    if depth_m.shape != (SIDE_PX, SIDE_PX):
        raise InputRefused(
            "grasp.image-size", f"the grasp network takes {SIDE_PX} x {SIDE_PX} depth images, not {depth_m.shape}"
        )
    return normalized_relief(depth_m)[None, None]
