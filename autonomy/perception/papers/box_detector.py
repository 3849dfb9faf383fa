"""A box detector in the role of paper B's (3.2.2): a letterboxed picture of 608 x 608 px in, boxes of logs out.

The paper uses YOLOv3 (62 million parameters).  This is a small network for the same task: at every eighth pixel it
predicts whether the middle of a log's box is there, and the distances of the box's sides.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from scipy import ndimage

from autonomy.networks import SHIPPED, Interface, OpenVinoNet, load
from runtime.errors import InputRefused

SIZE_PX: Final = 608
STRIDE: Final = 8
MIN_SCORE: Final = 0.05
MAX_OVERLAP: Final = 0.75  # intersection over union of two logs' boxes: those of slanting neighbours overlap a lot
SIDE_COUNT: Final = 4  # left, top, right, bottom: logarithms of distances in STRIDE
BOXES: Final = Interface("log_boxes", 3, {"boxes": 1 + SIDE_COUNT})
"""Colour (3, H, W), about -1..1, in; ``boxes`` (5, H / 8, W / 8) out: a logit and four sides."""


class BoxDetector:
    """The detector with its weights (default: the shipped ones), on one thread.

    Raises:
        InputRefused: the weights are missing, damaged or of another network.
    """

    def __init__(self, weights: Path | None = None, precision: str = "f32") -> None:
        read = load(weights or SHIPPED / "log_boxes.onnx", BOXES)
        self.facts = read.facts
        self._net = OpenVinoNet(read, (1, 3, SIZE_PX, SIZE_PX), precision)

    def detect(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (N, 4) left, top, right, bottom [px] in a picture (608, 608, 3) uint8 and their scores (N,),
        descending.

        Raises:
            InputRefused: the picture has another size or type.
        """
        if rgb.shape != (SIZE_PX, SIZE_PX, 3) or rgb.dtype != np.uint8:
            raise InputRefused(
                "network.bad-picture",
                f"the box detector needs letterboxed pictures of {SIZE_PX} x {SIZE_PX} px, uint8, not {rgb.dtype} of "
                f"shape {rgb.shape}",
            )
        return decode_boxes(self._net(network_input(rgb)[None])["boxes"][0])


def network_input(rgb: np.ndarray) -> np.ndarray:
    """The network's input (3, H, W) float32 from a picture (H, W, 3) uint8."""
    return np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32) * np.float32(1.0 / 127.5) - np.float32(1.0)


def decode_boxes(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (N, 4) [px] and scores (N,) of maps (5, h, w): local maxima after non-maximum suppression."""
    score = 1.0 / (1.0 + np.exp(-maps[0]))
    peak = (score >= MIN_SCORE) & (score == ndimage.maximum_filter(score, 3, mode="constant"))
    y, x = np.nonzero(peak)
    order = np.argsort(-score[y, x], kind="stable")
    y, x = y[order], x[order]
    middle = np.stack([x, y], axis=1) * STRIDE + 0.5 * STRIDE
    sides = np.exp(np.clip(maps[1:, y, x].T, -4.0, 5.0)) * STRIDE
    boxes = np.concatenate([middle - sides[:, :2], middle + sides[:, 2:]], axis=1)
    boxes = np.clip(boxes, 0.0, (maps.shape[2] * STRIDE, maps.shape[1] * STRIDE) * 2)
    kept: list[int] = []
    for i in range(len(boxes)):
        if not kept or _overlaps(boxes[i], boxes[kept]).max() < MAX_OVERLAP:
            kept.append(i)
    return boxes[kept], score[y[kept], x[kept]]


def _overlaps(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    shared = np.prod(np.maximum(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0.0), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(np.divide(shared, areas - shared, out=np.zeros_like(shared), where=areas > shared))
