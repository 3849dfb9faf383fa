"""The grasp network's weight file from Cornell samples, and its evaluation on any such samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from autonomy.grasp.network import PAPER, GraspNet
from training.common.weight_file import Card, save, write
from training.grasp import network_training
from training.grasp.cornell import Rectangle, Sample, is_correct
from training.grasp.network_training import (
    BATCH,
    LEARNING_RATE,
    VIEWS_PER_SAMPLE,
    GraspNetwork,
    central_view,
    view_depth,
    visible_grasps,
)


def produce(samples: Sequence[Sample], seed: int, epochs: int, out: Path, console: Console) -> tuple[Path, Path]:
    """Train on all samples and write weights and card; an interrupted run continues.  Return both paths."""
    with console.status("cutting views"):
        examples = network_training.augmented_examples(samples, seed)
    checkpoint = out.with_suffix(".checkpoint")
    net, losses = network_training.train_network(examples, seed, "grasp network", console, checkpoint, epochs=epochs)
    return out, ship(net, losses, samples, seed, epochs, out)


def ship(
    net: GraspNetwork,
    losses: Sequence[float],
    samples: Sequence[Sample],
    seed: int,
    epochs: int,
    out: Path,
) -> Path:
    """Write trained weights with their card; return the card's path."""
    opening, jaw = network_training.median_size_px(network_training.plain_examples(samples))
    facts = {
        "numbers": " ".join(str(s.number) for s in samples),
        "opening_px": f"{opening:.3f}",
        "jaw_px": f"{jaw:.3f}",
    }
    save(out, net, PAPER, facts)
    results = on_samples(GraspNet(out), samples, facts)
    hits = sum(r["right"] for r in results)
    views = len(samples) * VIEWS_PER_SAMPLE
    card = Card(
        "Paper A's grasp network on Cornell samples",
        "Depth picture in, grasp quality and closing direction at every pixel out (paper A, Table I).",
        f"{len(samples)} samples of the Cornell grasping data (Jiang, Moseson, Saxena 2011), numbers "
        f"{samples[0].number:04d} to {samples[-1].number:04d}; research data without an explicit licence, not part of "
        "this package",
        f"{epochs} epochs of {views} views (plain crop and {VIEWS_PER_SAMPLE - 1} random zooms, crops and rotations of "
        f"each), batches of {BATCH}, AdamW with {LEARNING_RATE} and a cosine, products in bf16; eq. 5",
        seed,
        {
            "loss (eq. 5), mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}",
            "rectangle metric on the training samples": f"{hits} of {len(results)}; for other samples see "
            "docs/grasp-network.md",
        },
        "anything but depth seen from above or aslant with ground around the objects. It was not trained on logs.",
        f"timberhand train grasp --data CORNELL --seed {seed} --epochs {epochs} --out {out.name}",
    )
    return write(out, net, PAPER, card, facts)


def on_samples(net: GraspNet, samples: Sequence[Sample], facts: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the grasp that the net chooses on every sample's plain crop, and whether it is correct.

    ``facts`` of the weight file give the size of the rectangle and the numbers of the training samples.
    """
    known = set(facts["numbers"].split())
    results = []
    for s in samples:
        view = central_view(s.depth_m)
        labels = visible_grasps(s.grasps, view)
        if not labels:
            continue
        g = net.best(view_depth(s.depth_m, view))
        usual = Rectangle(g.u_px, g.v_px, g.theta_rad, float(facts["opening_px"]), float(facts["jaw_px"]))
        own = any(is_correct(Rectangle(g.u_px, g.v_px, g.theta_rad, r.opening_px, r.jaw_px), [r]) for r in labels)
        results.append(
            {
                "number": s.number,
                "right": is_correct(usual, labels),
                "own_size": own,
                "trained_on": str(s.number) in known,
                "q": g.q,
            }
        )
    return results
