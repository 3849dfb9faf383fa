"""Missions of the activity manager on the forwarder stand-in."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from autonomy.localization.local_plane import LocalPlane
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import CheckpointFile, read_checkpoint
from autonomy.manager.log_map import MappedLog
from autonomy.manager.transition_table import FINAL_STATES, OURS, PAPER_B, State
from autonomy.missions.model import ForwardingMission, KnownLog, Landing, Options, Point
from autonomy.process.jobs import ForwardingJob
from can_dbc.messages.mission import MissionAction, MissionCommand
from machine.loading.profile_file import load_profile, profile_hash
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.mapped_logs import lying

PROFILE = load_profile("aoro_fc8")
CARRIER = PROFILE.carrier
assert CARRIER is not None
PLANE = LocalPlane(63.657853, 19.895562, 100.0)
LOGS = ((1, 15.0, 4.2, 0.0), (2, 18.0, -4.4, 0.5))
ANGLED_RAD = 0.52
"""Angle of paper B's logs to the path (3.1): its grapple does not turn, ..."""
TURNED_RAD = 0.5
"""... but its jaws turn a log that lies at such an angle to them."""


def place(x_m: float, y_m: float) -> Point:
    return Point(*PLANE.geodetic(x_m, y_m)[:2])


def begin(
    lie=LOGS, table=OURS, end_m: float = 26.0, landing=None, bearing_deg=None, known=(), fences=(), **options
) -> tuple[Forwarder, ActivityManager]:
    """A machine that faces east, logs along its route, and a manager in Auto."""
    way = (place(10.0, 0.0), place(end_m, 0.0))
    landings = () if landing is None else (Landing(place(*landing), bearing_deg=bearing_deg),)
    mission = ForwardingMission("test", way, fences, landings, known, Options(**options))
    return forwarder([lying(*log) for log in lie], table), managed(mission, table, plane=PLANE)


def managed(told: ForwardingMission, table=OURS, auto: bool = True, **how) -> ActivityManager:
    """A manager of a mission; without ``plane`` it makes its own."""
    manager = ActivityManager(PROFILE, profile_hash(PROFILE), told, table, **how)
    if auto:
        manager.auto()
    return manager


def forwarder(logs: list[MappedLog], table=OURS) -> Forwarder:
    machine = Forwarder(PROFILE, PLANE, logs, (0.0, 0.1, 0.05))
    if table is PAPER_B:
        machine.crane.turned_rad = TURNED_RAD
    return machine


def whole(test):
    """A mission with crane work: seconds of planning."""
    return pytest.mark.timeout(400)(pytest.mark.long(test))


def ended(manager: ActivityManager) -> bool:
    return manager.state in FINAL_STATES


def completed(machine: Forwarder, manager: ActivityManager, limit_s: float = 600.0) -> None:
    """Run the mission to its end, which is no failure."""
    machine.run(manager, ended, limit_s)
    assert manager.state is State.DONE, (manager.failure, states(manager)[-6:])


def at(state: State):
    return lambda manager: manager.state is state


def states(manager: ActivityManager) -> list[State]:
    return [change.state for change in manager.changes]


def again(
    machine: Forwarder, manager: ActivityManager, told: ForwardingMission, path: Path, table=OURS, auto: bool = False
) -> ActivityManager:
    """Another planner that only has the checkpoint file, some time later: the machine stands."""
    CheckpointFile(path).write(manager.progress(), machine.crane.now_ns, 10**18)
    progress = read_checkpoint(path, told, machine.crane.now_ns, 10**18)
    machine.drive = machine.crane.setpoint = None
    for _ in range(60):
        machine.crane.now_ns += 50_000_000
        machine._move()
    return managed(told, table, auto, progress=progress)


LISTED_LOGS = ((15.0, 4.2), (36.0, -4.2))


def outward_rad(y_m: float) -> float:
    """Yaw of a log of paper B's: its far end points outward behind a machine that has passed it."""
    return -math.copysign(ANGLED_RAD, y_m)


def listed_mission(landing=None, lie=LISTED_LOGS, end_m: float = 50.0, **options) -> ForwardingMission:
    known = tuple(KnownLog(place(x, y), "", 90.0, 2.0, 0.25) for x, y in lie)
    landings = () if landing is None else (Landing(place(*landing)),)
    way = (place(10.0, 0.0), place(end_m, 0.0))
    return ForwardingMission("test", way, (), landings, known, Options(logs="listed", **options))


def begin_job(
    *logs, end_m: float = 26.0, waits: bool = False, **told
) -> tuple[Forwarder, ForwardingJob, ActivityManager]:
    """A forwarding job of the planning process."""
    mission = ForwardingMission("test", (place(10.0, 0.0), place(end_m, 0.0)))
    manager = managed(mission, auto=False, plane=PLANE, **told)
    return forwarder([lying(*log) for log in logs]), ForwardingJob(manager, mission, begin=not waits), manager


def driving(**told) -> tuple[Forwarder, ForwardingJob, ActivityManager]:
    """A forwarding job without logs whose machine drives."""
    machine, job, manager = begin_job(**told)
    events_until(machine, job, lambda _: machine.speed_m_s > 0.3)
    return machine, job, manager


def events_until(
    machine: Forwarder, job: ForwardingJob, enough, limit: int = 20_000
) -> list[tuple[str, dict[str, Any]]]:
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
        machine.step(job)
    raise AssertionError(said[-5:])


def command(number: int, action: MissionAction) -> MissionCommand:
    return MissionCommand(number, 0, 0, action)
