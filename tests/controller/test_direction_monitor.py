"""A joint in a spool test: standing and any speed are allowed, going the other way is not."""

from __future__ import annotations

import pytest

from controller.estimation.direction_monitor import AGAINST_S_AT_LIMIT, ANSWER_S, LEAST_AGAINST, DirectionMonitor
from machine.loading.profile_file import load_profile

T_S = 0.005
SPECS = load_profile("palms_471").joints


def travel_until_told(name: str, percent: float, velocity: float, seconds: float = 3.0) -> float | None:
    """How far a joint goes at ``velocity`` under a command before the monitor tells; None: it does not."""
    monitor, way = DirectionMonitor(SPECS[name], T_S), 0.0
    for _ in range(round(seconds / T_S)):
        way += abs(velocity) * T_S
        if monitor.step(percent, velocity):
            return way
    return None


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_stands_or_follows_at_any_speed_is_none(name, side):
    for velocity in (0.0, 0.1, 1.2):
        assert travel_until_told(name, side * 25.0, side * velocity) is None


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_goes_against_its_command_is_told_within_centimetres(name, side):
    limit = max(AGAINST_S_AT_LIMIT * SPECS[name].speed_limit, LEAST_AGAINST)
    speed = 0.5 * SPECS[name].speed_limit
    way = travel_until_told(name, side * 25.0, -side * speed)
    assert way is not None and way <= speed * ANSWER_S + 1.5 * limit


def test_a_valve_that_answers_late_has_not_gone_the_wrong_way():
    monitor = DirectionMonitor(SPECS["slew"], T_S)
    for k in range(400):
        command, velocity = (20.0, 0.2) if k < 200 else (-20.0, 0.2 if k < 200 + 0.32 / T_S else -0.2)
        assert not monitor.step(command, velocity), k
