"""A machine a third as fast as usual: its oil and steel yield as far as those of any other, and no monitor minds."""

import math

import msgspec
import pytest

from controller.estimation.joint_monitors import USUAL_SPEED, DriftMonitor, MotionMonitor, StandstillMonitor
from controller.estimation.valve_monitors import SPEED_WINDOW_S, SpeedMonitor
from machine.joints import N_JOINTS, Joint
from machine.loading.profile_file import load_profile
from machine.profile import joint
from machine.status.reasons import Reason
from tests.controller.bench import SPECS, T

PERIOD_S = T * 1e-9
LIFT = SPECS[Joint.LIFT]
SLOW_VALVE = msgspec.structs.replace(
    LIFT.valve, full_speed_plus=LIFT.valve.full_speed_plus / 3, full_speed_minus=LIFT.valve.full_speed_minus / 3
)
SLOW = msgspec.structs.replace(LIFT, speed_limit=LIFT.speed_limit / 3, valve=SLOW_VALVE)
USUAL = USUAL_SPEED[Joint.LIFT]


def test_the_usual_speed_is_that_of_the_slower_shipped_machine() -> None:
    limits = [
        [joint(load_profile(name), Joint(j)).speed_limit for j in range(N_JOINTS)] for name in ("palms_471", "aoro_fc8")
    ]
    assert list(USUAL_SPEED) == [min(pair) for pair in zip(*limits, strict=True)], "no shipped machine is judged anew"


def yields_s(least_speed: float, mrad: float = 4.0) -> float | None:
    """The boom rises on its oil as jaws let a log go, and stays there; when that counts as motion without a command."""
    monitor = StandstillMonitor(SLOW, PERIOD_S, least_speed=least_speed)
    for k in range(round(3.0 / PERIOD_S)):
        t = k * PERIOD_S - 1.0
        risen = 0.0 if t < 0.0 else 1e-3 * mrad * (1.0 - math.exp(-t / 0.15))
        if monitor.step(True, True, risen):
            return t
    return None


def test_a_boom_that_a_log_leaves_does_not_run_away() -> None:
    assert yields_s(USUAL) is None
    assert yields_s(0.0) is not None, "it was one by the speed limit of the slow machine"
    assert yields_s(USUAL, 12.0) is not None, "three times as far is a motion on any machine"


def reacts(least_speed: float, command: float, velocity: float, seconds: float) -> Reason:
    monitor = MotionMonitor(SLOW, PERIOD_S, least_speed=least_speed)
    found = (monitor.step(command, velocity) for _ in range(round(seconds / PERIOD_S)))
    return next((reason for reason in found if reason is not Reason.NONE), Reason.NONE)


def test_ringing_oil_is_no_runaway_and_a_fast_joint_is() -> None:
    assert reacts(USUAL, 0.0, 0.03, 0.25) is Reason.NONE
    assert reacts(0.0, 0.0, 0.03, 0.25) is Reason.JOINT_RUNAWAY
    assert reacts(USUAL, 0.0, 0.10, 0.25) is Reason.JOINT_RUNAWAY


def test_oil_that_is_pressed_first_is_no_stuck_joint_and_one_that_never_moves_is() -> None:
    assert reacts(USUAL, 0.02, 0.0, 1.0) is Reason.NONE
    assert reacts(0.0, 0.02, 0.0, 1.0) is Reason.JOINT_STUCK
    assert reacts(USUAL, SLOW.speed_limit, 0.0, 1.0) is Reason.JOINT_STUCK


@pytest.mark.parametrize(("least_speed", "reason"), [(USUAL, Reason.NONE), (0.0, Reason.JOINT_STUCK)])
def test_the_spool_of_a_slow_joint_is_open_before_it_moves(least_speed: float, reason: Reason) -> None:
    monitor = SpeedMonitor(SLOW_VALVE, SLOW.speed_limit, PERIOD_S, SPEED_WINDOW_S, least_speed)
    found = (monitor.step(0.018, 0.001) for _ in range(round(0.6 / PERIOD_S)))
    assert next((r for r in found if r is not Reason.NONE), Reason.NONE) is reason
    stuck = (monitor.step(SLOW.speed_limit, 0.0) for _ in range(round(0.6 / PERIOD_S)))
    assert Reason.JOINT_STUCK in stuck


def test_an_encoder_drifts_when_it_drifts_as_far_as_on_any_machine() -> None:
    def drifts(least_speed: float, mrad_s: float) -> bool:
        monitor, position = DriftMonitor(SLOW, PERIOD_S, least_speed), 0.0
        for k in range(round(6.0 / PERIOD_S)):
            opens = k * PERIOD_S % 1.5 >= 1.4
            speed = -15e-3 * mrad_s if opens else 0.0
            position += (1e-3 * mrad_s + speed) * PERIOD_S
            if monitor.step(not opens, speed, position, calm=True):
                return True
        return False

    assert not drifts(USUAL, 1.8) and drifts(0.0, 1.8)
    assert drifts(USUAL, 3.0)
