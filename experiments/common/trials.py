"""What experiments of many trials share: a truth that can be used, a checkpoint of their own, failures told by name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common.pool import Checkpoint
from experiments.common.registry import Options
from experiments.common.result import ROOT
from experiments.common.worlds import opened, profile_named
from host.exit_codes import CommandFailed, ExitCode
from machine.load import profile_hash

SOURCES: Final = ("machine", "sim", "can_dbc", "hil/experiments")


def individuals(truth: str) -> str:
    """The truth of trials that are each of another individual: sampled, unless one was asked for."""
    return "sampled" if truth == "nominal" else truth


def check_truth(profile: str, truth: str) -> None:
    """Open a world of it once, before any trial does.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    try:
        with opened(profile, truth, 0):
            pass
    except ValueError as error:
        raise CommandFailed(ExitCode.CONFIGURATION, str(error)) from None


def checkpoint(
    options: Options,
    asked: object,
    profiles: Iterable[str],
    truth: str,
    sources: Sequence[str] = (),
    published: str = "",
) -> Checkpoint:
    """The run's checkpoint in its folder; that of a run whose outcomes might be others is not continued.

    ``asked``: what of the run decides them, jobs or seed and counts; ``sources``: folders and files of the checkout
    that they depend on beside ``SOURCES``; ``published``: a file of the docs that holds all outcomes of a long run, so
    that a later one goes on from there.
    """
    parts = [repr(asked), *(repr(profile_hash(profile_named(p))) for p in profiles), source_hash(*sources), truth]
    parts += [Path(truth).read_text()] if Path(truth).is_file() else []
    fingerprint = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    file = options.docs / published if options.docs is not None and published else None
    return Checkpoint(options.out / "trials.jsonl", fingerprint, file)


def source_hash(*more: str) -> str:
    """Of ``SOURCES`` and further folders or files of the checkout."""
    digest = hashlib.sha256()
    for folder in (*SOURCES, *more):
        for path in sorted([ROOT / folder, *(ROOT / folder).rglob("*")]):
            if path.suffix in (".py", ".toml", ".dbc", ".eds"):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def tell_failures(outcomes: Mapping[str, Any], console: Console) -> None:
    """Why trials did not end well, by name."""
    for name, outcome in outcomes.items():
        if outcome.get("failure"):
            console.print(f"{name}: {outcome['failure']}", highlight=False)
