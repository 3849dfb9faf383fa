"""One task of the whole machine in lockstep, as plain data."""

from __future__ import annotations

from typing import Any

from experiments.common.mission_trial import run_mission
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from experiments.productivity.tasks import task


def perform(job: Job) -> dict[str, Any]:
    """``options``: profile, truth, amount, way, limit_s; the kind of the job is that of the task."""
    o = job.options
    mission, site = task(job.kind, profile_named(o["profile"]), o["truth"], job.seed, o["amount"])
    return run_mission(job, mission, site)
