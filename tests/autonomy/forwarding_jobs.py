"""Forwarding jobs of the planning process on the forwarder stand-in."""

from __future__ import annotations

from typing import Any

from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.transition_table import OURS
from autonomy.missions.model import ForwardingMission, Point
from autonomy.process.jobs import ForwardingJob
from can_dbc.messages.mission import MissionAction, MissionCommand
from machine.loading.profile_file import profile_hash
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import PLANE, PROFILE
from tests.autonomy.mapped_logs import lying


def begin(
    *logs, end_m: float = 26.0, waits: bool = False, **told: Any
) -> tuple[Forwarder, ForwardingJob, ActivityManager]:
    way = tuple(Point(*PLANE.geodetic(x, 0.0)[:2]) for x in (10.0, end_m))
    mission = ForwardingMission("test", way)
    manager = ActivityManager(PROFILE, profile_hash(PROFILE), mission, OURS, plane=PLANE, **told)
    forwarder = Forwarder(PROFILE, PLANE, [lying(*log) for log in logs], (0.0, 0.1, 0.05))
    return forwarder, ForwardingJob(manager, mission, begin=not waits), manager


def run(forwarder: Forwarder, job: ForwardingJob, enough, limit: int = 20_000) -> list[tuple[str, dict[str, Any]]]:
    """The events until ``enough(job)``, each time that they change."""
    told: dict[str, Any] = {}
    said = []
    for _ in range(limit):
        for event, what in job.events():
            if told.get(event) != what:
                told[event] = what
                said.append((event, dict(what)))
        if enough(job):
            return said
        forwarder.step(job)  # type: ignore[arg-type]
    raise AssertionError(said[-5:])


def command(number: int, action: MissionAction) -> MissionCommand:
    return MissionCommand(number, 0, 0, action)
