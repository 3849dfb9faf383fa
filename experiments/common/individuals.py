"""Individual machines: calibration before a trial, and the calibrated profile as a file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import identify
from controller.guard.__main__ import profile_path
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.calibration import run_lockstep
from machine.loading.profile_file import carry_envelope
from runtime.errors import InputRefused

DATE: Final = "2000-01-01"
"""Date written into the calibrated profile; the outcome of a run must not depend on the day."""


def calibrated(job: Job) -> dict[str, Any]:
    """Calibrate one individual machine; options: profile, truth.

    ``profile`` in the outcome is the text that `timberhand calibrate` would write, or None with the reason in
    ``failure``.
    """
    name = job.options["profile"]
    outcome = run_lockstep(name, job.options["truth"], job.seed, surveyed=True)
    if outcome.failure is not None or outcome.calibration is None:
        return {"profile": None, "failure": outcome.failure or "no plan"}
    known = profile_named(name)
    result = identify(known, outcome.calibration.found)
    if result.implausible:
        return {"profile": None, "failure": "; ".join(problem.sentence for problem in result.implausible)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibrated.toml"
        try:
            write_profile(profile_path(name), path, profile_changes(known, result), DATE)
        except InputRefused as error:
            return {"profile": None, "failure": str(error)}
        return {"profile": path.read_text(encoding="utf-8"), "failure": None}


@contextmanager
def controller_profile(name: str, text: str | None) -> Iterator[str]:
    """Return the path of the profile for controller, guard and planner: the shipped one, or a file with the calibrated
    ``text``.
    """
    source = profile_path(name)
    if text is None:
        yield str(source)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / source.name
        path.write_text(text, encoding="utf-8")
        carry_envelope(source, path.parent)
        yield str(path)
