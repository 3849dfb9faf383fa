"""Training of paper A's grasp network: examples, eq. 5, prediction and evaluation.

The trained network computes the same function as the paper's; two commuting steps are exchanged (heads before the last
upsampling) and pooled pictures are stored.  Eq. 5 over all 90 000 pixels is a quadratic form of the 100 x 100 maps and
is evaluated as such, which gives the same value without a 300 x 300 map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console
from scipy.ndimage import map_coordinates
from torch import nn
from torch.nn import functional as F

from autonomy.grasp.network import HEADS, POOL, GraspMaps, best_pixel, grasp_maps, normalized_relief
from training.common.loop import Schedule, channels_last, seeded, train
from training.grasp.cornell import Rectangle, Sample, is_correct, wrapped

# -- Views of a labelled depth picture: the network's 300 x 300 window, its labels, and random copies.

SIDE_PX: Final = 300
ZOOM_RANGE: Final = (0.5, 1.0)
"""Share of the window's side that a random copy shows, as in the framework that paper A adopts (its [10])."""
MAX_SHIFT_PX: Final = 40.0
MAX_ATTEMPTS: Final = 200


@dataclass(frozen=True, slots=True)
class View:
    """A square window: its middle in the picture [px], its rotation, and picture pixels per window pixel."""

    u_px: float
    v_px: float
    turned_rad: float = 0.0
    zoom: float = 1.0


def central_view(depth_m: np.ndarray) -> View:
    """Return the paper's crop in the middle of the picture."""
    height, width = depth_m.shape
    return View((width - 1) / 2, (height - 1) / 2)


def random_view(depth_m: np.ndarray, grasps: tuple[Rectangle, ...], rng: np.random.Generator) -> View:
    """Draw a random copy (paper A II-D: zooms, crops, rotations) with the middle of at least one grasp.

    Its middle lies near the line from the middle of the picture to the mean of the grasps.
    """
    plain = central_view(depth_m)
    start = np.array([plain.u_px, plain.v_px])
    offset_px = np.mean([(g.u_px, g.v_px) for g in grasps], axis=0) - start
    for _ in range(MAX_ATTEMPTS):
        turned, zoom = rng.uniform(-math.pi, math.pi), rng.uniform(*ZOOM_RANGE)
        u, v = start + rng.uniform(0.0, 1.0) * offset_px + rng.uniform(-MAX_SHIFT_PX, MAX_SHIFT_PX, 2)
        view = View(float(u), float(v), float(turned), float(zoom))
        if visible_grasps(grasps, view):
            return view
    return View(grasps[0].u_px, grasps[0].v_px)


def view_depth(depth_m: np.ndarray, view: View) -> np.ndarray:
    """Sample the depth (300, 300) float32 [m] of a view, bilinear; the border of the picture repeats, NaN stays NaN."""
    across = (np.arange(SIDE_PX) - (SIDE_PX - 1) / 2) * view.zoom
    c, s = math.cos(view.turned_rad), math.sin(view.turned_rad)
    u = view.u_px + c * across[None, :] - s * across[:, None]
    v = view.v_px + s * across[None, :] + c * across[:, None]
    return np.asarray(map_coordinates(depth_m, [v, u], order=1, mode="nearest", output=np.float32))


def visible_grasps(grasps: Iterable[Rectangle], view: View) -> tuple[Rectangle, ...]:
    """Return the grasps with their middle inside the view, in pixels of the view."""
    c, s = math.cos(view.turned_rad), math.sin(view.turned_rad)
    visible = []
    for g in grasps:
        du, dv = (g.u_px - view.u_px) / view.zoom, (g.v_px - view.v_px) / view.zoom
        u, v = c * du + s * dv + (SIDE_PX - 1) / 2, -s * du + c * dv + (SIDE_PX - 1) / 2
        if -0.5 <= u < SIDE_PX - 0.5 and -0.5 <= v < SIDE_PX - 0.5:
            theta = wrapped(g.theta_rad - view.turned_rad)
            visible.append(Rectangle(u, v, theta, g.opening_px / view.zoom, g.jaw_px / view.zoom))
    return tuple(visible)


def label_maps(grasps: Iterable[Rectangle]) -> np.ndarray:
    """Draw Q, cos 2 theta, sin 2 theta (3, 300, 300) float32.

    Q is 1 inside the rectangles and 0 elsewhere (paper A II-D).  The direction is the mean of the rectangles that cover
    a pixel, and 0 where there is none.
    """
    v, u = np.mgrid[:SIDE_PX, :SIDE_PX]
    covered, cos2, sin2 = (np.zeros((SIDE_PX, SIDE_PX), np.float32) for _ in range(3))
    for g in grasps:
        c, s = math.cos(g.theta_rad), math.sin(g.theta_rad)
        along, across = c * (u - g.u_px) + s * (v - g.v_px), -s * (u - g.u_px) + c * (v - g.v_px)
        inside = (np.abs(along) <= g.opening_px / 2) & (np.abs(across) <= g.jaw_px / 2)
        covered[inside] += 1.0
        cos2[inside] += math.cos(2.0 * g.theta_rad)
        sin2[inside] += math.sin(2.0 * g.theta_rad)
    many = np.maximum(covered, 1.0)
    return np.stack([np.minimum(covered, 1.0), cos2 / many, sin2 / many])


VIEWS_PER_SAMPLE: Final = 10
"""As in the paper: the plain_examples crop and nine random augmented_examples."""
BATCH: Final = 4
EPOCHS: Final = 6
LEARNING_RATE: Final = 2e-3
LOW_PX: Final = SIDE_PX // POOL
KINDS: Final = ("weight", "bias")


class GraspNetwork(nn.Module):
    """Table I of paper A, its three heads before the last upsampling: a 1 x 1 convolution commutes with it.

    78 803 parameters.  Table I prints 12 832 for the second 32-channel layer; its sum holds only with 25 632.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, 16, 11, padding=5)
        self.conv2 = nn.Conv2d(16, 16, 7, padding=3)
        self.norm2 = nn.BatchNorm2d(16)
        self.conv3 = nn.Conv2d(16, 16, 5, padding=2)
        self.conv4 = nn.Conv2d(16, 16, 5, padding=2)
        self.norm4 = nn.BatchNorm2d(16)
        self.conv5 = nn.Conv2d(16, 32, 5, padding=2)
        self.conv6 = nn.Conv2d(32, 32, 5, padding=2)
        self.norm6 = nn.BatchNorm2d(32)
        self.conv7 = nn.Conv2d(32, 16, 5, padding=2)
        self.q, self.cos2, self.sin2 = (nn.Conv2d(16, 1, 1) for _ in HEADS)

    def features(self, pooled: torch.Tensor) -> torch.Tensor:
        """Compute features (N, 32, h / 2, w / 2) of pictures at a third of the side (N, 1, h, w)."""
        x = F.max_pool2d(self.norm2(F.relu(self.conv2(self.conv1(pooled)))), 2)
        x = self.norm4(self.conv4(F.relu(self.conv3(x))))
        feature_maps: torch.Tensor = self.norm6(F.relu(self.conv6(self.conv5(x))))
        return feature_maps

    def hidden(self, features: torch.Tensor) -> torch.Tensor:
        """Compute what the heads read (N, 16, h, w)."""
        return F.relu(self.conv7(F.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)))

    def heads_of(self, hidden: torch.Tensor) -> torch.Tensor:
        """Compute the HEADS (N, 3, h, w), as one convolution."""
        weights, biases = (torch.cat([getattr(self, head).get_parameter(kind) for head in HEADS]) for kind in KINDS)
        return F.conv2d(hidden, weights, biases)

    def heads(self, pooled: torch.Tensor) -> torch.Tensor:
        """Compute maps (N, 3, h, w) at a third of the side."""
        return self.heads_of(self.hidden(self.features(pooled)))

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compute the outputs of ``autonomy.grasp.network.PAPER``."""
        features = self.features(F.avg_pool2d(pictures, POOL))
        heads = self.heads_of(self.hidden(features))
        return features, heads, F.interpolate(heads, scale_factor=float(POOL), mode="bilinear", align_corners=False)


class OriginalOrder(GraspNetwork):
    """Table I as it stands, with the heads on the upsampled features, for comparison."""

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """Compute maps (N, 3, H, W)."""
        hidden = self.hidden(self.features(F.avg_pool2d(pictures, POOL)))
        up = F.interpolate(hidden, scale_factor=float(POOL), mode="bilinear", align_corners=False)
        return torch.cat([self.q(up), self.cos2(up), self.sin2(up)], 1)


@dataclass(frozen=True, slots=True)
class Example:
    """A view: pooled network input (100, 100), its grasps, and its labels for eq. 5 at 100 x 100."""

    number: int
    low: np.ndarray
    grasps: tuple[Rectangle, ...]
    projected: np.ndarray
    """Label maps multiplied by the transpose of the upsampling (3, 100, 100)."""
    square: float
    """Sum of the squared label maps."""


def plain_examples(samples: Sequence[Sample]) -> list[Example]:
    """Cut the central crop of every sample, without samples that have no grasp there."""
    views = ((s, central_view(s.depth_m)) for s in samples)
    return [_example(s, view) for s, view in views if visible_grasps(s.grasps, view)]


def augmented_examples(samples: Sequence[Sample], seed: int, count: int = VIEWS_PER_SAMPLE) -> list[Example]:
    """Cut ``count`` views of every sample, sample by sample: the plain crop and random copies."""
    return [_example(s, _view(s, seed, i)) for s in samples for i in range(count)]


def _view(sample: Sample, seed: int, i: int) -> View:
    plain_crop = central_view(sample.depth_m)
    if i == 0 and visible_grasps(sample.grasps, plain_crop):
        return plain_crop
    return random_view(sample.depth_m, sample.grasps, np.random.default_rng([seed, sample.number, i]))


def _example(sample: Sample, view: View) -> Example:
    picture, grasps = normalized_relief(view_depth(sample.depth_m, view)), visible_grasps(sample.grasps, view)
    labels = label_maps(grasps)
    up = upsampling()
    low = picture.reshape(LOW_PX, POOL, LOW_PX, POOL).mean((1, 3))
    return Example(sample.number, low, grasps, up.T @ labels @ up, float(np.square(labels).sum()))


@cache
def upsampling() -> np.ndarray:
    """Return the matrix (300, 100) float32 of the last upsampling along one side."""
    eye = torch.eye(LOW_PX)[None]
    return torch.nn.functional.interpolate(eye, scale_factor=POOL, mode="linear")[0].T.numpy()


def train_network(
    examples: Sequence[Example],
    seed: int,
    title: str,
    console: Console,
    checkpoint: Path | None = None,
    epochs: int = EPOCHS,
    batch: int = BATCH,
) -> tuple[GraspNetwork, list[float]]:
    """Train a net on the examples; return it and the loss of every step."""
    low, projected = (torch.from_numpy(np.stack([getattr(e, name) for e in examples])) for name in ("low", "projected"))
    square = torch.tensor([e.square for e in examples])
    a_side = torch.from_numpy(upsampling().T @ upsampling())
    per_epoch = len(examples) // batch
    orders: dict[int, np.ndarray] = {}

    def batch_of(step: int) -> tuple[torch.Tensor, ...]:
        epoch, batch_index = divmod(step, per_epoch)
        if epoch not in orders:
            orders.clear()
            orders[epoch] = np.random.default_rng([seed, epoch]).permutation(len(examples))
        chosen = torch.from_numpy(orders[epoch][batch_index * batch : (batch_index + 1) * batch])
        return low[chosen][:, None].contiguous(memory_format=torch.channels_last), projected[chosen], square[chosen]

    def loss(net: GraspNetwork, pictures: torch.Tensor, labels: torch.Tensor, squares: torch.Tensor) -> torch.Tensor:
        return equation_5(net.heads(pictures).float(), labels, squares, a_side)

    net = channels_last(seeded(GraspNetwork, seed))
    schedule = Schedule(epochs * per_epoch, LEARNING_RATE, bf16=True)
    run = f"grasp seed {seed}, {len(examples)} examples, batch {batch}"
    return net, train(net, batch_of, loss, schedule, checkpoint, run, title, console)


def equation_5(maps: torch.Tensor, projected: torch.Tensor, square: torch.Tensor, a_side: torch.Tensor) -> torch.Tensor:
    """Compute eq. 5 of upsampled maps (N, 3, 100, 100): mean over pictures and pixels of the three squared errors' sum.

    ``a_side`` is the upsampling's transpose times itself (100, 100).
    """
    with torch.autocast("cpu", enabled=False):
        whole = (maps * (a_side @ maps @ a_side)).sum() - 2.0 * (maps * projected).sum() + square.sum()
    return whole / (len(maps) * SIDE_PX * SIDE_PX)


def predict(net: GraspNetwork, examples: Sequence[Example]) -> list[GraspMaps]:
    """Predict maps at a third of the side, float32."""
    net.eval()
    predicted_maps = []
    with torch.inference_mode():
        for e in examples:
            out = net.heads(torch.from_numpy(e.low)[None, None].contiguous(memory_format=torch.channels_last))
            predicted_maps.append(grasp_maps(out[0].numpy()))
    return predicted_maps


def median_size_px(examples: Sequence[Example]) -> tuple[float, float]:
    """Compute the median opening and jaw size [px] of the labels, because the network predicts neither."""
    sizes = np.array([(g.opening_px, g.jaw_px) for e in examples for g in e.grasps])
    opening, jaw = np.median(sizes, axis=0)
    return float(opening), float(jaw)


def evaluate(maps: GraspMaps, grasps: Sequence[Rectangle], size_px: tuple[float, float]) -> dict[str, float | bool]:
    """Return the chosen grasp, and whether it is correct with the median size (``right``) and with each label's
    size."""
    g = best_pixel(maps)
    own = any(is_correct(Rectangle(g.u_px, g.v_px, g.theta_rad, r.opening_px, r.jaw_px), [r]) for r in grasps)
    return {
        "right": is_correct(Rectangle(g.u_px, g.v_px, g.theta_rad, *size_px), grasps),
        "own_size": own,
        "u_px": g.u_px,
        "v_px": g.v_px,
        "theta_rad": g.theta_rad,
        "q": g.q,
    }
