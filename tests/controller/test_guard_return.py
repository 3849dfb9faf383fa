"""How the guard returns: its wait, its reset, its supply, its counts and what it receives."""

from __future__ import annotations

from itertools import pairwise

import pytest

from can_dbc.frame import EXTENDED
from controller.guard.__main__ import build, profile_path
from controller.guard.guard import MESSAGES
from controller.guard.verdicts import Verdict
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import (
    CODECS,
    GOOD_B,
    MOVING,
    Traffic,
    press_reset,
)


def test_it_returns_after_200_ms_of_neutral_commands() -> None:
    traffic = Traffic().good()
    traffic.dropped.add("ValveCmdA")
    traffic.tick(11)
    assert traffic.guard.verdict is Verdict.NO_COMMAND
    traffic.dropped.clear()
    traffic.tick(1)
    assert count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.CALMING) == 1
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) == 39


@pytest.mark.parametrize(
    "command", [{"a": MOVING}, {"b": {"Grapple": 5.0}}, {"b": {"GrappleMode": 1}}, {"b": {"Rot": 11.0}}]
)
def test_commands_that_are_not_neutral_begin_its_wait_anew(command: dict) -> None:
    traffic = Traffic().good()
    traffic.dropped.add("ValveCmdA")
    traffic.tick(11)
    traffic.dropped.clear()
    traffic.tick(30)
    for name, values in command.items():
        getattr(traffic, name).update(values)
    traffic.tick(100)
    assert traffic.guard.verdict is Verdict.CALMING
    traffic.a, traffic.b = {"Mode": 0}, dict(GOOD_B)
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) == 40


@pytest.mark.parametrize("command", [{"drive": {"Brake": 0.0}}, {"arms_b": {"ArmKey": 0xA, "FloatRear": 1}}])
def test_commands_of_the_carrier_begin_its_wait_anew_too(command: dict) -> None:
    traffic = Traffic("aoro_fc8").good()
    traffic.dropped.add("ValveCmdA")
    traffic.tick(11)
    traffic.dropped.clear()
    for name, values in command.items():
        getattr(traffic, name).update({"ArmKey": 0xA} | values)
    traffic.arms_a["ArmKey"] = 0xA
    traffic.tick(100)
    assert traffic.guard.verdict is Verdict.CALMING


def test_reset_counts_only_while_commands_are_neutral() -> None:
    traffic = Traffic().good()
    traffic.estop["ChannelA"] = 0
    traffic.tick()
    traffic.estop["ChannelA"] = 1
    traffic.a.update(MOVING)
    traffic.tick(60)
    press_reset(traffic)
    assert traffic.guard.verdict is Verdict.LATCHED
    traffic.a = {"Mode": 0}
    traffic.tick(60)
    assert traffic.guard.verdict is Verdict.LATCHED
    assert traffic.pilot[-1]["Supply"] == 0
    press_reset(traffic)
    assert traffic.guard.verdict is not Verdict.LATCHED
    traffic.tick(2)
    assert traffic.pilot[-1]["Supply"] == 0xA


def test_a_reset_that_is_held_counts_once() -> None:
    traffic = Traffic().good()
    traffic.estop["ResetReq"] = 1
    traffic.tick(3)
    traffic.estop["ChannelA"] = 0
    traffic.tick(3)
    traffic.estop["ChannelA"] = 1
    assert traffic.tick(300) is Verdict.LATCHED
    press_reset(traffic)
    assert traffic.guard.verdict is Verdict.LATCHED, "it was down already"
    press_reset(traffic)
    assert traffic.guard.verdict is not Verdict.LATCHED


def test_the_supply_goes_off_after_300_ms_of_silence() -> None:
    traffic = Traffic().good()
    traffic.dropped.add("ValveCmdB")
    heard = count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.NO_COMMAND) - 1
    steps = heard + 1
    while traffic.pilot[-1]["Supply"]:
        traffic.tick()
        steps += 1
    assert (steps - heard) * T == 305 * MS


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
