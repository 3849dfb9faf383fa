"""Sway damping: the law on a pendulum, the joints' part, and the optional sensor."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import msgspec
import pytest

from can_dbc.messages.crane import OperatorAction
from controller.config import Settings
from controller.laws.joint import JointLaw
from controller.laws.sway import (
    FADE_S,
    MAX_DAMPING_S,
    RETURN_1_S,
    SENSOR_DELAY_S,
    START_ZONES,
    DirectionalDamper,
    SwayDamping,
)
from controller.laws.valve_map import ValveMap
from controller.step import Controller
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.profile import Imu, joint
from machine.status.modes import Mode
from runtime.errors import ConfigError
from tests.codes import coded
from tests.controller.bench import AORO, DATABASE, SETTINGS, Bench, T, count_until, settings_of

T_S = T * 1e-9
KEY = DATABASE.message("GrappleImu").key
IMU = Imu(0x23, "GrappleImu", gain=0.4, pendulum_m=0.8, pin_speed_m_s=0.12, dead_zone_rad=0.014)
PROFILE = msgspec.structs.replace(AORO.profile, imu=IMU)
LEADS = [150_000_000] * len(JOINTS)
POSE = (0.3, 0.6, -1.4, 0.8, 0.0)
SWING = (0.2, 0.2, 0.0, 0.0)
GRAVITY_M_S2 = 9.81


@dataclass
class Pendulum:
    """A point on a massless rod of ``length_m`` whose pin is driven; the motion without small angles."""

    length_m: float
    lean: float
    rate: float = 0.0
    pin_m: float = 0.0
    speed_m_s: float = 0.0

    def step(self, speed_m_s: float, elapsed_s: float) -> None:
        push = (speed_m_s - self.speed_m_s) / elapsed_s
        self.speed_m_s = speed_m_s
        self.rate -= (GRAVITY_M_S2 * math.sin(self.lean) + push * math.cos(self.lean)) / self.length_m * elapsed_s
        self.lean += self.rate * elapsed_s
        self.pin_m += speed_m_s * elapsed_s

    @property
    def swing(self) -> float:
        return math.hypot(self.lean, self.rate / math.sqrt(GRAVITY_M_S2 / self.length_m))


def damped(pendulum, seconds, imu=IMU, delay_s=0.15, age_s=0.0):
    """Swing over time of a pendulum with damping behind a dead time."""
    damper = DirectionalDamper(imu, delay_s)
    line, seen = deque([0.0] * round(delay_s / T_S)), deque()
    swings, displaced = [], 0.0
    for _ in range(round(seconds / T_S)):
        seen.append((pendulum.lean, pendulum.rate))
        lean, rate = seen[0] if len(seen) <= round((SENSOR_DELAY_S + age_s) / T_S) else seen.popleft()
        damper.step(lean, rate, age_s, T_S)
        velocity = damper.velocity_m_s - RETURN_1_S * displaced
        displaced += velocity * T_S
        line.append(velocity)
        pendulum.step(line.popleft(), T_S)
        swings.append(pendulum.swing)
    return swings


def decay(swings, begin_s, end_s, period_s):
    """The damping ratio between two times."""
    begin, end = swings[round(begin_s / T_S)], swings[round(end_s / T_S)]
    return math.log(begin / end) / (2.0 * math.pi * (end_s - begin_s) / period_s)


def test_undamped_pendulum_keeps_its_swing():
    swings = damped(Pendulum(0.8, 0.1), 4.0, msgspec.structs.replace(IMU, gain=0.0))
    assert min(swings) == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize("delay_s", [0.1, 0.25])
@pytest.mark.parametrize("age_s", [0.0, 0.03])
def test_damping_ratio_is_half_the_gain_for_any_delay(delay_s, age_s):
    fast = msgspec.structs.replace(IMU, pin_speed_m_s=0.5, dead_zone_rad=0.003)
    pendulum = Pendulum(0.8, 0.15)
    swings = damped(pendulum, 4.0, fast, delay_s, age_s)
    assert decay(swings, 0.5, 2.5, 2.0 * math.pi * math.sqrt(0.8 / GRAVITY_M_S2)) == pytest.approx(0.2, rel=0.25)


@pytest.mark.parametrize("length_m", [0.56, 0.7, 0.95, 1.1])
def test_pendulum_of_another_length_is_damped_too_and_the_pin_comes_back(length_m):
    pendulum = Pendulum(length_m, 0.12)
    swings = damped(pendulum, 6.0)
    assert swings[round(3.6 / T_S)] < 0.5 * 0.12
    assert max(swings[round(4.0 / T_S) :]) < START_ZONES * IMU.dead_zone_rad, "no limit cycle"
    assert abs(pendulum.pin_m) < 0.01


@pytest.mark.parametrize("age_s", [0.01, 0.05])
def test_old_swing_is_predicted_by_its_age(age_s):
    w = math.sqrt(GRAVITY_M_S2 / IMU.pendulum_m)
    lean, rate, turned = 0.05, 0.12, w * age_s
    now = (lean * math.cos(turned) + rate / w * math.sin(turned), rate * math.cos(turned) - w * lean * math.sin(turned))
    old, new = DirectionalDamper(IMU, 0.15), DirectionalDamper(IMU, 0.15)
    old.step(lean, rate, age_s, T_S)
    new.step(*now, 0.0, T_S)
    assert old.velocity_m_s == pytest.approx(new.velocity_m_s, rel=1e-9) and old.velocity_m_s > 0.0


def test_damping_begins_above_the_dead_zone_and_ends_in_it():
    damper = DirectionalDamper(IMU, 0.15)
    fade = round(FADE_S / T_S) + 1
    for zones, ticks, damps in (
        (START_ZONES - 0.1, 1, False),
        (START_ZONES + 0.1, 1, True),
        (START_ZONES - 0.1, 100, True),
        (0.9, fade, False),
    ):
        for _ in range(ticks):
            damper.step(zones * IMU.dead_zone_rad, 0.0, 0.0, T_S)
        assert (damper.velocity_m_s > 0.0) is damps and damper.velocity_m_s >= 0.0


def test_pin_keeps_its_speed_limit_without_jumps():
    damper, before = DirectionalDamper(IMU, 0.0), 0.0
    for k in range(400):
        if k < 200:
            damper.step(0.6, 0.0, 0.0, T_S)
        else:
            damper.stop(T_S)
        assert abs(damper.velocity_m_s) <= IMU.pin_speed_m_s
        assert abs(damper.velocity_m_s - before) <= IMU.pin_speed_m_s * T_S / FADE_S * 1.001
        before = damper.velocity_m_s
        if k == 199:
            assert before == IMU.pin_speed_m_s
    assert before == 0.0


def sway(imu=IMU):
    return SwayDamping(PROFILE, imu, LEADS)


@pytest.mark.parametrize(("swing", "ahead"), [((0.2, 0.0, 0.0, 0.0), (1, 0)), ((0.0, 0.2, 0.0, 0.0), (0, 1))])
@pytest.mark.parametrize("pose", [POSE, (-1.2, 1.1, -2.3, 0.2, 0.5), (0.9, 0.2, -0.4, 2.2, 0.0)])
def test_joints_move_the_pin_level_and_towards_the_grapple(swing, ahead, pose):
    law = sway()
    for _ in range(round(FADE_S / T_S) + 1):
        law.step(swing, 0.0, True, pose, T_S)
    kin, small = PROFILE.kinematics, 1e-5
    before = pin_position(kin, pose)
    after = pin_position(kin, [p + small * v for p, v in zip(pose, law.velocity, strict=True)])
    x, y, z = ((b - a) / small for a, b in zip(before, after, strict=True))
    turn = pose[0] + kin.theta1_offset_rad
    out, left = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    speed = math.hypot(out, left)
    assert 0.07 < speed < IMU.pin_speed_m_s
    assert (out / speed, left / speed) == pytest.approx(ahead, abs=0.01)
    assert abs(z) < 0.01 * speed
    assert law.velocity[Joint.LIFT] == law.velocity[Joint.ROT] == 0.0


def test_pin_returns_exactly_after_the_time_limit():
    law, moved = sway(), []

    def tick():
        law.step(SWING, 0.0, True, POSE, T_S)
        moved.append(abs(law.displacement[Joint.SLEW]))

    ticks = count_until(tick, lambda: not law.active, round((MAX_DAMPING_S + 4.0) / T_S))
    assert ticks * T_S > MAX_DAMPING_S
    assert max(moved) > 0.01
    assert not any(law.velocity) and not any(law.displacement)
    for _ in range(200):
        law.step(SWING, 0.0, True, POSE, T_S)
    assert not law.active and not any(law.velocity)


def test_damping_does_not_begin_and_fades_while_the_reference_moves():
    law = sway()
    for _ in range(100):
        law.step(SWING, 0.0, False, POSE, T_S)
    assert not law.active
    for _ in range(100):
        law.step(SWING, 0.0, True, POSE, T_S)
    assert law.active
    for unknown in (True, False):  # stale first, then a new motion
        before = list(law.velocity)
        law.step(None if unknown else SWING, 0.0, unknown, POSE, T_S)
        steps = [abs(a - b) for a, b in zip(law.velocity, before, strict=True)]
        assert 0.0 < max(steps) < 1.1 * IMU.pin_speed_m_s * T_S / FADE_S
    count_until(lambda: law.step(None, 0.0, True, POSE, T_S), lambda: not law.active, 1000)
    assert not any(law.velocity) and not any(law.displacement)


def test_unknown_joints_are_not_moved():
    law = sway()
    for pose in (POSE, (0.3, math.nan, -1.4, 0.8, 0.0)):
        law.step(SWING, 0.0, True, pose, T_S)
    assert not law.active and not any(law.velocity) and not any(law.displacement)


def test_end_positioning_waits_for_the_damping():
    spec = joint(PROFILE, Joint.SLEW)
    law = JointLaw(spec, ValveMap(spec.valve), T_S)

    def velocity(q=0.2, *damping):
        return law.desired_velocity(0.2, 0.0, 0.0, q, 0.0, math.nan, T_S, *damping)

    velocity()
    assert law.resting
    assert velocity(0.2, 0.01, 0.0) == pytest.approx(0.01) and not law.resting
    assert velocity(0.203, 0.0, 0.003) == pytest.approx(0.0, abs=1e-4), "where it was taken to is where it is to be"
    assert not law.resting
    for _ in range(400):
        velocity()
    assert law.resting


# The sensor behind the controller's bus.


def sensing(imu=IMU) -> Settings:
    return settings_of(msgspec.structs.replace(SETTINGS.profile, imu=imu))


def feel(bench: Bench, **values: float) -> None:
    """Send one frame of the sensor in the next tick."""
    bench.extra.append(bench._frame("GrappleImu", values))


def at_rest(bench: Bench, ticks: int, every: int, **values: float) -> Bench:
    """ACTIVE, with a constant reference, and frames of the sensor in every so many ticks."""
    bench.armed()
    bench.tick([bench.hold()])
    assert bench.mode is Mode.ACTIVE
    for k in range(ticks):
        if k % every == 0:
            feel(bench, **values)
        bench.tick([bench.hold()] if k % 20 == 0 else [])
    return bench


def test_controller_damps_with_a_sensor_and_stops_when_it_is_silent():
    bench = at_rest(Bench(sensing()), 60, 2, LeanTangential=0.15)
    assert bench.controller.crane.commands[Joint.SLEW] > 0.01
    assert bench.controller.crane_inputs.stale_mask == 0
    bench.keep(80)
    swung = bench.controller.crane.sway
    assert bench.controller.crane_inputs.imu.values is None
    assert bench.controller.crane_inputs.stale_mask == 0 and bench.mode is Mode.ACTIVE
    assert swung.velocity[Joint.SLEW] <= 0.0, "only the return is left"


@pytest.mark.parametrize("values", [{"Status": 2}, {"LeanRadial": None}, {"RateTangential": None}])
def test_faulty_sensor_is_ignored(values):
    bench = at_rest(Bench(sensing()), 60, 1, **{"LeanTangential": 0.15, "LeanRadial": 0.15, **values})
    assert bench.controller.crane_inputs.imu.values is not None
    assert not bench.controller.crane.sway.active


def test_standby_has_no_damping_and_arming_needs_no_sensor():
    bench = Bench(sensing()).boot()
    for _ in range(20):
        feel(bench, LeanTangential=0.15)
        bench.tick()
    assert not bench.controller.crane.sway.active
    bench.run(40)
    assert bench.controller.crane_inputs.imu.values is None
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_machine_without_a_sensor_does_not_receive_its_frames():
    bench = Bench().boot()
    received = bench.controller.crane_inputs
    assert received.imu is None and bench.controller.crane.sway is None
    assert KEY not in received.filters() and KEY in Controller(sensing(), DATABASE).crane_inputs.filters()
    unknown = received.unknown
    feel(bench, LeanTangential=0.15)
    bench.tick()
    assert received.unknown == unknown + 1


def test_wrong_sensor_node_is_a_configuration_error():
    with pytest.raises(ConfigError, check=coded("config.imu-node")):
        Controller(sensing(msgspec.structs.replace(IMU, node=0x24)), DATABASE)
