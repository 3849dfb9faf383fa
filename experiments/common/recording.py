"""Recordings of single trials: a job with the option ``record`` leaves its run in that folder, as a run on the bus."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from experiments.common.pool import Job
from hil.replay.recording import PROFILE_FILE
from machine.profile import Profile
from recorder.manifest import describe
from recorder.recorder import Recorder

RECORD: Final = "record"
"""Option of a job: the folder of its recording.  It changes nothing of the outcome."""


@contextmanager
def recorder_of(job: Job, profile: Profile, file: str | Path) -> Iterator[Recorder | None]:
    """Open the recorder of a trial, closed at the end; None unless the job asks for a recording.

    ``file``: of the profile, which is kept beside the recording: that of a calibrated machine is nowhere else.
    """
    if RECORD not in job.options:
        yield None
        return
    buses = tuple(name for name in (profile.crane_bus, profile.machine_bus) if name)
    folder = Path(job.options[RECORD])
    recorder = Recorder(folder, profile, describe(profile, buses, job.seed))
    try:
        shutil.copyfile(file, folder / PROFILE_FILE)
        yield recorder
    finally:
        recorder.close()
