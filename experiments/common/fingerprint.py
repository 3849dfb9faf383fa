"""Which sources and libraries compute here: what two computers must share for the same trial to give the same bytes."""

from __future__ import annotations

import hashlib
from typing import Final

from experiments.common.result import ROOT, versions
from experiments.common.standing import SUFFIXES

SOURCES: Final = ("machine", "sim", "can_dbc", "experiments")
"""Folders of the checkout on which the outcome of every trial depends."""
ALL_SOURCES: Final = ("autonomy", "controller", "hil", "host", "recorder", "runtime", "training", "docs/examples")
"""The others on which the outcome of some trial depends."""
LIBRARIES: Final = ("numpy", "scipy", "numba", "pybullet", "openvino", "torch")
"""Libraries that compute."""


def source_hash(*more: str) -> str:
    """Hash over the content of ``SOURCES`` and of further folders or files of the checkout.

    One that does not exist counts as empty: a run after a move starts anew.
    """
    digest = hashlib.sha256()
    for folder in (*SOURCES, *more):
        for path in sorted([ROOT / folder, *(ROOT / folder).rglob("*")]):
            if path.suffix in SUFFIXES:
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def libraries() -> str:
    """The libraries that compute, with their versions."""
    return ", ".join(f"{name} {number}" for name, number in versions(LIBRARIES).items())


def installation() -> str:
    """Sources and libraries of this process in words; the same words mean the same outcomes."""
    return f"sources {source_hash(*ALL_SOURCES)}, {libraries()}"
