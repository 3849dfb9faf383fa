"""The card beside a weight file: what it is, of what it was made, how good it is and how to make it again."""

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
    """What a trainer has to say: a title, what the network does, its data, its schedule, the seed, what it reached
    (name to text), what it is not good for, and the command that makes it again.
    """

    title: str
    does: str
    data: str
    schedule: str
    seed: int
    metrics: Mapping[str, str]
    limits: str
    command: str


def write(path: Path, network: Network, arrays: Mapping[str, np.ndarray], card: Card, facts: Mapping[str, str]) -> Path:
    """Write the weights at ``path`` and the card beside them; returns the card's path.

    ``facts`` go into the weight file's header, beside data, seed and metrics.
    """
    told = {"data": card.data, "seed": str(card.seed), "command": card.command}
    save(path, network, arrays, {**told, **card.metrics, **facts})
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
