"""Creates the job that the command line selects."""

from __future__ import annotations

import argparse
import time

from autonomy.crane_job.activity import Activity
from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import Checkpoint, read_checkpoint
from autonomy.manager.transition_table import TABLES
from autonomy.missions.crane_job import CraneJob
from autonomy.missions.folder import MissionFolder
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.process.command_line import emit
from autonomy.process.jobs import ForwardingJob, Job, SingleLogJob
from autonomy.process.upload import UploadedMissions, WaitingJob, tell_losses
from machine.loading.profile_file import profile_hash
from machine.profile import Profile


def make_job(options: argparse.Namespace, profile: Profile, lease_ns: int, key: bytes | None) -> Job:
    """Make the job of a command line; emit ``mission`` for what its file loses and ``resumed`` when a mission is
    resumed.

    Raises:
        MissionError: the mission or its checkpoint cannot be used.
        ConfigError, InputRefused: the grasp planner cannot be loaded.
        InputRefused: the mission of the checkpoint is finished (``checkpoint.finished``).
    """
    if options.mission is None and options.missions is None:
        code, selector = profile_hash(profile), PlannerSelection(options.planner.make())
        return SingleLogJob(Activity(profile, code, CraneJob(log_id=options.log), lease_ns, key, selector))
    if profile.carrier is None:
        raise MissionError(
            "mission.stationary-machine",
            f"{profile.name} has no carrier; a mission needs a machine that drives, such as aoro_fc8",
        )
    if options.mission is None:
        return WaitingJob()
    site = (profile.carrier.site_lat_deg, profile.carrier.site_lon_deg)
    draft = load_mission(options.mission, route_wanted=True, site=site)
    tell_losses(draft)
    mission = draft.mission
    checkpoint = None
    if options.progress is not None:
        checkpoint = read_checkpoint(options.progress, mission, time.monotonic_ns(), time.time_ns())
    manager = _manager(options, profile, mission, lease_ns, key, checkpoint)
    if checkpoint is not None:
        tally = manager.tally
        emit("resumed", loaded=tally.loaded, on_board=tally.on_board, loads=len(tally.loads))
    return ForwardingJob(manager, mission)


def uploaded_missions(
    options: argparse.Namespace, profile: Profile, lease_ns: int, key: bytes | None
) -> UploadedMissions | None:
    """Return the missions that may be uploaded; None without a folder of them."""
    if options.missions is None or profile.carrier is None:
        return None
    site = (profile.carrier.site_lat_deg, profile.carrier.site_lon_deg)
    return UploadedMissions(
        MissionFolder(options.missions),
        site,
        lambda mission: ForwardingJob(_manager(options, profile, mission, lease_ns, key), mission, begin=False),
    )


def _manager(
    options: argparse.Namespace,
    profile: Profile,
    mission: ForwardingMission,
    lease_ns: int,
    key: bytes | None,
    checkpoint: Checkpoint | None = None,
) -> ActivityManager:
    return ActivityManager(
        profile,
        profile_hash(profile),
        mission,
        TABLES[options.manager],
        PlannerSelection(options.planner.make()),
        key=key,
        lease_ns=lease_ns,
        uses_memory=options.memory,
        unloading_selector=PlannerSelection(PilePlanner(SamplingPlanner())),
        progress=checkpoint,
    )
