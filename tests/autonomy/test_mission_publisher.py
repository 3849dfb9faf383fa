"""The mission report: state, positions, and a size that fits a datagram; and the chosen grasp as it is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import pi

import numpy as np
import pytest

from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.manager.transition_table import EVENT_DESCRIPTIONS, RULES, Event, State
from autonomy.manager.world_model import MAX_ATTEMPTS
from autonomy.missions.model import Fence, ForwardingMission, Landing, Options
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from autonomy.process.jobs import ABORTED, MISSION_ENDED, NO_PENDING_STEP, ONLY_ABORT, ForwardingJob, SingleLogJob
from autonomy.process.mission_publisher import CRANE_PHASES, chosen_grasp
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import (
    MAX_CORNERS,
    MAX_LOGS,
    MAX_ROUTE_POINTS,
    MissionAction,
    decode_grasp,
    decode_mission,
    encode_grasp,
    encode_mission,
)
from machine.geometry.grapple import rotator_for_yaw
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from tests.autonomy.manager_missions import (
    LOGS,
    PLANE,
    begin_job,
    command,
    driving,
    events_until,
    forwarder,
    managed,
    place,
)
from tests.autonomy.mapped_logs import lying


def near(where, x_m, y_m, within_m=0.15) -> bool:
    return math.dist(PLANE.local(*where)[:2], (x_m, y_m)) < within_m


@pytest.mark.long
def test_the_report_has_the_machine_position_and_the_mapped_logs() -> None:
    forwarder, job, manager = begin_job(LOGS[0])
    events_until(forwarder, job, lambda j: manager.state is State.APPROACH)
    told = job.report(forwarder.crane.now_ns)
    assert (told.name, told.state, told.words) == ("test", "APPROACH", RULES[State.APPROACH].description)
    assert told.auto and not told.paused and not told.ended and told.crane == ""
    assert near(told.route[0], 10.0, 0.0, 0.01) and near(told.route[1], 26.0, 0.0, 0.01) and not told.closed
    assert told.here is not None and near(told.here.place, forwarder.x_m, forwarder.y_m)
    assert told.here.heading_deg == pytest.approx(90.0 - math.degrees(forwarder.yaw_rad), abs=1.0)
    (log,) = told.logs
    true = next(iter(forwarder.field.values()))
    assert (log.number,) == told.targets and near(log.place, *true.center_m[:2])
    bearing = 90.0 - math.degrees(math.atan2(true.axis[1], true.axis[0]))
    assert math.sin(math.radians(log.bearing_deg - bearing)) == pytest.approx(0.0, abs=0.05)
    assert (log.length_m, log.diameter_m) == (pytest.approx(true.length_m, abs=0.05), pytest.approx(0.25, abs=0.02))
    assert log.age_s < 1.0 and not log.given_up


@pytest.mark.long
def test_the_targets_are_the_logs_of_the_grasp() -> None:
    """It may begin with another log than the one that the machine stopped for."""
    forwarder, job, manager = begin_job(LOGS[0], (9, LOGS[0][1], -LOGS[0][2], 0.0))
    events_until(forwarder, job, lambda j: manager.activity is not None and manager.activity.grasp is not None)
    (taken,) = manager.activity.grasp.logs
    told = job.report(forwarder.crane.now_ns)
    (aimed,) = (log for log in told.logs if log.number in told.targets)
    assert near(aimed.place, *forwarder.base().to_base(np.array(taken.center_m))[:2])
    assert told.crane == CRANE_PHASES[Phase.ABOVE] and len(told.logs) == 2


@pytest.mark.long
def test_commands_are_executed_and_reported() -> None:
    forwarder, job, manager = driving()

    def give(number: int, action: MissionAction) -> str:
        refusal = job.execute(command(number, action))
        told = job.report(forwarder.crane.now_ns)
        assert (told.order, told.refusal) == (number, refusal)
        return refusal

    assert give(1, MissionAction.PAUSE) == "" and not job.report(0).auto
    driven_m = forwarder.driven_m
    events_until(forwarder, job, lambda j: forwarder.speed_m_s == 0.0)
    assert forwarder.driven_m - driven_m < 1.0
    assert job.report(forwarder.crane.now_ns).paused
    assert give(2, MissionAction.NEXT_STEP) == NO_PENDING_STEP
    assert give(3, MissionAction.SINGLE_STEP) == "" and job.report(0).single_step
    assert give(4, MissionAction.AUTO) == "" and job.report(0).auto
    events_until(forwarder, job, lambda j: manager.pending_event is not None)
    assert manager.state is State.SEARCH
    assert job.report(forwarder.crane.now_ns).waits_for == EVENT_DESCRIPTIONS[Event.ROUTE_END]
    assert give(5, MissionAction.NEXT_STEP) == ""
    events_until(forwarder, job, lambda j: manager.state is State.DONE)
    assert give(6, MissionAction.AUTO) == MISSION_ENDED and job.report(0).ended


def test_there_is_a_report_before_the_machine_is_located() -> None:
    mission = ForwardingMission("test", (place(10.0, 0.0),))
    manager, machine = managed(mission, auto=False), forwarder([])
    job = ForwardingJob(manager, mission)
    assert job.report(0).here is None
    blind = replace(machine.vehicle(), fix=0, latitude_deg=math.nan, heading_rad=math.nan)
    job.step(machine.crane.now_ns, machine.crane.report(), blind, ())
    told = job.report(machine.crane.now_ns)
    assert manager.world.location is not None and told.here is None and told.logs == () and told.paused


def test_run_through_needs_no_more_steps() -> None:
    forwarder, job, manager = begin_job()
    job.execute(command(1, MissionAction.SINGLE_STEP))
    events_until(forwarder, job, lambda j: manager.pending_event is Event.AUTO)
    job.execute(command(2, MissionAction.RUN_THROUGH))
    events_until(forwarder, job, lambda j: forwarder.speed_m_s > 0.3)
    assert not job.report(0).single_step


def test_a_commanded_abort_is_reported_as_the_operators() -> None:
    forwarder, job, manager = driving()
    assert job.execute(command(1, MissionAction.ABORT)) == "" and not job.idle and not job.done
    events_until(forwarder, job, lambda j: j.idle)
    told = job.report(forwarder.crane.now_ns)
    assert told.ended and told.failure == job.failure == ABORTED
    assert manager.state is State.FAILED and forwarder.speed_m_s < 0.05


def test_a_single_log_job_only_accepts_abort() -> None:
    class Crane:
        failure = ""

        def abort(self, reason: str) -> None:
            self.failure = reason

    job = SingleLogJob(crane := Crane())
    assert job.execute(command(1, MissionAction.PAUSE)) == ONLY_ABORT and not crane.failure
    assert job.execute(command(2, MissionAction.ABORT)) == "" and crane.failure == ABORTED
    assert job.report(0) is None


@pytest.mark.long
def test_the_longest_mission_fits_in_a_datagram() -> None:
    corners = tuple(place(9e3 * math.cos(a), 9e3 * math.sin(a)) for a in np.linspace(0, 6, 2000))
    mission = ForwardingMission(
        "w" * 500,
        corners,
        tuple(Fence(corners[:50], True, '"' * 300) for _ in range(200)),
        tuple(Landing(corners[0], "x" * 300) for _ in range(90)),
        options=Options(laps=3),
    )
    manager, machine = managed(mission, auto=False, plane=PLANE), forwarder([])
    job = ForwardingJob(manager, mission)
    machine.steps(job, 20)
    for k in range(500):
        manager.world.log_map.add_known(replace(lying(k, 100.0 - 0.2 * k, 3.0), misses=MAX_ATTEMPTS))
        manager.tally.given_up[k] = "ß\n" * 400
    told = job.report(machine.crane.now_ns)
    assert decode_mission(encode_mission(told, 1, 2, 3, b"key"), b"key") == (2, 3, told)
    assert (len(told.route), len(told.logs)) == (MAX_ROUTE_POINTS, MAX_LOGS) and told.closed
    assert sum(len(f.corners) for f in told.fences) <= MAX_CORNERS
    assert near(told.route[0], *PLANE.local(corners[0].latitude_deg, corners[0].longitude_deg)[:2])
    assert near(told.route[-1], *PLANE.local(corners[-1].latitude_deg, corners[-1].longitude_deg)[:2])
    assert all(near(log.place, 0.0, 0.0, 31.0) for log in told.logs), "the nearest logs are reported"
    assert [g.log for g in told.given_up][-1] == 499 and told.given_up[0].reason.endswith("…")


# -- the chosen grasp
LOADER = load_profile("palms_471")
LOG = LogObservation(3, (-1.0, 4.0, -0.3), (0.6, 0.8, 0.0), 3.0, 0.2)


@dataclass
class Crane:
    phase: Phase
    grasp: Grasp | None
    profile: Profile = LOADER


def crane(phase: Phase = Phase.DESCEND) -> Crane:
    pose = Arm(LOADER).pose_above(-1.0, 4.0, 0.5, 1.2)
    turned = pose._replace(rot_rad=rotator_for_yaw(LOADER, pose.slew_rad, 2.2))
    return Crane(phase, Grasp(LOG, turned, -0.4, 0.0, (replace(LOG, id=8),), reason="two logs"))


def test_the_grasp_is_shown_where_the_pin_will_be() -> None:
    shown = chosen_grasp(crane())
    assert shown.pin_m == pytest.approx((-1.0, 4.0, 0.5), abs=1e-3)
    assert (shown.yaw_rad - 2.2 + pi / 2) % pi - pi / 2 == pytest.approx(0.0, abs=1e-3)
    assert (shown.logs, shown.reason) == ((3, 8), "two logs")


@pytest.mark.parametrize("phase", [Phase.LOOK, Phase.LIFT, Phase.CARRY, Phase.DONE, Phase.FAILED])
def test_it_is_shown_only_until_the_jaws_have_closed(phase: Phase) -> None:
    assert chosen_grasp(crane(phase)) is None
    assert chosen_grasp(None) is None


def test_the_datagram_is_whole_or_refused() -> None:
    shown = chosen_grasp(crane())
    data = encode_grasp(shown, 1, 2, 3, b"key")
    assert decode_grasp(data, b"key") == (2, 3, shown)
    for damaged in (data[:-1], data[:40] + b"x" + data[41:], encode_grasp(shown, 1, 2, 3)):
        with pytest.raises(DatagramRefused):
            decode_grasp(damaged, b"key")
    with pytest.raises(DatagramRefused):
        decode_mission(data, b"key")
