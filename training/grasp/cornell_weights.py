"""The grasp network's weight file from Cornell samples, and how it does on any folder of such samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from autonomy.grasp.network import PAPER, GraspNet
from training.common.model_card import Card, write
from training.grasp import network_training
from training.grasp.cornell import Sample
from training.grasp.rectangles import Rectangle, right
from training.grasp.views import centre, cut, seen


def produce(samples: Sequence[Sample], seed: int, epochs: int, out: Path, console: Console) -> tuple[Path, Path]:
    """Train on all samples and write weights and card; a run that was stopped goes on. Returns both paths."""
    with console.status("cutting views"):
        examples = network_training.copies(samples, seed)
    kept = out.with_suffix(".checkpoint")
    net, losses = network_training.fit(examples, seed, "grasp network", console, kept, epochs=epochs)
    return out, ship(net.arrays(), losses, samples, seed, epochs, out)


def ship(
    arrays: Mapping[str, np.ndarray], losses: Sequence[float], samples: Sequence[Sample], seed: int, epochs: int,
    out: Path,
) -> Path:  # fmt: skip
    """Write trained weights with their card; returns the card's path."""
    opening, jaw = network_training.usual_size(network_training.plain(samples))
    facts = {
        "numbers": " ".join(str(s.number) for s in samples),
        "opening_px": f"{opening:.3f}",
        "jaw_px": f"{jaw:.3f}",
    }
    judged = on_samples(GraspNet(arrays), samples, facts)
    hits = sum(j["right"] for j in judged)
    copies = len(samples) * network_training.COPIES
    card = Card(
        "Paper A's grasp network on Cornell samples",
        "Depth picture in, grasp quality and closing direction at every pixel out (paper A, Table I).",
        f"{len(samples)} samples of the Cornell grasping data (Jiang, Moseson, Saxena 2011), numbers "
        f"{samples[0].number:04d} to {samples[-1].number:04d}; research data without an explicit licence, not part of "
        "this package",
        f"{epochs} epochs of {copies} views (plain crop and {network_training.COPIES - 1} random zooms, crops and turns of each), "
        f"batches of {network_training.BATCH}, AdamW with {network_training.LEARNING_RATE} and a cosine, products in bf16; eq. 5",
        seed,
        {
            "loss (eq. 5), mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}",
            "rectangle metric on the samples it was trained on": f"{hits} of {len(judged)}; what it does on others is "
            "in docs/grasp-network.md",
        },
        "anything but depth seen from above or aslant with ground around the objects. It was never shown a log.",
        f"timberhand train grasp --data CORNELL --seed {seed} --epochs {epochs} --out {out.name}",
    )
    return write(out, PAPER, arrays, card, facts)


def on_samples(net: GraspNet, samples: Sequence[Sample], facts: Mapping[str, str]) -> list[dict[str, Any]]:
    """The grasp on every sample's plain crop, as the running net chooses it, and whether it is right.

    ``facts``: of the weight file; they tell the usual rectangle and which numbers were trained on.
    """
    known = set(facts["numbers"].split())
    found = []
    for s in samples:
        view = centre(s.depth_m)
        labels = seen(s.grasps, view)
        if not labels:
            continue
        g = net.best(cut(s.depth_m, view))
        usual = Rectangle(g.u_px, g.v_px, g.theta_rad, float(facts["opening_px"]), float(facts["jaw_px"]))
        own = any(right(Rectangle(g.u_px, g.v_px, g.theta_rad, r.opening_px, r.jaw_px), [r]) for r in labels)
        found.append({"number": s.number, "right": right(usual, labels), "own_size": own,
                      "trained_on": str(s.number) in known, "q": g.q})  # fmt: skip
    return found
