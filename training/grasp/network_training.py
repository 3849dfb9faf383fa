"""Training of paper A's grasp network on Cornell data: copies, eq. 5, one fold of a cross-validation, final weights.

The network is trained in its own function but for the order of two commuting steps (heads before the last upsampling,
pooled pictures kept instead of pooled again).  Eq. 5 over all 90 000 pixels is a square form of the 100 x 100 maps, and
is evaluated as such: same value, no 300 x 300 map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import torch
from rich.console import Console

from autonomy.grasp.network import HEADS, PAPER, POOL, GraspMaps, best_pixel, normalized_relief
from autonomy.networks.graph import Conv, Network
from autonomy.networks.torch_net import TorchNet, random_net
from training.common.loop import Schedule, train
from training.grasp.cornell import Sample
from training.grasp.rectangles import Rectangle, right
from training.grasp.views import SIDE_PX, View, centre, cut, drawn, label_maps, seen

COPIES: Final = 10
"""Views of every sample, as in the paper: the plain crop and nine random copies."""
BATCH: Final = 4
EPOCHS: Final = 6
LEARNING_RATE: Final = 2e-3
LOW_PX: Final = SIDE_PX // POOL

BODY: Final = Network(
    "grasp at a third",
    1,
    (
        *(layer for layer in PAPER.layers[1:] if layer.name not in (*HEADS, "up3")),
        *(Conv(head, 1, 1, source="relu7") for head in HEADS),
    ),
    HEADS,
)
"""The paper's network from pooled pictures to maps at a third of the side: the same parameters."""


@dataclass(frozen=True, slots=True)
class Example:
    """A view: pooled network input (100, 100), grasps in it, and its labels as eq. 5 needs them at 100 x 100."""

    number: int
    low: np.ndarray
    grasps: tuple[Rectangle, ...]
    pulled: np.ndarray
    """Label maps times the upsampling's transpose (3, 100, 100)."""
    square: float
    """Sum of the squared label maps."""


def plain(samples: Sequence[Sample]) -> list[Example]:
    """Every sample as it is, cropped at the middle; samples without a grasp there are left out."""
    views = ((s, centre(s.depth_m)) for s in samples)
    return [_example(s, view) for s, view in views if seen(s.grasps, view)]


def copies(samples: Sequence[Sample], seed: int, count: int = COPIES) -> list[Example]:
    """The plain crop and random copies of every sample, ``count`` together, sample by sample."""
    return [_example(s, _view(s, seed, i)) for s in samples for i in range(count)]


def _view(sample: Sample, seed: int, i: int) -> View:
    plain_crop = centre(sample.depth_m)
    if i == 0 and seen(sample.grasps, plain_crop):
        return plain_crop
    return drawn(sample.depth_m, sample.grasps, np.random.default_rng([seed, sample.number, i]))


def _example(sample: Sample, view: View) -> Example:
    picture, grasps = normalized_relief(cut(sample.depth_m, view)), seen(sample.grasps, view)
    labels = label_maps(grasps)
    up = upsampling()
    low = picture.reshape(LOW_PX, POOL, LOW_PX, POOL).mean((1, 3))
    return Example(sample.number, low, grasps, up.T @ labels @ up, float(np.square(labels).sum()))


@cache
def upsampling() -> np.ndarray:
    """The last upsampling along one side, (300, 100) float32."""
    eye = torch.eye(LOW_PX)[None]
    return torch.nn.functional.interpolate(eye, scale_factor=POOL, mode="linear")[0].T.numpy()


def fit(examples: Sequence[Example], seed: int, title: str, console: Console, checkpoint: Path | None = None,
        epochs: int = EPOCHS, batch: int = BATCH) -> tuple[TorchNet, list[float]]:  # fmt: skip
    """A net trained on the examples, and the loss of every step."""
    low, pulled = (torch.from_numpy(np.stack([getattr(e, name) for e in examples])) for name in ("low", "pulled"))
    square = torch.tensor([e.square for e in examples])
    a_side = torch.from_numpy(upsampling().T @ upsampling())
    per_epoch = len(examples) // batch
    orders: dict[int, np.ndarray] = {}

    def take(step: int) -> tuple[torch.Tensor, ...]:
        epoch, place = divmod(step, per_epoch)
        if epoch not in orders:
            orders.clear()
            orders[epoch] = np.random.default_rng([seed, epoch]).permutation(len(examples))
        chosen = torch.from_numpy(orders[epoch][place * batch : (place + 1) * batch])
        return low[chosen][:, None].contiguous(memory_format=torch.channels_last), pulled[chosen], square[chosen]

    def loss(net: TorchNet, pictures: torch.Tensor, labels: torch.Tensor, squares: torch.Tensor) -> torch.Tensor:
        found = net(pictures)
        return equation_5(torch.cat([found[head] for head in HEADS], 1).float(), labels, squares, a_side)

    net = random_net(BODY, seed).to(memory_format=torch.channels_last)
    schedule = Schedule(epochs * per_epoch, LEARNING_RATE, bf16=True)
    run = f"grasp seed {seed}, {len(examples)} examples, batch {batch}"
    return net, train(net, take, loss, schedule, checkpoint, run, title, console)


def equation_5(maps: torch.Tensor, pulled: torch.Tensor, square: torch.Tensor, a_side: torch.Tensor) -> torch.Tensor:
    """Eq. 5 of upsampled maps (N, 3, 100, 100): mean over pictures and pixels of the three squared errors' sum.

    ``a_side`` is the upsampling's transpose times itself (100, 100).
    """
    with torch.autocast("cpu", enabled=False):
        whole = (maps * (a_side @ maps @ a_side)).sum() - 2.0 * (maps * pulled).sum() + square.sum()
    return whole / (len(maps) * SIDE_PX * SIDE_PX)


def predict(net: TorchNet, examples: Sequence[Example]) -> list[GraspMaps]:
    """Maps at a third of the side, float32."""
    net.eval()
    found = []
    with torch.inference_mode():
        for e in examples:
            out = net(torch.from_numpy(e.low)[None, None].contiguous(memory_format=torch.channels_last))
            found.append(GraspMaps(*(out[head][0, 0].numpy() for head in HEADS), POOL))
    return found


def usual_size(examples: Sequence[Example]) -> tuple[float, float]:
    """Median opening and jaw size [px] of the labels: the network tells neither."""
    sizes = np.array([(g.opening_px, g.jaw_px) for e in examples for g in e.grasps])
    opening, jaw = np.median(sizes, axis=0)
    return float(opening), float(jaw)


def judge(maps: GraspMaps, grasps: Sequence[Rectangle], size_px: tuple[float, float]) -> dict[str, float | bool]:
    """The chosen grasp and whether it is right: as a rectangle of the usual size, and of each label's own size."""
    g = best_pixel(maps)
    own = any(right(Rectangle(g.u_px, g.v_px, g.theta_rad, r.opening_px, r.jaw_px), [r]) for r in grasps)
    return {
        "right": right(Rectangle(g.u_px, g.v_px, g.theta_rad, *size_px), grasps), "own_size": own,
        "u_px": g.u_px, "v_px": g.v_px, "theta_rad": g.theta_rad, "q": g.q,
    }  # fmt: skip
