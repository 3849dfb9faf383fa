"""Paper A's network trained on physical labels of settled piles, not on Cornell rectangles: same net, loss, schedule.

The weights serve ``autonomy.grasp.cnn_planner`` like the paper's.  Needs torch; piles come from ``training.pictures.piles``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console
from rich.progress import Progress

from autonomy.grasp.jaws import jaws_of
from autonomy.grasp.network import PAPER
from training.common.model_card import Card, write
from training.grasp import network_training
from training.grasp.physical_frames import REUSED, GraspFrame, frames
from training.pictures.piles import CHUNK, HELD_OUT, piles, profile_of

MACHINE: Final = "palms_471"
FRAMES, EPOCHS, BATCH = 4000, 4, 8
HELD_BACK: Final = 200
"""Frames of piles that nothing is trained on; the card's figure is of these."""


def drawn(
    count: int, seed: int, first_chunk: int = 0, folder: Path | None = None, tick: Callable[[], None] = lambda: None
) -> list[GraspFrame]:
    """``count`` frames, ``REUSED`` of each pile; piles that a fixed machine's flat yard has not are left out."""
    profile, found = profile_of(MACHINE), list[GraspFrame]()
    jaws, ground = jaws_of(profile), profile.workspace.ground_z_m
    chunks = 1 + count // (REUSED * CHUNK // 2)
    while len(found) < count:
        for pile in piles(MACHINE, first_chunk, chunks, folder):
            if pile.terrain == "flat" and pile.kind != "bunk" and len(found) < count:
                found.extend(frames(pile.logs, ground, jaws, seed + pile.number, min(REUSED, count - len(found))))
                tick()
        first_chunk += chunks
    return found


def examples(found: list[GraspFrame]) -> list[network_training.Example]:
    """Frames as eq. 5 takes them: the labels over all 90 000 pixels are the interpolated ones."""
    up = network_training.upsampling()
    square = up.T @ up
    out = []
    for i, frame in enumerate(found):
        pulled = square @ frame.labels @ square
        out.append(network_training.Example(i, frame.low, (), pulled.astype(np.float32), float(np.sum(frame.labels * pulled))))
    return out


def worth(net: object, found: list[GraspFrame]) -> float:
    """Mean quality, by the label, of the place that the network likes best, over the best quality there is."""
    maps = network_training.predict(net, examples(found))  # type: ignore[arg-type]
    shares = []
    for one, frame in zip(maps, found, strict=True):
        best = float(frame.labels[0].max())
        if best > 0.0:
            shares.append(float(frame.labels[0].flat[int(np.argmax(one.q))]) / best)
    return float(np.mean(shares)) if shares else 0.0


def produce(
    seed: int, out: Path, console: Console, count: int = FRAMES, epochs: int = EPOCHS, folder: Path | None = None
) -> tuple[Path, Path]:
    """Draw frames, train and write weights and card; a run that was stopped goes on.  Returns both paths."""
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("drawing frames", total=-(-count // REUSED))
        found = drawn(count, seed, 0, folder, lambda: progress.advance(task))
    kept = out.with_suffix(".checkpoint")
    title = "grasp network, physical labels"
    net, losses = network_training.fit(examples(found), seed, title, console, kept, epochs=epochs, batch=BATCH)
    judged = worth(net, drawn(HELD_BACK, seed + 1, HELD_OUT, folder))
    card = Card(
        "Paper A's grasp network on physical labels",
        "Depth picture in, grasp quality and closing direction at every pixel out (paper A, Table I).",
        f"{count} frames of settled piles of logs seen by the virtual camera, labelled by the rule of "
        "autonomy.grasp.quality; no real data",
        f"{epochs} epochs, batches of {BATCH}, AdamW with {network_training.LEARNING_RATE} and a cosine, products in bf16; eq. 5",
        seed,
        {
            "loss (eq. 5), mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}",
            "label's quality at the chosen place over the best in the picture, other piles": f"{judged:.3f}",
        },
        "anything but the virtual depth picture of logs as cylinders on level ground",
        f"timberhand train grasp --labels physical --seed {seed} --epochs {epochs} --out {out.name}",
    )
    return out, write(out, PAPER, net.arrays(), card, {"frames": str(count)})
