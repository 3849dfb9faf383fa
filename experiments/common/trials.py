"""Helpers for experiments with many trials: checks of the truth, the checkpoint, and printed failures."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from rich.console import Console

from experiments.common.checkpoint import Checkpoint, libraries, source_hash
from experiments.common.registry import Options
from experiments.common.worlds import profile_named, trial_world
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import profile_hash
from sim.individual import another_for_every_seed, split

LOCKSTEP_SOURCES: Final = ("autonomy", "controller", "hil")
"""Further folders on which trials of the whole machine in lockstep depend."""


def sampled_unless_given(truth: str) -> str:
    """Choose the truth for trials that each use another individual machine: sampled, unless the caller chose one."""
    return another_for_every_seed(truth)


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
    besides: object,
    profiles: Iterable[str],
    truth: str,
    sources: Sequence[str] = (),
    published: str = "",
) -> Checkpoint:
    """Open the checkpoint of a run in its folder.  It uses every trial again that has the same fingerprint and job.

    The fingerprint covers the profiles, the truth, the content of `fingerprint.SOURCES` and of ``sources``, further
    folders and files of the checkout, weights included, the versions of the libraries that compute, and ``besides``:
    what else decides an outcome and is in no job.  ``published``: a file in the docs with all outcomes of a long run,
    from which a later run continues.
    """
    parts = [repr(besides), *(repr(profile_hash(profile_named(p))) for p in profiles), source_hash(*sources), truth]
    _, individual = split(truth)
    parts += [individual.read_text()] if individual is not None and individual.is_file() else []
    parts.append(libraries())
    fingerprint = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    file = options.docs / published if options.docs is not None and published else None
    return Checkpoint(options.out / "trials.jsonl", fingerprint, file, options.keeps_trials)


def print_failures(outcomes: Mapping[str, Any], console: Console) -> None:
    """Print why trials failed, by name."""
    for name, outcome in outcomes.items():
        if outcome.get("failure"):
            console.print(f"{name}: {outcome['failure']}", highlight=False)
