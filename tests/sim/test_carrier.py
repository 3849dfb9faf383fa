"""The carrier against closed forms: weight, turning, speed, stopping, creep, roll, tipping, arms, rough ground."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from experiments.common.worlds import step_neutral, trial_world
from machine.geometry import carrier as geometry
from sim.ground.terrain import SIDE_SLOPE, Terrain
from sim.mechanics.carrier import PARKED, Drive, carrier_links
from sim.truth.load import load_truth
from tests.sim.carrier_rig import GRAVITY, PROFILE, STEP_S, Rig, carrier_truth

C = PROFILE.carrier
CRUISE = Drive(C.cruise_speed_m_s)


@pytest.fixture
def rig():
    made = []

    def make(*args, **kwargs):
        made.append(Rig(*args, **kwargs))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_frames_agree_with_the_profile(rig):
    r = rig(height_m=0.2, heading_rad=0.7, at=(3.0, -2.0))
    (x, y, z), _ = r.carrier.pose("rear")
    assert (x, y) == pytest.approx((3.0, -2.0), abs=1e-9)
    assert z == pytest.approx(geometry.pivot_height_m(C, 0.2), abs=0.01)
    assert r.carrier.heading_rad == pytest.approx(0.7) and r.carrier.attitude("rear")[2] == pytest.approx(0.7)
    assert r.carrier.arm_heights_m == pytest.approx((0.2,) * 4)
    ahead = geometry.hub_m(C, "arm_fl", 0.2)[0]
    axle = r.carrier.front_axle()
    assert math.dist(axle[:2], (3.0, -2.0)) == pytest.approx(ahead)
    assert math.atan2(axle[1] + 2.0, axle[0] - 3.0) == pytest.approx(0.7)


@pytest.mark.parametrize("seed", range(8))
def test_every_link_has_a_possible_inertia(seed):
    """Bullet drops the whole inertia of a part whose largest exceeds the sum of the others, by rounding even."""
    links, _ = carrier_links(PROFILE, load_truth("sampled", seed, PROFILE.name))
    for link in links:
        least, middle, most = sorted(link.inertia_kg_m2)
        assert most < 0.9999 * (least + middle), link.name


def test_wheel_loads_are_the_lever_rule(rig):
    r = rig()
    r.run(6.0)
    loads, weight = r.carrier.wheel_loads_n, r.mass_kg * GRAVITY
    x, y, _ = r.centre()
    front = weight * (x - r.carrier.pose("rear")[0][0] + C.rear_axle_m) / (C.front_axle_m + C.rear_axle_m)
    assert sum(loads) == pytest.approx(weight, rel=1e-3)
    assert loads[0] + loads[1] == pytest.approx(front, rel=3e-3)
    assert loads[0] == pytest.approx(loads[1], rel=1e-3) and y == pytest.approx(0.0, abs=1e-4)
    assert r.carrier.tip_margin_m == pytest.approx(C.track_width_m / 2, abs=5e-3)
    assert r.carrier.pose("rear")[0][2] == pytest.approx(geometry.pivot_height_m(C, 0.35), abs=5e-3)


def test_an_arm_carries_its_wheel_load_on_its_lever(rig):
    r = rig()
    r.run(6.0, Drive())
    t, reach = r.truth, C.arm_length_m * math.cos(geometry.arm_angle_from_height(C, 0.35))
    for name, load in zip(geometry.ARMS, r.carrier.wheel_loads_n, strict=True):
        moment = load * reach - GRAVITY * (t.wheel_mass_kg + t.arm_mass_kg / 2) * reach
        assert r.client.getJointState(r.body, r.index[name])[3] == pytest.approx(moment, rel=0.02)


def test_cruise_speed_and_stopping(rig):
    r = rig()
    r.run(5.0, CRUISE)
    v = r.carrier.speed_m_s
    # The motors' droop carries rolling resistance: gain times the missing spin = resistance times radius.
    missing = r.truth.rolling_resistance * r.mass_kg * GRAVITY / 4 * C.wheel_radius_m / r.truth.drive_gain_nm_s_rad
    assert v == pytest.approx(C.cruise_speed_m_s - missing * C.wheel_radius_m, rel=0.02)
    assert r.carrier.heading_rad == pytest.approx(0.0, abs=1e-4)
    turned = r.carrier.wheel_spin_rad[0]
    start = r.carrier.front_axle()[0]
    r.run(4.0, Drive(0.0))
    ramp = C.cruise_speed_m_s**2 / (2 * r.truth.drive_acceleration_m_s2)
    assert ramp < r.carrier.front_axle()[0] - start < ramp + 0.15 * v
    assert r.carrier.speed_m_s == pytest.approx(0.0, abs=1e-3)
    assert r.carrier.wheel_spin_rad[0] > turned


def test_the_brake_stops_within_friction(rig):
    r = rig()
    r.run(4.0, CRUISE)
    v, start = r.carrier.speed_m_s, r.carrier.front_axle()[0]
    furthest = start
    for _ in range(1600):
        r.step(PARKED)
        furthest = max(furthest, r.carrier.front_axle()[0])
    shortest = v * v / (2 * r.truth.friction * GRAVITY)
    assert shortest < furthest - start < shortest + 1.2 * r.truth.brake_lag_s * v
    assert r.carrier.speed_m_s == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("share", [1.0, -1.0, 0.5])
def test_turning_radius(rig, share):
    r, angle = rig(), share * C.articulation_limit_rad
    r.steer_rad = angle
    r.run(4.0, Drive(0.3))
    path, heading = [r.carrier.front_axle()], r.carrier.heading_rad
    for _ in range(20):
        r.run(0.5, Drive(0.3))
        path.append(r.carrier.front_axle())
    length = sum(math.dist(a[:2], b[:2]) for a, b in pairwise(path))
    turned = r.carrier.heading_rad - heading
    around = geometry.turning_radius_m(C, abs(angle))
    assert length / turned == pytest.approx(math.copysign(around, share), rel=0.02)
    slow, fast = sorted((r.carrier.wheel_speeds_rad_s[0], r.carrier.wheel_speeds_rad_s[1]))
    assert fast / slow == pytest.approx((around + C.track_width_m / 2) / (around - C.track_width_m / 2), rel=0.03)
    if abs(share) == 1.0:
        assert math.degrees(abs(turned)) / length == pytest.approx(9.0, rel=0.05)


def test_the_whole_forwarder_stands_on_its_wheels_and_cruises():
    with trial_world("aoro_fc8", "nominal", 1) as w:
        p, body, neutral = w.client, w.crane.body, [0.0] * len(w.functions)
        step_neutral(w, round(4.0 / STEP_S))
        mass = sum(p.getDynamicsInfo(body, i)[0] for i in range(-1, p.getNumJoints(body)))
        assert sum(w.wheel_loads_n()) == pytest.approx(mass * GRAVITY, rel=0.01)
        start = w.carrier.front_axle()
        step_neutral(w, round(2.0 / STEP_S))
        assert math.dist(start, w.carrier.front_axle()) < 5e-3
        for _ in range(round(6.0 / STEP_S)):
            w.step(neutral, CRUISE)
        assert w.carrier.speed_m_s == pytest.approx(C.cruise_speed_m_s, rel=0.05)


def test_coasting_only_loses_speed_to_rolling_resistance(rig):
    r = rig(truth=carrier_truth(drive_gain_nm_s_rad=0.0))
    r.run(3.0, Drive())
    r.client.resetBaseVelocity(r.body, [0.8, 0.0, 0.0], [0.0, 0.0, 0.0])
    r.run(0.8, Drive())
    speeds = []
    for _ in range(3):
        total = 0.0
        for _ in range(200):
            r.step(Drive())
            total += r.carrier.speed_m_s
        speeds.append(total / 200)
    t, wheel = r.truth, C.wheel_radius_m
    effective = r.mass_kg + 4 * t.wheel_spin_inertia_kg_m2 / wheel**2
    wanted = t.rolling_resistance * r.mass_kg * GRAVITY / effective
    assert speeds[0] < 0.8
    assert (speeds[0] - speeds[2]) / (400 * STEP_S) == pytest.approx(wanted, rel=0.05)


@pytest.mark.long
def test_parked_machine_stays(rig):
    r = rig()
    r.run(6.0)
    before = r.carrier.pose("rear")[0]
    r.run(60.0)
    assert math.dist(r.carrier.pose("rear")[0], before) < 2e-5


@pytest.mark.parametrize("heading", [0.0, math.pi / 2])
def test_parked_on_the_slope_stays(rig, heading):
    r = rig(Terrain("slope"), heading_rad=heading)
    r.run(5.0)
    before = r.carrier.pose("rear")[0]
    r.run(10.0)
    assert math.dist(r.carrier.pose("rear")[0], before) / 10.0 < 2e-5


def _slew(r: Rig, seconds: float, since: float) -> None:
    """250 kg and the grapple at 6 m, swung from side to side behind the machine."""
    for i in range(round(seconds / STEP_S)):
        t = since + i * STEP_S
        angle, turn = math.pi + 1.5 * math.sin(0.8 * t), -1.5 * 0.8**2 * math.sin(0.8 * t)
        (x, y, z), _ = r.carrier.pose("rear")
        side = -485.0 * 6.0 * turn  # what the load's inertia does to the crane
        at = [x + C.crane_base_m[0] + 6.0 * math.cos(angle), y + 6.0 * math.sin(angle), z + 2.5]
        r.push = ([-math.sin(angle) * side, math.cos(angle) * side, -485.0 * GRAVITY], at)
        r.step()


@pytest.mark.long
def test_parked_machine_creeps_less_than_a_twentieth_of_a_millimetre_a_second_while_the_crane_slews(rig):
    r, cycle = rig(), 2 * math.pi / 0.8
    r.run(2.0)
    _slew(r, cycle, 0.0)
    before = r.carrier.pose("rear")
    _slew(r, 3 * cycle, cycle)
    after = r.carrier.pose("rear")
    assert math.dist(after[0], before[0]) / (3 * cycle) < 5e-5
    assert abs(r.carrier.attitude("rear")[2]) < 1e-3


def test_roll_stiffness_is_that_of_the_tyres(rig):
    r = rig()
    r.run(4.0)
    height = r.centre()[2]
    x, y, z = r.carrier.pose("rear")[0]
    r.push = ([0.0, 0.0, -3000.0], [x, y + 1.0, z])
    r.run(6.0)
    stiffness = 4 * r.truth.tyre_stiffness_n_m * (C.track_width_m / 2) ** 2 - r.mass_kg * GRAVITY * height
    assert r.carrier.roll_rad == pytest.approx(-3000.0 / stiffness, rel=0.05)


def test_tip_margin_shrinks_on_a_side_slope_by_the_height_of_the_centre(rig):
    r = rig(Terrain("slope"))
    r.run(6.0)
    height = r.centre()[2] - r.carrier.front_axle()[2] + C.wheel_radius_m
    expected = C.track_width_m / 2 - height * math.tan(r.carrier.roll_rad)
    assert r.carrier.roll_rad > SIDE_SLOPE  # the lower tyres are pressed more
    assert r.carrier.tip_margin_m == pytest.approx(expected, abs=0.03)
    loads = r.carrier.wheel_loads_n
    assert loads[1] > loads[0] and loads[3] > loads[2]


def test_tip_margin_is_zero_when_the_machine_tips(rig):
    r = rig()
    r.run(4.0)
    lever = C.track_width_m / 2 * r.mass_kg * GRAVITY
    for share, tips in ((0.5, False), (1.15, True)):
        r.push = ([0.0, -share * lever / 3.0, 0.0], [0.0, 0.0, 3.0])
        r.run(1.5)
        assert (r.carrier.tip_margin_m < 1e-6) == tips
        assert (min(r.carrier.wheel_loads_n[0::2]) == 0.0) == tips
    assert r.carrier.roll_rad > 0.1


def test_swing_arms_lift_and_level_the_frame(rig):
    r = rig(height_m=0.0)
    r.run(3.0, Drive())
    assert r.carrier.pose("rear")[0][2] == pytest.approx(geometry.pivot_height_m(C, 0.0), abs=0.01)
    r.goal = dict.fromkeys(geometry.ARMS, 0.6)
    r.run(8.0, Drive())
    assert r.carrier.arm_heights_m == pytest.approx((0.6,) * 4, abs=5e-3)
    assert r.carrier.pose("rear")[0][2] == pytest.approx(geometry.pivot_height_m(C, 0.6), abs=0.01)
    tilted = rig(Terrain("slope"))
    tilted.goal |= {"arm_fr": 0.35 + 0.105, "arm_rr": 0.35 + 0.105, "arm_fl": 0.35 - 0.105, "arm_rl": 0.35 - 0.105}
    tilted.run(6.0)
    assert abs(tilted.carrier.roll_rad) < 0.01
    assert tilted.carrier.tip_margin_m > 0.95


@pytest.mark.long
@pytest.mark.parametrize("floating", [False, True])
def test_thirty_seconds_on_rough_ground_with_a_weaving_course(rig, floating):
    r = rig(Terrain("rough", 3))
    r.floating = floating
    r.run(2.0)
    loads, speeds, rolls = [], [], []
    for i in range(round(30.0 / STEP_S)):
        r.steer_rad = 0.3 * math.sin(2 * math.pi * i * STEP_S / 10.0)
        r.step(CRUISE)
        if i % 20 == 0:
            loads.append(r.carrier.wheel_loads_n)
            speeds.append(r.carrier.speed_m_s)
            rolls.append(r.carrier.roll_rad)
    loads = np.array(loads)
    assert np.mean(speeds[40:]) == pytest.approx(0.61, abs=0.03)
    assert max(map(abs, rolls)) < 0.2
    assert loads.sum(axis=1).mean() == pytest.approx(r.mass_kg * GRAVITY, rel=0.02)
    # A rigid frame lifts a wheel; connected cylinders keep all four on the ground (paper B).
    assert (loads.min() == 0.0) != floating


def test_wheels_touch_logs_but_not_the_ground(rig):
    r = rig()
    p = r.client
    box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 3.0, 0.15])
    log = p.createMultiBody(300.0, box, basePosition=[3.4, 0.0, 0.15])
    touched = False
    for _ in range(1600):
        r.step(Drive(0.3))
        touched = touched or bool(p.getContactPoints(r.body, log))
    assert touched and not p.getContactPoints(r.body, r.terrain.body)
    assert p.getBasePositionAndOrientation(log)[0][0] > 3.5
