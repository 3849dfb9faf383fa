"""Paper A's network trained on physical labels of settled piles instead of Cornell rectangles.

Network, loss and schedule are the same, and ``autonomy.grasp.cnn_planner`` uses the weights like the paper's.  The
piles come from ``training.pictures.piles``.
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
from autonomy.networks.torch_net import TorchNet
from training.common.model_card import Card, write
from training.grasp import network_training
from training.grasp.network_training import LEARNING_RATE
from training.grasp.physical_frames import FRAMES_PER_PILE, GraspFrame, frames
from training.pictures.piles import CHUNK, HELD_OUT, piles, profile_of

MACHINE: Final = "palms_471"
FRAMES, EPOCHS, BATCH = 4000, 4, 8
TEST_FRAMES: Final = 200
"""Frames of held-out piles for the figure of the card."""


def drawn_frames(
    count: int, seed: int, first_chunk: int = 0, folder: Path | None = None, tick: Callable[[], None] = lambda: None
) -> list[GraspFrame]:
    """``count`` frames, ``FRAMES_PER_PILE`` of each pile; only piles on flat ground outside the bunk are used."""
    profile, found = profile_of(MACHINE), list[GraspFrame]()
    jaws, ground = jaws_of(profile), profile.workspace.ground_z_m
    chunks = 1 + count // (FRAMES_PER_PILE * CHUNK // 2)
    while len(found) < count:
        for pile in piles(MACHINE, first_chunk, chunks, folder):
            if pile.terrain == "flat" and pile.kind != "bunk" and len(found) < count:
                some = min(FRAMES_PER_PILE, count - len(found))
                found.extend(frames(pile.logs, ground, jaws, seed + pile.number, some))
                tick()
        first_chunk += chunks
    return found


def examples_of(found: list[GraspFrame]) -> list[network_training.Example]:
    """Frames as examples for eq. 5; the labels of all 90 000 pixels are interpolated."""
    up = network_training.upsampling()
    square = up.T @ up
    out = []
    for i, frame in enumerate(found):
        projected = square @ frame.labels @ square
        squared = float(np.sum(frame.labels * projected))
        out.append(network_training.Example(i, frame.low, (), projected.astype(np.float32), squared))
    return out


def quality_share(net: TorchNet, found: list[GraspFrame]) -> float:
    """Mean ratio of the label's quality at the network's best pixel to the best quality in the frame."""
    maps = network_training.predict(net, examples_of(found))
    shares = []
    for one, frame in zip(maps, found, strict=True):
        best = float(frame.labels[0].max())
        if best > 0.0:
            shares.append(float(frame.labels[0].flat[int(np.argmax(one.q))]) / best)
    return float(np.mean(shares)) if shares else 0.0


def produce(
    seed: int, out: Path, console: Console, count: int = FRAMES, epochs: int = EPOCHS, folder: Path | None = None
) -> tuple[Path, Path]:
    """Draw frames, train, and write weights and card; an interrupted run continues.  Returns both paths."""
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("drawing frames", total=-(-count // FRAMES_PER_PILE))
        found = drawn_frames(count, seed, 0, folder, lambda: progress.advance(task))
    kept = out.with_suffix(".checkpoint")
    title = "grasp network, physical labels"
    net, losses = network_training.train_network(
        examples_of(found), seed, title, console, kept, epochs=epochs, batch=BATCH
    )
    share = quality_share(net, drawn_frames(TEST_FRAMES, seed + 1, HELD_OUT, folder))
    card = Card(
        "Paper A's grasp network on physical labels",
        "Depth picture in, grasp quality and closing direction at every pixel out (paper A, Table I).",
        f"{count} frames of settled piles of logs seen by the virtual camera, labelled by the rule of "
        "autonomy.grasp.quality; no real data",
        f"{epochs} epochs, batches of {BATCH}, AdamW with {LEARNING_RATE} and a cosine, products in bf16; eq. 5",
        seed,
        {
            "loss (eq. 5), mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}",
            "label's quality at the chosen pixel over the best in the frame, held-out piles": f"{share:.3f}",
        },
        "anything but the virtual depth picture of logs as cylinders on level ground",
        f"timberhand train grasp --labels physical --seed {seed} --epochs {epochs} --out {out.name}",
    )
    return out, write(out, PAPER, net.arrays(), card, {"frames": str(count)})
