"""Helpers for experiments with many trials: checks of the truth, the checkpoint, and printed failures."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common.pool import Checkpoint
from experiments.common.registry import Options
from experiments.common.result import ROOT
from experiments.common.worlds import profile_named, trial_world
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import profile_hash

SOURCES: Final = ("machine", "sim", "can_dbc", "experiments")
"""Folders of the checkout on which the outcome of every trial depends."""
LOCKSTEP_SOURCES: Final = ("autonomy", "controller", "hil")
"""Further folders on which trials of the whole machine in lockstep depend."""


def sampled_unless_given(truth: str) -> str:
    """The truth for trials that each use another individual machine: sampled, unless the caller chose one."""
    return "sampled" if truth == "nominal" else truth


def check_truth(profile: str, truth: str) -> None:
    """Open one world with this truth, so that a truth that cannot be used fails before the first trial.

    Raises:
        CommandFailed: the truth file cannot be used.
    """
    try:
        with trial_world(profile, truth, 0):
            pass
    except ValueError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None


def checkpoint(
    options: Options,
    asked: object,
    profiles: Iterable[str],
    truth: str,
    sources: Sequence[str] = (),
    published: str = "",
) -> Checkpoint:
    """The checkpoint of a run in its folder.  It continues only a run with the same fingerprint.

    The fingerprint covers ``asked`` (the jobs, or seed and counts), the profiles, the truth, and the content of
    ``SOURCES`` and of ``sources``, further folders and files of the checkout.  ``published``: a file in the docs with
    all outcomes of a long run, from which a later run continues.
    """
    parts = [repr(asked), *(repr(profile_hash(profile_named(p))) for p in profiles), source_hash(*sources), truth]
    parts += [Path(truth).read_text()] if Path(truth).is_file() else []
    fingerprint = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    file = options.docs / published if options.docs is not None and published else None
    return Checkpoint(options.out / "trials.jsonl", fingerprint, file)


def source_hash(*more: str) -> str:
    """Hash over the content of ``SOURCES`` and of further folders or files of the checkout.

    One that does not exist counts as empty: a run after a move starts anew.
    """
    digest = hashlib.sha256()
    for folder in (*SOURCES, *more):
        for path in sorted([ROOT / folder, *(ROOT / folder).rglob("*")]):
            if path.suffix in (".py", ".toml", ".dbc", ".eds"):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def print_failures(outcomes: Mapping[str, Any], console: Console) -> None:
    """Print why trials failed, by name."""
    for name, outcome in outcomes.items():
        if outcome.get("failure"):
            console.print(f"{name}: {outcome['failure']}", highlight=False)
