"""The guard's rules together: which comes first, after exactly how many steps, and what begins at its start."""

from __future__ import annotations

import pytest

from can_dbc.frame import Frame
from controller.guard.guard import HEARTBEAT_KEY
from controller.guard.verdicts import LATCHING, NO_AXIS, Verdict
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import (
    BROKEN,
    CODECS,
    DRIVE_BROKEN,
    MOVING,
    Traffic,
)

CASES = BROKEN | DRIVE_BROKEN
EXACT_STEPS = {
    "command A gone": 4,
    "command B gone": 4,
    "estop gone": 7,
    "encoder gone": 19,
    "outside": 2,
    "joint moves without a command": 3,
    "too fast a motion": 3,
    "person in the zone": 61,
    "pin into the ground": 2,
    "failed detector of persons": 61,
    "controller says it has stopped": 41,
    "controller says nothing": 61,
    "drive command gone": 16,
    "arm command gone": 16,
    "state gone": 18,
    "rolls although it brakes": 301,
    "person while it drives": 441,
}
"""Steps of 5 ms until a limit of `controller.guard` is exceeded; all others count at once."""


@pytest.mark.parametrize("name", sorted(CASES.keys() - {"crane while it drives"}))
def test_every_rule_counts_after_its_time_and_not_before(name: str) -> None:
    traffic = Traffic("aoro_fc8" if name in DRIVE_BROKEN else "palms_471").good()
    events = traffic.guard.events
    CASES[name][3](traffic)
    steps = count_until(traffic.tick, lambda: traffic.guard.verdict is not Verdict.GOOD, limit=600)
    assert steps == EXACT_STEPS.get(name, 1)
    status = traffic.status[-1]
    assert (status["EventCount"], status["Enable"], status["Verdict"]) == (events + 1, 0, CASES[name][0])


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
        sent += [k for key, _ in traffic.sent if key == HEARTBEAT_KEY]
    assert sent == [0, 20, 40, 60]


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


def test_lost_commands_are_stale() -> None:
    traffic = Traffic().good()
    gap(traffic)
    assert traffic.tick() is Verdict.STALE


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
    traffic.tick()
    assert traffic.guard.verdict is Verdict.STALE


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
    traffic.tick(20)
    assert traffic.guard.verdict is verdict


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
    traffic.tick(2)
    assert traffic.guard.verdict is Verdict.CALMING
    assert count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.BOTH) == 60


def test_a_person_beside_a_machine_that_stands_breaks_no_rule() -> None:
    traffic = Traffic("aoro_fc8").good()
    traffic.estop["Person"] = 1
    assert traffic.tick(600) is Verdict.GOOD


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
