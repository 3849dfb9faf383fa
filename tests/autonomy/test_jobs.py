"""The jobs of the planning process and what the operator tells them: events, ends, commands, and the mode switch."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autonomy.crane_job.phases import Phase
from autonomy.manager.operator_switch import OperatorSwitch
from autonomy.manager.transition_table import State
from autonomy.perception.log_list import LogObservation
from autonomy.process.jobs import STOPPING_TIMEOUT_NS, ForwardingJob, SingleLogJob
from autonomy.process.operator_commands import MAX_AGE_NS, CommandReceiver, CommandRefused
from can_dbc.messages.crane import ModeSwitch, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.mission import MissionAction, MissionCommand, encode_mission_command
from can_dbc.messages.vehicle import DriveSetpoint
from machine.geometry.grapple import grapple_yaw
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import GROUND_LOG, StandIn, activity
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.grasp_scenes import PROFILE
from tests.autonomy.manager_missions import LOGS, begin_job, command, driving, events_until
from tests.codes import coded


@pytest.mark.long
def test_a_mission_emits_its_states_grasps_and_load_and_ends_idle() -> None:
    forwarder, job, _ = begin_job(LOGS[0])
    said = events_until(forwarder, job, lambda j: j.idle)
    assert job.done and job.failure is None
    states = [what["state"] for event, what in said if event == "state"]
    assert states[0] == "IDLE" and states[-1] == "DONE" and states.count("COLLECT") == 1
    assert [what["logs"] for event, what in said if event == "load"] == [0, 1]
    assert "grasp" in {event for event, _ in said} and ("paused", {"reason": None}) in said
    outcome = job.outcome()
    assert outcome["loaded"] == 1 and outcome["given_up"] == []
    assert outcome["driven_m"] == pytest.approx(26.0, abs=1.0)


def test_a_mission_ends_although_the_machine_does_not_stop() -> None:
    forwarder, job, _ = driving()
    job.abort("enough")
    ended_ns = forwarder.crane.now_ns
    forwarder._move = lambda: None
    events_until(forwarder, job, lambda j: j.idle)
    assert STOPPING_TIMEOUT_NS <= forwarder.crane.now_ns - ended_ns < 2 * STOPPING_TIMEOUT_NS


def test_setpoints_have_the_requested_lease() -> None:
    forwarder, job, _ = begin_job(lease_ns=150_000_000)
    events_until(forwarder, job, lambda j: forwarder.drive is not None)
    assert forwarder.drive is not None and forwarder.drive.lease_ns == 150_000_000


def test_an_ended_job_sends_no_speed() -> None:
    forwarder, job, _ = driving()
    job.abort("enough")
    crane = forwarder.crane
    sent = [decode(d) for d in job.step(crane.now_ns, crane.report(), forwarder.vehicle(), ())]
    assert all(isinstance(s, DriveSetpoint) and s.speed_m_s == 0.0 for s in sent) and sent


@pytest.mark.long
@pytest.mark.parametrize("phase", ["ABOVE", "DESCEND", "CLOSE", "CARRY", "LOWER", "OPEN"])
def test_pause_stops_the_crane_smoothly_and_auto_resumes_with_the_log(phase: str) -> None:
    forwarder, job, manager = begin_job(LOGS[0])
    events_until(forwarder, job, lambda j: manager.activity is not None and manager.activity.phase.name == phase)
    forwarder.steps(job, 10)
    assert job.execute(command(1, MissionAction.PAUSE)) == "" and not job.report(0).auto
    forwarder.steps(job, 100)  # a grip that has begun is ended; then the crane stands
    before, stands = manager.activity, forwarder.crane.q
    forwarder.steps(job, 700)  # longer than any phase may take
    assert forwarder.crane.q == stands and manager.state is State.COLLECT and manager.activity is before
    assert forwarder.crane.setpoint is not None, "it is held, not abandoned"
    assert job.execute(command(2, MissionAction.AUTO)) == ""
    events_until(forwarder, job, lambda j: j.idle)
    assert job.done and manager.tally.loaded == 1 and forwarder.in_bunk == 1


def standing(forwarder: Forwarder, job: ForwardingJob) -> bool:
    """Whether the machine has come to rest and stays there for ten seconds."""
    forwarder.steps(job, 60)
    before = forwarder.driven_m
    forwarder.steps(job, 200)
    return forwarder.speed_m_s == 0.0 and forwarder.driven_m == before


@pytest.mark.parametrize(("position", "code"), [(ModeSwitch.IDLE, "switch.idle"), (ModeSwitch.FAULTY, "switch.faulty")])
def test_the_operators_switch_holds_a_mission_whatever_is_commanded(position: ModeSwitch, code: str) -> None:
    forwarder, job, _ = driving()
    forwarder.crane.mode_switch = position
    assert standing(forwarder, job)
    told = job.report(forwarder.crane.now_ns)
    assert not told.auto and told.paused == job.execute(command(1, MissionAction.AUTO))
    told = job.report(forwarder.crane.now_ns)
    assert (told.order, told.refusal_code) == (1, code) and standing(forwarder, job)
    assert job.execute(command(2, MissionAction.PAUSE)) == "" and job.report(0).refusal_code == ""


def test_turning_the_switch_from_idle_to_auto_resumes_and_auto_alone_does_not() -> None:
    forwarder, job, manager = driving()
    forwarder.crane.mode_switch = ModeSwitch.AUTO
    forwarder.steps(job, 20)
    assert forwarder.speed_m_s > 0.3, "Auto changes nothing by itself"
    job.execute(command(1, MissionAction.PAUSE))
    assert standing(forwarder, job)
    forwarder.crane.mode_switch = ModeSwitch.FAULTY
    forwarder.step(job)
    forwarder.crane.mode_switch = ModeSwitch.AUTO
    assert standing(forwarder, job), "it was not at Idle"
    forwarder.crane.mode_switch = ModeSwitch.IDLE
    assert standing(forwarder, job)
    forwarder.crane.mode_switch = ModeSwitch.AUTO
    events_until(forwarder, job, lambda j: forwarder.speed_m_s > 0.3)
    assert job.report(0).auto and manager.state is State.SEARCH and manager.paused == ""


def test_a_repaired_switch_lets_a_command_resume() -> None:
    forwarder, job, _ = begin_job()
    forwarder.crane.mode_switch = ModeSwitch.FAULTY
    assert standing(forwarder, job) and forwarder.drive is None
    forwarder.crane.mode_switch = ModeSwitch.AUTO
    assert standing(forwarder, job) and forwarder.drive is None
    assert job.execute(command(1, MissionAction.AUTO)) == ""
    events_until(forwarder, job, lambda j: forwarder.speed_m_s > 0.3)


@pytest.mark.parametrize("position", [ModeSwitch.NOT_FITTED, ModeSwitch.AUTO])
def test_a_mission_that_waits_starts_by_the_turn_of_the_switch_or_by_command(position: ModeSwitch) -> None:
    forwarder, job, manager = begin_job(waits=True)
    forwarder.crane.mode_switch = position
    assert standing(forwarder, job) and manager.state is State.IDLE
    assert not job.begun and not job.report(0).auto and job.report(0).paused == ""
    if position is ModeSwitch.AUTO:
        forwarder.crane.mode_switch = ModeSwitch.IDLE
        assert standing(forwarder, job) and job.report(0).paused and not job.begun
        forwarder.crane.mode_switch = ModeSwitch.AUTO
    else:
        assert job.execute(command(1, MissionAction.AUTO)) == ""
    events_until(forwarder, job, lambda j: forwarder.speed_m_s > 0.3)
    assert job.begun


class Lone:
    """A single-log job, as the stand-in of the crane steps one."""

    def __init__(self) -> None:
        self.activity = activity()
        self.job = SingleLogJob(self.activity)

    @property
    def phase(self) -> Phase:
        return self.activity.phase

    @property
    def idle(self) -> bool:
        return self.job.idle

    @property
    def failure(self) -> str | None:
        return self.job.failure

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        sent = self.job.step(now_ns, report, None, logs)
        return sent[0] if sent else None

    def paused(self) -> object:
        return dict(self.job.events())["paused"]["reason"]


@pytest.mark.parametrize("position", [ModeSwitch.IDLE, ModeSwitch.FAULTY])
def test_the_operators_switch_holds_a_single_log_job_and_its_turn_resumes_it(position: ModeSwitch) -> None:
    crane, lone = StandIn(PROFILE, [GROUND_LOG]), Lone()
    crane.until(lone, Phase.ABOVE)
    crane.steps(lone, 20)
    crane.mode_switch = position
    crane.steps(lone, 60)
    stands = crane.q
    assert lone.paused()
    crane.mode_switch = ModeSwitch.AUTO if position is ModeSwitch.FAULTY else ModeSwitch.NOT_FITTED
    crane.steps(lone, 600)
    assert crane.q == stands and crane.setpoint is not None, "it is held, not abandoned"
    for crane.mode_switch in (ModeSwitch.IDLE, ModeSwitch.AUTO):
        crane.step(lone)
    crane.until(lone, Phase.DESCEND)
    assert lone.paused() is None


def test_a_single_log_job_that_finds_the_switch_at_idle_sends_nothing_before_its_turn() -> None:
    crane, lone = StandIn(PROFILE, [GROUND_LOG], mode_switch=ModeSwitch.IDLE), Lone()
    for _ in range(40):
        assert crane.step(lone) is None and lone.phase is Phase.WAIT
    assert lone.paused()
    crane.mode_switch = ModeSwitch.AUTO
    crane.step(lone)
    assert crane.setpoint is not None and lone.paused() is None


def ahead(forwarder: Forwarder, job: ForwardingJob) -> None:
    """Make the forwarder's detector one that looks ahead: its lists are in the plane, and it is asked first."""
    near = forwarder.seen

    def seen() -> tuple[LogObservation, ...] | None:
        listed = near()
        if listed is None or job.standpoint(forwarder.crane.now_ns) is None:
            return None
        base = forwarder.base()
        return tuple(
            replace(
                log,
                center_m=tuple(base.to_base(np.asarray(log.center_m)).tolist()),
                axis=tuple((base.rotation @ np.asarray(log.axis)).tolist()),
            )
            for log in listed
        )

    forwarder.seen = seen


def test_logs_seen_ahead_are_mapped_where_they_lie() -> None:
    forwarder, job, manager = begin_job(LOGS[0], uses_memory=True)
    assert job.drives
    ahead(forwarder, job)
    events_until(forwarder, job, lambda j: bool(manager.world.log_map.logs) and forwarder.speed_m_s > 0.3)
    (log,) = manager.world.log_map.logs
    (lies,) = forwarder.field.values()
    assert log.center_m[:2] == pytest.approx(lies.center_m[:2], abs=0.1)


@pytest.mark.long
def test_no_picture_is_asked_for_and_none_counts_while_the_crane_works() -> None:
    forwarder, job, manager = begin_job(LOGS[0], uses_memory=True)
    ahead(forwarder, job)
    events_until(forwarder, job, lambda j: manager.state is State.COLLECT)
    assert job.standpoint(forwarder.crane.now_ns) is None
    before = manager.world.log_map.logs
    late = (LogObservation(7, (30.0, 2.0, 0.1), (1.0, 0.0, 0.0), 2.0, 0.2),)
    job.step(forwarder.crane.now_ns, None, None, late)
    assert [log.number for log in manager.world.log_map.logs] == [log.number for log in before]
    assert manager.world.log_map.get(7) is None and manager.world.log_map.next_number == 2


@pytest.mark.long
def test_a_load_is_shown_to_the_camera_ahead_and_its_picture_maps_no_log() -> None:
    forwarder, job, manager = begin_job(LOGS[0], uses_memory=True)
    ahead(forwarder, job)
    events_until(forwarder, job, lambda j: manager.shows_load)
    crane, activity, base = forwarder.crane, manager.activity, forwarder.base()
    asked = job.standpoint(crane.now_ns)
    assert activity is not None and asked is not None and asked.load
    (x, y, z), yaw = crane.pin(), grapple_yaw(crane.profile, crane.q) - math.pi / 2 + 0.3
    center, axis = np.array([x, y, z - 1.2]), np.array([math.cos(yaw), math.sin(yaw), 0.0])
    picture = LogObservation(7, tuple(base.to_base(center)), tuple(base.rotation @ axis), 2.0, 0.2)
    before, stood = manager.world.log_map.next_number, activity.rotator
    job.step(crane.now_ns, None, None, (picture,))
    assert not manager.shows_load and manager.world.log_map.next_number == before
    turned = activity.rotator.angle(stood.sent_rad) - stood.angle_rad
    assert 0.2 < turned < 0.31 and activity.rotator.sigma_rad < stood.sigma_rad
    asked = job.standpoint(crane.now_ns)
    assert asked is None, "no other picture while the crane works"


# -- commands: fresh, ordered and signed
NOW_NS = 10**12
PAUSE = MissionCommand(5, 77, NOW_NS, MissionAction.PAUSE)


def test_a_command_is_accepted_once() -> None:
    receiver = CommandReceiver(77)
    assert receiver.accept(encode_mission_command(PAUSE), NOW_NS) == PAUSE
    with pytest.raises(CommandRefused, check=coded("command.repeated")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS)
    later = replace(PAUSE, sequence=6, action=MissionAction.AUTO)
    assert receiver.accept(encode_mission_command(later), NOW_NS) == later
    with pytest.raises(CommandRefused, check=coded("command.repeated")):
        receiver.accept(encode_mission_command(PAUSE), NOW_NS)


def test_commands_that_are_old_from_the_future_or_for_another_profile_are_refused() -> None:
    receiver, data = CommandReceiver(77), encode_mission_command(PAUSE)
    for refusing, now_ns, code in (
        (receiver, NOW_NS + 1_500_000_000, "command.too-old"),
        (receiver, NOW_NS - 1, "command.future"),
        (CommandReceiver(78), NOW_NS, "command.other-profile"),
    ):
        with pytest.raises(CommandRefused, check=coded(code)):
            refusing.accept(data, now_ns)
    assert receiver.accept(data, NOW_NS + MAX_AGE_NS) == PAUSE, "a refused command does not count as the last one"


def test_with_a_key_only_signed_commands_are_accepted() -> None:
    receiver = CommandReceiver(77, b"right")
    for wrong in (encode_mission_command(PAUSE), encode_mission_command(PAUSE, b"wrong")):
        with pytest.raises(CommandRefused, check=coded("command.datagram")):
            receiver.accept(wrong, NOW_NS)
    assert receiver.accept(encode_mission_command(PAUSE, b"right"), NOW_NS) == PAUSE


@pytest.mark.parametrize("data", [b"", b"pause", encode(OperatorCommand(1, 77, NOW_NS, OperatorAction.ARM))])
def test_other_datagrams_are_refused(data: bytes) -> None:
    with pytest.raises(CommandRefused):
        CommandReceiver(77).accept(data, NOW_NS)


# -- the mode switch
REPORT = StandIn(load_profile("palms_471"), []).report()
NONE, IDLE, AUTO, FAULTY = ModeSwitch
START = "start"


@pytest.mark.parametrize(
    ("positions", "told"),
    [
        ((NONE, NONE), ("", "")),
        ((NONE, AUTO, AUTO), ("", "", "")),
        ((IDLE, AUTO, AUTO), ("switch.idle", START, "")),
        ((IDLE, FAULTY, AUTO), ("switch.idle", "switch.faulty", "")),
        ((FAULTY, IDLE, AUTO), ("switch.faulty", "switch.idle", START)),
        ((AUTO, NONE, AUTO), ("", "", "")),
        ((IDLE, NONE, AUTO), ("switch.idle", "switch.faulty", "")),
        ((FAULTY, NONE, NONE, IDLE), ("switch.faulty", "switch.faulty", "switch.faulty", "switch.idle")),
    ],
)
def test_only_the_turn_from_idle_to_auto_starts(positions: tuple[ModeSwitch, ...], told: tuple[str, ...]) -> None:
    switch, found = OperatorSwitch(), []
    for position in positions:
        switch.take(replace(REPORT, mode_switch=int(position)))
        found.append(START if switch.started else switch.hold.code if switch.hold else "")
        before = switch.hold
        switch.take(None)
        assert not switch.started and switch.hold is before, "without a report nothing changes"
    assert tuple(found) == told
