"""One individual machine calibrated before an experiment lets it work: the profile that it then has, as a file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from autonomy.calibration.profile_file import NotWritten, changes, write_profile
from autonomy.calibration.result import identify
from controller.guard.__main__ import profile_path
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.calibration.crane import run_lockstep

DATE: Final = "2000-01-01"
"""Stands in the calibrated profile; a run's outcome must not depend on the day."""


def calibrated(job: Job) -> dict[str, Any]:
    """Options: profile, truth.  The text of the profile that `timberhand calibrate` would write for this individual,
    None with the reason in ``failure`` when it would write none.
    """
    name = job.options["profile"]
    outcome = run_lockstep(name, job.options["truth"], job.seed, surveyed=True)
    if outcome.failure is not None or outcome.calibration is None:
        return {"profile": None, "failure": outcome.failure or "no plan"}
    known = profile_named(name)
    result = identify(known, outcome.calibration.found)
    if result.implausible:
        return {"profile": None, "failure": "; ".join(result.implausible)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibrated.toml"
        try:
            write_profile(profile_path(name), path, changes(known, result), DATE)
        except NotWritten as error:
            return {"profile": None, "failure": str(error)}
        return {"profile": path.read_text(encoding="utf-8"), "failure": None}


@contextmanager
def believed(name: str, text: str | None) -> Iterator[str]:
    """The profile that controller, guard and planner read: the shipped one, or a calibrated text in a file."""
    if text is None:
        yield str(profile_path(name))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.toml"
        path.write_text(text, encoding="utf-8")
        yield str(path)
