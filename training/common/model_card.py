"""The model card beside a weight file: data, schedule, metrics, limits and the command that reproduces it."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from autonomy.networks.graph import Network, fingerprint, parameter_count
from autonomy.networks.weights import save


@dataclass(frozen=True, slots=True)
class Card:
    """Contents of a model card: title, purpose, training data, schedule, seed, metrics (name to text), limits, and the
    command that reproduces the weights.
    """

    title: str
    does: str
    data: str
    schedule: str
    seed: int
    metrics: Mapping[str, str]
    limits: str
    command: str


def write(
    path: Path,
    network: Network,
    arrays: Mapping[str, np.ndarray],
    card: Card,
    facts: Mapping[str, str],
    half: bool = False,
) -> Path:
    """Write the weights to ``path`` and the card beside them; returns the card's path.

    ``facts`` are written to the weight file's header with data, command, seed and metrics; ``half`` as in ``save``.
    """
    header = {"data": card.data, "seed": str(card.seed), "command": card.command}
    save(path, network, arrays, {**header, **card.metrics, **facts}, half)
    beside = path.with_suffix(".md")
    beside.write_text(text(path, network, card))
    return beside


def text(path: Path, network: Network, card: Card) -> str:
    """The card as Markdown."""
    rows = {
        "file": f"`{path.name}`, {path.stat().st_size / 1e6:.2f} MB, "
        f"sha256 `{hashlib.sha256(path.read_bytes()).hexdigest()}`",
        "network": f"`{network.name}`, {parameter_count(network):,} parameters, fingerprint `{fingerprint(network)}`",
        "data": card.data,
        "schedule": card.schedule,
        "seed": str(card.seed),
        "trained on": f"{platform.machine()}, Python {platform.python_version()}, torch {version('torch')}",
        **card.metrics,
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return (
        f"# {card.title}\n\n{card.does}\n\n| | |\n|---|---|\n{table}\n\n"
        f"Not good for: {card.limits}\n\nMade by\n\n```\n{card.command}\n```\n"
    )
