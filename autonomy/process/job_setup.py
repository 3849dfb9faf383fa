"""Creates the job that the command line selects."""

from __future__ import annotations

import argparse
import time

from autonomy.crane_job.activity import Activity
from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint_file import read_checkpoint
from autonomy.manager.transition_table import TABLES
from autonomy.missions.crane_job import CraneJob
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError
from autonomy.process.event_output import emit
from autonomy.process.jobs import ForwardingJob, Job, SingleLogJob
from machine.loading.profile_file import profile_hash
from machine.profile import Profile


def make_job(options: argparse.Namespace, profile: Profile, lease_ns: int, key: bytes | None) -> Job:
    """The job of a command line; emits ``resumed`` when a mission is resumed.

    Raises:
        MissionError: the mission or its checkpoint cannot be used.
        MissionFinished: the mission of the checkpoint is finished.
    """
    code, selector = profile_hash(profile), PlannerSelection(SamplingPlanner())
    if options.mission is None:
        return SingleLogJob(Activity(profile, code, CraneJob(log_id=options.log), lease_ns, key, selector))
    if profile.carrier is None:
        raise MissionError(
            "mission.stationary-machine",
            f"{profile.name} has no carrier; a mission needs a machine that drives, such as aoro_fc8",
        )
    site = (profile.carrier.site_lat_deg, profile.carrier.site_lon_deg)
    mission = load_mission(options.mission, route_wanted=True, site=site).mission
    checkpoint = None
    if options.progress is not None:
        checkpoint = read_checkpoint(options.progress, mission, time.monotonic_ns(), time.time_ns())
    manager = ActivityManager(
        profile, code, mission, TABLES[options.manager], selector, key=key, lease_ns=lease_ns,
        unloading_selector=PlannerSelection(PilePlanner(SamplingPlanner())), progress=checkpoint,
    )  # fmt: skip
    if checkpoint is not None:
        tally = manager.tally
        emit("resumed", loaded=tally.loaded, on_board=tally.on_board, loads=len(tally.loads))
    return ForwardingJob(manager, mission)
