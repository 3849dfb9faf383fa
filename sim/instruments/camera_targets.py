"""What an emulated survey of a camera needs of the plant: its hidden mount and noise, for the targets that it sees."""

from __future__ import annotations

from typing import Any

from sim.truth.load import load_truth


def seen_with(truth: str, seed: int, machine: str) -> Any:
    """The truth about a machine with its cameras, as ``plant.world.truth``, where the plant is in another process.

    Raises:
        PlantError: the truth cannot be used.
    """
    return load_truth(truth, seed, machine)
