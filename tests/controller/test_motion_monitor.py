"""The motion monitor alone: no fault on any valve within the spread, and a fault when a joint does not follow."""

import math
from collections import deque

import pytest

from controller.estimation.motion_monitor import EARLY_DELAY_S, LATE_DELAY_S, MotionMonitor
from controller.laws.joint import INCH_SHARE
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from tests.controller.bench import SPECS, T

PERIOD_S = T * 1e-9
JOINTS = SPECS[:4]


class Valve:
    """Dead time, spool, a dead-band unlike the profile's, metering curve, gain, and compressible oil."""

    def __init__(self, spec, delay_s, gain=1.0, exponent=1.04, missing=0.0, oil_rad_s=8.0, zeta=0.3):
        self.full, self.gain, self.exponent, self.missing = spec.valve.full_speed_plus, gain, exponent, missing
        self.line = deque([0.0] * max(1, round(delay_s / PERIOD_S)))
        self.spool = self.v = self.x = self.q = 0.0
        self.oil, self.zeta = oil_rad_s, zeta

    def move(self, command):
        self.line.append(command)
        self.spool += PERIOD_S / 0.04 * (self.line.popleft() - self.spool)
        share = max(0.0, abs(self.spool) / self.full - self.missing)
        metered = math.copysign(self.gain * self.full * share**self.exponent, self.spool)
        self.x += metered * PERIOD_S
        a = self.oil**2 * (self.x - self.q) + 2.0 * self.zeta * self.oil * (metered - self.v)
        self.v += a * PERIOD_S
        self.q += self.v * PERIOD_S
        return self.v


def smooth(t_s, total_s):
    x = t_s / total_s
    return 140.0 / 2.1875 * (x * (1.0 - x)) ** 3 if 0.0 < x < 1.0 else 0.0


def alarm(spec, valve, commands):
    monitor = MotionMonitor(spec, PERIOD_S)
    for command in commands:
        reason = monitor.step(command, valve.move(command))
        if reason is not Reason.NONE:
            return reason
    return Reason.NONE


def there_and_back(spec, total_s=2.5, rest_s=0.3):
    """Motion at the speed limit and back at once; then an inch and a jerky stop."""
    n, top = round(total_s / PERIOD_S), spec.speed_limit
    out = [top * smooth(k * PERIOD_S, total_s) for k in range(n)]
    rest = [0.0] * round(rest_s / PERIOD_S)
    inch = [INCH_SHARE * spec.valve.full_speed_plus] * 60
    jerky = [min(top, 4.0 * spec.acceleration_limit * k * PERIOD_S) for k in range(200)]
    return out + [-v for v in out] + rest + inch + rest + jerky + [0.0] * 400


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
@pytest.mark.parametrize("delay_s", [0.03, 0.04, 0.095, 0.15])
@pytest.mark.parametrize(
    ("gain", "exponent", "missing"), [(1.0, 1.04, 0.0), (0.8, 1.1, 0.027), (1.2, 1.0, -0.027), (0.7, 1.1, 0.0)]
)
def test_valves_within_the_spread_raise_no_fault(spec, delay_s, gain, exponent, missing):
    valve = Valve(spec, delay_s, gain, exponent, missing)
    assert alarm(spec, valve, there_and_back(spec)) is Reason.NONE


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_stuck_joint_is_detected_in_time(spec):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, 0.08)
    command = 0.8 * spec.speed_limit
    for _ in range(400):
        assert monitor.step(command, valve.move(command)) is Reason.NONE
    ticks = next(k for k in range(200) if monitor.step(command, 0.0) is Reason.JOINT_STUCK)
    assert ticks * T <= FAULTS[Reason.JOINT_STUCK].bound_ms * 1_000_000 * 1.6, "from full motion"


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_uncommanded_motion_is_detected_in_time(spec):
    monitor = MotionMonitor(spec, PERIOD_S)
    ticks = next(k for k in range(200) if monitor.step(0.0, spec.speed_limit) is Reason.JOINT_RUNAWAY)
    assert ticks * T <= FAULTS[Reason.JOINT_RUNAWAY].bound_ms * 1_000_000


@pytest.mark.parametrize("spec", JOINTS, ids=["slew", "lift", "tilt", "ext"])
def test_motion_against_the_command_is_detected(spec):
    monitor, valve = MotionMonitor(spec, PERIOD_S), Valve(spec, 0.08)
    command = 0.4 * spec.speed_limit
    reasons = [monitor.step(command, -valve.move(command)) for _ in range(120)]
    assert Reason.JOINT_REVERSED in reasons
    assert reasons.index(Reason.JOINT_REVERSED) * T <= (LATE_DELAY_S + 0.2) * 1e9


def test_reset_clears_the_history():
    monitor = MotionMonitor(SPECS[0], PERIOD_S)
    for _ in range(20):
        monitor.step(0.3, -0.3)
    monitor.reset()
    assert [monitor.step(0.0, 0.0) for _ in range(100)] == [Reason.NONE] * 100
    assert EARLY_DELAY_S < LATE_DELAY_S


@pytest.mark.parametrize(("yields", "limit_rad"), [(False, 0.06), (True, 0.4)])
def test_a_rotator_that_a_log_turns_runs_away_by_more(yields, limit_rad):
    """A quarter of its speed limit is no runaway; what it turns beyond that counts."""
    spec, velocity = SPECS[4], 1.25 * SPECS[4].speed_limit
    monitor = MotionMonitor(spec, PERIOD_S)
    ticks = next(k for k in range(1, 400) if monitor.step(0.0, velocity, yields) is Reason.JOINT_RUNAWAY)
    memory_s = 0.5
    beyond_rad = memory_s * (1.0 - math.exp(-ticks * PERIOD_S / memory_s)) * spec.speed_limit
    assert beyond_rad == pytest.approx(limit_rad * spec.speed_limit, abs=2.0 * PERIOD_S * spec.speed_limit)
