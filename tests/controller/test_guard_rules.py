"""The guard's rules together: after exactly how many steps, which comes first, its beginning and its return."""

from __future__ import annotations

from itertools import pairwise

import pytest

from can_dbc.frame import EXTENDED, Frame
from controller.guard.__main__ import build, profile_path
from controller.guard.guard import HEARTBEAT_KEY, MESSAGES
from controller.guard.verdicts import DRIVE_AXIS, LATCHING, NO_AXIS, Verdict
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import BROKEN, CODECS, DRIVE_BROKEN, DRIVING, GOOD_B, MOVING, Traffic

CASES = BROKEN | DRIVE_BROKEN


@pytest.mark.parametrize("name", sorted(CASES))
def test_every_rule_counts_after_its_time_and_not_before(name: str) -> None:
    verdict, axis, steps, break_it = CASES[name]
    traffic = Traffic("aoro_fc8" if name in DRIVE_BROKEN else "palms_471").good()
    events = traffic.guard.events
    break_it(traffic)
    assert count_until(traffic.tick, lambda: traffic.guard.verdict is not Verdict.GOOD, limit=600) == steps
    assert (traffic.guard.verdict, traffic.guard.axis, traffic.guard.events) == (verdict, axis, events + 1)
    assert traffic.status[-1]["EventCount"] == events + 1
    for frame in (*traffic.status[-1:], *traffic.alive[-1:]):
        assert (frame["Enable"], frame["Verdict"], frame["FaultAxis"]) == (0, verdict, axis)
    at_once = {"GuardStat", "GuardAlive"} if traffic.has_carrier else {"GuardStat"}
    assert {CODECS[name].key for name in at_once} <= {key for key, _ in traffic.sent}, "on both buses"


# -- the beginning -----------------------------------------------------------------------------------------------------


def test_it_begins_without_command_supply_or_event() -> None:
    traffic = Traffic()
    traffic.now_ns = -T
    traffic.dropped = {*CODECS}
    traffic.extra = [traffic.frame("EstopStat", traffic.estop) for _ in range(2)]  # trusted in the first step
    assert traffic.tick() is Verdict.NO_COMMAND and traffic.guard.axis == NO_AXIS
    status, pilot = traffic.status[-1], traffic.pilot[-1]
    assert (status["Enable"], status["EventCount"], status["SeenCounter"], pilot["Supply"]) == (0, 0, 0, 0)
    assert (HEARTBEAT_KEY, b"\x00") in traffic.sent


def test_its_status_has_its_own_period_from_the_first_step_on() -> None:
    traffic = Traffic()
    traffic.now_ns = 0
    traffic.dropped = {*CODECS}
    traffic.extra = [traffic.frame("EstopStat", traffic.estop) for _ in range(2)]
    told = []
    for _ in range(6):
        traffic.tick()
        told.append(any(key == CODECS["GuardStat"].key for key, _ in traffic.sent))
    assert told == [True, True, False, True, False, True], "at 5 ms, then every 10 ms"


def test_its_heartbeat_comes_every_100_ms() -> None:
    traffic = Traffic()
    sent = []
    for k in range(61):
        traffic.tick()
        sent += [(k, data) for key, data in traffic.sent if key == HEARTBEAT_KEY]
    assert sent == [(0, b"\x00"), (20, b"\x05"), (40, b"\x05"), (60, b"\x05")], "the first is the boot-up frame"


@pytest.mark.parametrize(
    ("person", "mode", "limit_ns", "verdict"),
    [(1, 3, 300 * MS, Verdict.PERSON), (0, 4, 200 * MS, Verdict.DISAGREE)],
)
def test_what_nobody_has_said_yet_was_last_true_at_time_0(
    person: int, mode: int, limit_ns: int, verdict: Verdict
) -> None:
    """Commands that move from the first step on."""
    for late_ns, told in ((0, False), (1, True)):
        traffic = Traffic()
        traffic.a.update(MOVING)
        traffic.estop["Person"], traffic.controller["Mode"] = person, mode
        traffic.now_ns = limit_ns - 3 * T + late_ns
        traffic.tick(3)
        assert (traffic.guard.verdict is verdict) is told, traffic.guard.verdict


# -- which comes first -------------------------------------------------------------------------------------------------


def gap(traffic: Traffic) -> None:
    """The next command A comes after three that are lost: STALE, which does not latch."""
    traffic.dropped.add("ValveCmdA")
    for _ in range(3):
        traffic.frame("ValveCmdA", traffic.a)
    traffic.tick()
    traffic.dropped.clear()


def other_guard(traffic: Traffic) -> None:
    traffic.extra.append(Frame(traffic.now_ns, HEARTBEAT_KEY, b"\x05"))


def test_of_two_frames_the_one_that_latches_counts() -> None:
    traffic = Traffic().good()
    gap(traffic)
    other_guard(traffic)
    assert traffic.tick() is Verdict.OTHER_GUARD
    traffic = Traffic().good()
    other_guard(traffic)
    traffic.b["Aux"] = 1.0
    traffic.estop["ChannelA"] = 0
    assert traffic.tick() is Verdict.OTHER_GUARD, "a frame before a state"
    traffic = Traffic().good()
    traffic.a |= {"Mode": 2, "Lift": None}
    other_guard(traffic)
    assert traffic.tick() is Verdict.RANGE, "the first of those that latch"


def test_a_state_that_latches_counts_before_a_frame_that_does_not() -> None:
    traffic = Traffic().good()
    gap(traffic)
    traffic.estop["ChannelB"] = 0
    assert traffic.tick() is Verdict.ESTOP
    traffic = Traffic().good()
    gap(traffic)
    traffic.dropped.add("EstopStat")
    assert traffic.tick() is Verdict.STALE


ORDER = (
    ("estop gone", Verdict.ESTOP_LOST),
    ("estop pressed", Verdict.ESTOP),
    ("spool open without a command", Verdict.SPOOL),
    ("command B gone", Verdict.NO_COMMAND),
    ("unknown mode", Verdict.RANGE),
    ("not armed", Verdict.NOT_ARMED),
)


@pytest.mark.parametrize("first", range(len(ORDER) - 1))
def test_of_broken_states_the_first_of_the_order_counts(first: int) -> None:
    name, verdict = ORDER[first]
    traffic = Traffic().good()
    for later, _ in ORDER[first + 1 :]:
        if later != "not armed":
            CASES[later][3](traffic)
    CASES[name][3](traffic)
    assert traffic.tick(20) is verdict


@pytest.mark.parametrize(
    ("values", "axis"),
    [({"Aux": 1.0, "Grapple": None}, 6), ({"Grapple": None, "Rot": 11.0, "ArmKey": 0}, 5)],
)
def test_a_function_that_does_not_exist_counts_before_a_missing_key(values: dict, axis: int) -> None:
    traffic = Traffic().good()
    traffic.b.update(values)
    assert traffic.tick() is Verdict.RANGE and traffic.guard.axis == axis


@pytest.mark.parametrize(("values", "verdict"), [({}, Verdict.STALE), ({"Speed": 1.2}, Verdict.RANGE)])
def test_a_late_command_of_the_carrier_is_stale_if_nothing_else_is_wrong(values: dict, verdict: Verdict) -> None:
    traffic = Traffic("aoro_fc8").good()
    while traffic.ticks % 4:
        traffic.tick()
    for lost in (2, 1):  # 40 ms late, less what is forgiven, then 60 ms
        traffic.dropped.add("VehCmd")
        assert traffic.tick(4 * lost) is Verdict.GOOD
        traffic.dropped.clear()
        if lost == 1:
            traffic.drive.update(values)
        traffic.tick(4 if lost == 2 else 1)
    assert traffic.guard.verdict is verdict


def test_a_crane_that_is_not_heard_does_not_move_beside_the_carrier() -> None:
    traffic = Traffic("aoro_fc8").good()
    DRIVE_BROKEN["crane while it drives"][3](traffic)
    traffic.dropped.add("ValveCmdA")
    traffic.tick(100)
    traffic.dropped.clear()
    assert traffic.tick(2) is Verdict.CALMING
    assert count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.BOTH) == 60


def test_a_person_beside_a_machine_that_stands_breaks_no_rule() -> None:
    traffic = Traffic("aoro_fc8").good()
    traffic.estop["Person"] = 1
    assert traffic.tick(600) is Verdict.GOOD
    traffic.drive.update(DRIVING)
    count_until(traffic.tick, lambda: not traffic.guard.enabled, 5)
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.PERSON, DRIVE_AXIS), "one that drives off does"


def test_a_bad_frame_makes_no_later_command_punctual() -> None:
    """Commands are 35 ms late, then one has a wrong checksum, then they are 45 ms late."""
    traffic = Traffic().good()
    late_ticks = {"ValveCmdA", "ValveCmdB"}
    traffic.dropped = set(late_ticks)
    traffic.tick(7)
    traffic.dropped = set()
    assert traffic.tick(3) is Verdict.GOOD
    traffic.dropped = set(late_ticks)
    bad = traffic.frame("ValveCmdA", traffic.a)
    traffic.extra = [Frame(traffic.now_ns + T, bad.key, bytes((bad.data[0] ^ 1,)) + bad.data[1:])]
    assert traffic.tick() is Verdict.GOOD
    traffic.tick(2)
    traffic.dropped = set()
    assert traffic.tick() is Verdict.STALE


def test_silence_does_not_latch_and_what_is_heard_does():
    """Whatever merely stayed away may come back by itself; a rule that a frame has broken needs a person."""
    silent = {"NO_COMMAND", "ENCODER", "STALE", "ESTOP_LOST", "CARRIER_LOST"}
    states = {"GOOD", "CALMING", "LATCHED"}
    assert {verdict.name for verdict in Verdict} - {verdict.name for verdict in LATCHING} == silent | states


# -- how it returns


def silenced(machine: str) -> Traffic:
    """Just after a silence of its command A."""
    traffic = Traffic(machine).good()
    traffic.dropped.add("ValveCmdA")
    assert traffic.tick(11) is Verdict.NO_COMMAND
    traffic.dropped.clear()
    return traffic


def test_it_returns_after_200_ms_of_neutral_commands() -> None:
    traffic = silenced("palms_471")
    traffic.tick(1)
    assert count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.CALMING) == 1
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) == 39


@pytest.mark.parametrize(
    "command", [{"a": MOVING}, {"b": {"Grapple": 5.0}}, {"b": {"GrappleMode": 1}}, {"b": {"Rot": 11.0}}]
)
def test_commands_that_are_not_neutral_begin_its_wait_anew(command: dict) -> None:
    traffic = silenced("palms_471")
    traffic.tick(30)
    for name, values in command.items():
        getattr(traffic, name).update(values)
    assert traffic.tick(100) is Verdict.CALMING
    traffic.a, traffic.b = {"Mode": 0}, dict(GOOD_B)
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) == 40


@pytest.mark.parametrize("command", [{"drive": {"Brake": 0.0}}, {"arms_b": {"ArmKey": 0xA, "FloatRear": 1}}])
def test_commands_of_the_carrier_begin_its_wait_anew_too(command: dict) -> None:
    traffic = silenced("aoro_fc8")
    for name, values in command.items():
        getattr(traffic, name).update({"ArmKey": 0xA} | values)
    traffic.arms_a["ArmKey"] = 0xA
    assert traffic.tick(100) is Verdict.CALMING


def test_events_count_every_change_and_begin_again_after_255() -> None:
    traffic = Traffic().good()
    seen = [traffic.status[-1]["EventCount"]]
    for _ in range(130):
        traffic.b["ArmKey"], traffic.a = 0, dict(MOVING)
        traffic.tick()
        traffic.b["ArmKey"], traffic.a = 0xA, {"Mode": 0}
        traffic.tick()
        seen.append(traffic.status[-1]["EventCount"])
    steps = {(b - a) % 256 for a, b in pairwise(seen)}
    assert steps == {2} and max(seen) <= 255


def test_the_seen_counter_is_that_of_the_newest_command_a() -> None:
    traffic = Traffic().good()
    for _ in range(20):
        traffic.tick()
        if any(key == CODECS["GuardStat"].key for key, _ in traffic.sent):
            assert traffic.status[-1]["SeenCounter"] == (traffic.senders["ValveCmdA"].counter - 1) & 0xF


def test_it_receives_what_it_watches_and_what_is_its_own_from_each_bus() -> None:
    crane, machine = build(profile_path("aoro_fc8")).keys_of_buses
    names = {name for name, codec in CODECS.items() if codec.key in crane or codec.key in machine}
    encoders = {"EncSlew", "EncLift", "EncTilt", "EncExt"}
    carrier = {"VehCmd", "ArmCmdA", "ArmCmdB", "VehStat", "GuardAlive"}
    assert names == {*MESSAGES, *encoders, *carrier, "HeartbeatGuard"}
    assert not any(key & EXTENDED for key in crane) and all(key & EXTENDED for key in machine)
