"""The guard hears the person itself: nothing moves without an ARM that it heard, and nothing for long after a STOP."""

from __future__ import annotations

import socket
from contextlib import closing
from pathlib import Path

import pytest

from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from controller.guard.layout import GuardConfigError
from controller.guard.operator import AGE_NS, OperatorActions, action_of
from controller.guard.verdicts import DRIVE_AXIS, NO_AXIS, Verdict
from machine.status.modes import Mode
from tests.codes import coded
from tests.controller.bench import MS, Bench, T, count_until
from tests.controller.guard_traffic import DRIVING, MOVING, Traffic

ARM, DISARM, STOP, RESET = OperatorAction.ARM, OperatorAction.DISARM, OperatorAction.STOP, OperatorAction.RESET
NOW, KEY, CHECK = 10**10, b"k" * 16, 0x123456


def opened(traffic: Traffic, percent: float = 60.0) -> Traffic:
    """The slew is commanded to open so far."""
    for k in range(200):
        traffic.a = {"Mode": 2, "Slew": min(percent, 0.5 * k)}
        assert traffic.tick() is Verdict.GOOD
    return traffic


def test_a_controller_that_arms_itself_moves_nothing() -> None:
    traffic = Traffic()
    assert traffic.tick(60) is Verdict.GOOD
    traffic.a, traffic.b["ArmKey"], traffic.controller["Mode"] = dict(MOVING), 0xA, 3
    traffic.tick()
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.NOT_ARMED, NO_AXIS)
    drive = Traffic("aoro_fc8")
    drive.tick(60)
    drive.drive = dict(DRIVING)
    assert count_until(drive.tick, lambda: not drive.guard.enabled) <= 5
    assert (drive.guard.verdict, drive.guard.axis) == (Verdict.NOT_ARMED, DRIVE_AXIS)


def test_an_arm_before_the_guard_enables_is_none() -> None:
    traffic = Traffic().press()
    traffic.tick(60)
    traffic.a.update(MOVING)
    assert traffic.tick() is Verdict.NOT_ARMED


@pytest.mark.parametrize("action", [DISARM, STOP])
@pytest.mark.parametrize(("kept", "ms"), [(1.0, 90), (0.76, 90), (0.7, 205)])
def test_a_controller_that_goes_on_after_a_stop_is_cut(action: OperatorAction, kept: float, ms: int) -> None:
    """As open as before, or as far as the ramp is watched: cut within 100 ms, or when the ramp must be over."""
    traffic = opened(Traffic().good())
    traffic.press(action)
    shut = 12.0
    traffic.a["Slew"] = shut + kept * (60.0 - shut)
    assert count_until(traffic.tick, lambda: not traffic.guard.enabled) * T == ms * MS
    assert traffic.guard.verdict is Verdict.NOT_ARMED


def test_a_ramp_of_150_ms_after_a_stop_passes() -> None:
    traffic = opened(Traffic().good())
    traffic.press(STOP)
    traffic.tick(2)
    for k in range(30):
        traffic.a["Slew"] = 60.0 - 1.6 * k
        assert traffic.tick() is Verdict.GOOD
    traffic.a = {"Mode": 0, "Slew": 0.0}
    assert traffic.tick(100) is Verdict.GOOD
    traffic.press()
    traffic.a = dict(MOVING)
    assert traffic.tick(60) is Verdict.GOOD, "armed again"


def test_a_second_stop_gives_no_more_time() -> None:
    traffic = opened(Traffic().good())
    for k in range(19):
        traffic.press(STOP)
        assert (traffic.tick() is Verdict.GOOD) is (k < 17), k


@pytest.mark.parametrize("by", ["the person", "its controller"])
def test_a_carrier_has_the_time_of_its_brake_after_a_stop(by: str) -> None:
    traffic = Traffic("aoro_fc8").good()
    traffic.drive = dict(DRIVING)
    traffic.tick(40)
    if by == "the person":
        traffic.press(STOP)
    else:
        traffic.controller = {"Mode": Mode.STOP}
    assert traffic.tick(439) is Verdict.GOOD
    count_until(traffic.tick, lambda: not traffic.guard.enabled, 3)
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.NOT_ARMED, DRIVE_AXIS)


def test_after_the_guard_s_own_cut_a_person_arms_again() -> None:
    traffic = opened(Traffic().good(), 13.0)
    traffic.dropped |= {"ValveCmdA", "ValveCmdB"}
    assert traffic.tick(20) is Verdict.NO_COMMAND
    traffic.dropped.clear()
    assert traffic.tick(10) is Verdict.CALMING, "what the controller has on its way breaks no further rule"
    traffic.a = {"Mode": 0}
    assert traffic.tick(60) is Verdict.GOOD
    traffic.a = dict(MOVING)
    assert traffic.tick() is Verdict.NOT_ARMED


def test_reset_while_it_works_changes_nothing() -> None:
    traffic = opened(Traffic().good())
    traffic.press(RESET)
    assert traffic.tick(100) is Verdict.GOOD


# -- datagrams ---------------------------------------------------------------------------------------------------------


def command(action: OperatorAction, stamp_ns: int = NOW, key: bytes | None = None, check: int = 0) -> bytes:
    return encode(OperatorCommand(1, 0, stamp_ns, action, check), key)


def test_a_command_counts_once_and_in_its_time() -> None:
    assert action_of(command(ARM), 0, NOW) == (ARM, NOW)
    assert action_of(command(ARM), NOW, NOW) == (0, NOW), "replayed"
    assert action_of(command(ARM, NOW + 1000), 0, NOW) == (0, 0), "from the future"
    assert action_of(command(ARM, NOW - AGE_NS), 0, NOW) == (0, 0), "too old"
    assert action_of(command(ARM, NOW - AGE_NS + 1000), 0, NOW)[0] == ARM
    assert action_of(command(STOP, 1000), NOW, NOW) == (STOP, NOW), "STOP at any age"


@pytest.mark.parametrize("check", [0, 1, CHECK ^ 1, 0xFFFFFF])
def test_an_arm_that_was_meant_for_another_profile_enables_nothing(tmp_path: Path, check: int) -> None:
    """A controller that arms itself waits for it; the guard knows what its own profile's file is."""
    path = tmp_path / "operators" / "controller"
    traffic = Traffic()
    assert traffic.tick(60) is Verdict.GOOD
    with closing(OperatorActions(operator_link.guard_path(path), CHECK)) as operator:
        for sent in (command(ARM, check=check), command(ARM, NOW + 1000, check=CHECK)):
            with pytest.raises(FileNotFoundError):  # no controller listens
                operator_link.send(sent, path)
        heard = operator.receive(NOW + 1000)
    assert heard == [0, ARM]
    traffic.guard.hear(heard[0], traffic.now_ns)
    traffic.a, traffic.b["ArmKey"], traffic.controller["Mode"] = dict(MOVING), 0xA, 3
    assert traffic.tick() is Verdict.NOT_ARMED


@pytest.mark.parametrize("action", [DISARM, STOP, RESET])
def test_what_enables_nothing_is_heard_for_any_profile(action: OperatorAction) -> None:
    assert action_of(command(action, check=CHECK ^ 1), 0, NOW, CHECK)[0] == action


@pytest.mark.parametrize("data", [b"nothing", Bench().armed().hold()])
def test_what_is_no_command_of_a_person_is_worth_nothing(data: bytes) -> None:
    assert action_of(data, 7, NOW) == (0, 7)


def test_both_sockets_hear_what_is_sent_to_one_and_only_who_holds_the_credential_but_for_stop(tmp_path: Path) -> None:
    path = tmp_path / "operators" / "controller"
    guard = operator_link.guard_path(path)
    with closing(OperatorActions(guard, 0)) as operator, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        assert operator.receive(NOW) == []
        for _ in range(2):
            with pytest.raises(FileNotFoundError):  # no controller listens
                operator_link.send(command(ARM), path)
        assert operator.receive(NOW) == [ARM, 0]
        for data in (command(ARM, NOW + 1000), command(ARM, NOW + 1000, KEY), command(STOP, key=KEY), command(STOP)):
            stranger.sendto(data, str(guard))
        assert operator.receive(NOW + 1000) == [STOP, STOP]
    assert not any(guard.parent.iterdir())


def test_a_socket_that_cannot_be_made_stops_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(GuardConfigError, check=coded("guard.operator")):
        OperatorActions(tmp_path / "file" / "socket", 0)
