"""Plots of the detector experiment: precision over recall, detected logs, and photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from autonomy.perception.segmentation.instances import Instance
from experiments.detector.metrics import PAPER
from experiments.detector.worlds import TestPicture
from runtime.plot_style import sheet
from training.common.average_precision import Curve

COLOURS: Final = np.array(
    [(230, 80, 60), (70, 150, 220), (240, 190, 60), (110, 190, 90), (180, 110, 210), (80, 200, 200), (240, 130, 180)],
    float,
)
TILE_PX: Final = 456


def precision_recall(path: Path, curves: Mapping[str, Curve]) -> None:
    """Plot precision over recall, as in Fig. 7 of paper B."""
    with sheet(path, width=8.0, height=3.6) as axis:
        for name, curve in curves.items():
            recall, precision = np.append(0.0, curve.recall), np.append(1.0, curve.precision)
            axis.plot(recall, precision, label=f"{name}: AP {100 * curve.average:.1f} %")
        axis.set(xlabel="recall", ylabel="precision", xlim=(0.0, 1.01), ylim=(0.0, 1.02))
        axis.set_title("Boxes of logs, least overlap 0.5")
        legend_title = f"paper B: AP {100 * PAPER['map50']:.2f} % on its own photographs"
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), alignment="left", title=legend_title)


def overlaid(rgb: np.ndarray, found: Sequence[Instance]) -> Image.Image:
    """Draw masks, boxes, scores and ends into a picture; visible ends are filled."""
    picture = rgb.astype(float)
    for i, log in enumerate(found):
        picture[log.mask] = 0.45 * picture[log.mask] + 0.55 * COLOURS[i % len(COLOURS)]
    image = Image.fromarray(picture.astype(np.uint8))
    pen = ImageDraw.Draw(image)
    for i, log in enumerate(found):
        colour = tuple(int(c) for c in COLOURS[i % len(COLOURS)])
        left, top, right, bottom = log.box_px
        pen.rectangle((left - 1, top - 1, right, bottom), outline=colour)
        pen.text((left, max(0, top - 12)), f"{log.score:.2f}", fill=(255, 255, 255))
        for (u, v), seen in zip(log.ends_px, log.ends_seen, strict=True):
            pen.ellipse((u - 2, v - 2, u + 2, v + 2), outline=(20, 20, 20), fill=(255, 255, 255) if seen else None)
    return image


def gallery(path: Path, looks: Sequence[tuple[TestPicture, tuple[Instance, ...]]], columns: int = 3) -> None:
    """Write test pictures with their detections."""
    contact_sheet(path, [overlaid(test_picture.rgb, instances) for test_picture, instances in looks], columns)


def contact_sheet(path: Path, images: Sequence[Image.Image], columns: int) -> None:
    """Write pictures in rows, each scaled to a tile."""
    tiles = []
    for image in images:
        factor = min(TILE_PX / image.width, TILE_PX * 9 / 16 / image.height)
        tiles.append(
            image.resize((round(image.width * factor), round(image.height * factor)), Image.Resampling.LANCZOS)
        )
    height = round(TILE_PX * 9 / 16)
    rows = -(-len(tiles) // columns)
    page = Image.new("RGB", (columns * (TILE_PX + 4) - 4, rows * (height + 4) - 4), (255, 255, 255))
    for i, tile in enumerate(tiles):
        left, top = (i % columns) * (TILE_PX + 4), (i // columns) * (height + 4)
        page.paste(tile, (left + (TILE_PX - tile.width) // 2, top + (height - tile.height) // 2))
    path.parent.mkdir(parents=True, exist_ok=True)
    page.save(path)
