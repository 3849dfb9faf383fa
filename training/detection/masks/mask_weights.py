"""The weight file of the mask network, its card and the log of its training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from autonomy.perception.segmentation.mask_network import mask_network
from training.common.dataset_error import DatasetError
from training.common.model_card import Card, write
from training.detection.masks.mixture import SHARES, mixed
from training.detection.masks.pretrained import trunk_arrays
from training.detection.masks.run import Run, train

LIMITS = (
    "measuring logs seen end-on, and fans of many thin logs, whose masks it merges. The curve from heat to score is "
    "that of the shipped weights, not fitted again. `python -m experiments.detector.traced FOLDER` judges it."
)


def device_of(asked: str) -> str:
    """The device by its name; "auto" is cuda where there is one.

    Raises:
        DatasetError: there is no such device.
    """
    there = torch.cuda.is_available()
    if asked == "auto":
        return "cuda" if there else "cpu"
    if asked == "cuda" and not there:
        raise DatasetError("train.no-cuda", "torch finds no CUDA device; use --device cpu")
    return asked


def produce(
    folder: Path, run: Run, trunk: Path | None, photographs: Sequence[tuple[np.ndarray, np.ndarray]], device: str,
    out: Path, command: str, console: Console,
) -> Path:  # fmt: skip
    """Train on the sets of ``folder``; writes weights, card and log (JSON lines) and returns the card's path.

    An interrupted run continues from the checkpoint beside ``out``.

    Raises:
        DatasetError: the pictures, the trunk or the device are missing.
    """
    where = device_of(device)
    if trunk is not None and not trunk.is_file():
        raise DatasetError(
            "dataset.no-trunk", f"{trunk}: no such file; torchvision's mobilenet_v2-b0353104.pth is meant"
        )
    bank, counts = mixed(folder, photographs)
    start = trunk_arrays(trunk) if trunk else None
    out.parent.mkdir(parents=True, exist_ok=True)
    last: dict[str, Any] = {}

    def tell(record: dict[str, Any]) -> None:
        last.update(record)
        with out.with_suffix(".jsonl").open("a") as log:
            log.write(json.dumps(record) + "\n")
        console.print(f"step {record['step']}, {record['s']:.0f} s, loss {record.get('loss')}", highlight=False)

    steps = [0]

    def keep(_: dict[str, np.ndarray], step: int) -> None:
        steps[0] = step

    arrays = train(bank.to(where), run, start, tell, keep, checkpoint=out.with_suffix(".checkpoint"))
    shares = ", ".join(f"{name} {n} ({SHARES[name]:g})" for name, n in counts.items())
    card = Card(
        "Logs in pictures as masks, with depth or without",
        "Picture in; eight maps, features of every pixel and kernels of logs out, of which masks of logs are made.",
        f"pictures (share in which they are drawn): {shares}; those with hardly any wood a third as often",
        f"{steps[0]} steps of {run.batch} windows of {run.side_px} px on {where}, AdamW with {run.learning_rate} and a "
        f"cosine, average of the weights; the trunk began {'with ' + trunk.name if trunk else 'random'}",
        run.seed, {"loss, last record": str(last.get("loss", "none"))}, LIMITS, command,
    )  # fmt: skip
    return write(out, mask_network(), arrays, card, {}, half=True)
