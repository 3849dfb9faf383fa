"""A load at rest in the carrier's bunk sleeps as one body of the carrier, and wakes before anything touches it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import pytest

from machine.geometry.kinematics import solve
from machine.loading.profile_file import load_profile
from sim.mechanics.carrier import PARKED, Drive
from sim.scenes.arrangements import arrangement
from sim.truth.load import load_truth
from sim.wood.stowage import NEAR_M, WEIGHT_TILT_RAD, ApparentWeight
from sim.world import World

PROFILE = load_profile("aoro_fc8")
TRUTH = load_truth("nominal", 0, "aoro_fc8")
LOGS = 5
STEPS_PER_S = 400
AHEAD = Drive(0.64)


def laden(stowing: bool = True, home: Mapping[str, float] | None = None) -> World:
    """Five logs in the bunk, one on the ground beside the machine."""
    ground = replace(arrangement("single", PROFILE, TRUTH.wood, 3, 1)[0], x_m=-2.0, y_m=6.0)
    world = World(PROFILE, TRUTH, 0, (*arrangement("bunk", PROFILE, TRUTH.wood, 2, LOGS), ground), home=home)
    if not stowing:
        world.stowage = None
    return world


def go(world: World, seconds: float, drive: Drive = PARKED) -> None:
    for _ in range(round(seconds * STEPS_PER_S)):
        world.step([0.0] * len(world.functions), drive)


def in_base(world: World, log: int) -> tuple[float, float, float]:
    p = world.client
    place = p.getBasePositionAndOrientation(world.log_bodies.body_ids[log])
    return p.multiplyTransforms(*p.invertTransform(*world.base_pose()), *place)[0]


@pytest.fixture
def world() -> Iterator[World]:
    world = laden()
    yield world
    world.close()


def test_a_still_load_is_stowed_and_logs_on_the_ground_are_not(world):
    assert world.log_bodies.stowed == ()
    go(world, 1.0)
    assert world.log_bodies.stowed == tuple(range(LOGS))


@pytest.mark.long
def test_a_stowed_load_weighs_like_an_awake_one(world):
    other = laden(stowing=False)
    for seconds, drive in ((2.0, PARKED), (1.0, AHEAD), (3.0, AHEAD), (3.0, PARKED)):
        for w in (world, other):
            go(w, seconds, drive)
        a, b = world.carrier, other.carrier
        assert a.wheel_loads_n == pytest.approx(b.wheel_loads_n, rel=0.01)
        assert (a.roll_rad, a.pitch_rad) == pytest.approx((b.roll_rad, b.pitch_rad), abs=3e-4)
        assert a.front_axle() == pytest.approx(b.front_axle(), abs=0.01)
    assert other.log_bodies.stowed == () != world.log_bodies.stowed
    for log in range(LOGS):
        assert math.dist(in_base(world, log), in_base(other, log)) < 0.02
    other.close()


@pytest.mark.long
def test_a_start_and_a_stop_wake_the_load_without_moving_it(world):
    go(world, 1.0)
    before = [in_base(world, log) for log in range(LOGS)]
    woken = 0
    for drive in (AHEAD, PARKED):
        for _ in range(8):
            go(world, 0.1, drive)
            woken += not world.log_bodies.stowed
        go(world, 4.0, drive)
        assert world.log_bodies.stowed == tuple(range(LOGS))
        assert max(math.dist(in_base(world, i), at) for i, at in enumerate(before)) < 0.01
    assert woken >= 2


@pytest.mark.long
def test_a_falling_log_wakes_the_load_and_is_stowed_with_it(world):
    go(world, 1.0)
    p, falling = world.client, world.log_bodies.body_ids[LOGS]
    top = max(p.getAABB(world.log_bodies.body_ids[i])[1][2] for i in range(LOGS))
    at, turn = p.getBasePositionAndOrientation(world.log_bodies.body_ids[0])
    world.log_bodies.wake()
    assert world.log_bodies.stowed  # not by this: it would fall through the bunk
    p.resetBasePositionAndOrientation(falling, (at[0], world.base_pose()[0][1], top + 0.6), turn)
    lowest = top
    for _ in range(100):
        if not world.log_bodies.stowed:
            break
        go(world, 0.01)
        lowest = p.getAABB(falling)[0][2]
    assert top + NEAR_M / 2 < lowest < top + 0.6
    go(world, 5.0)
    assert world.log_bodies.stowed == tuple(range(LOGS + 1))
    assert not any(c[8] < -0.005 for i in world.log_bodies.body_ids for c in p.getContactPoints(i))


@pytest.mark.parametrize(("above_m", "stowed"), [(0.1, False), (0.6, True)])
def test_a_load_below_open_jaws_stays_awake(above_m, stowed):
    x, y = PROFILE.bunk.center_m
    hanging = PROFILE.grapple.jaws.tip_below_pin_m[0]
    slew, lift, tilt, ext = solve(PROFILE, x, y, PROFILE.bunk.floor_z_m + 0.35 + above_m + hanging)
    world = laden(home={"slew": slew, "lift": lift, "tilt": tilt, "ext": ext})
    go(world, 1.5)
    assert bool(world.log_bodies.stowed) is stowed
    world.close()


@pytest.mark.long
def test_equal_worlds_stow_and_wake_equally(world):
    other = laden()
    for w in (world, other):
        go(w, 1.0)
        go(w, 2.0, AHEAD)
        go(w, 2.0)
    poses = [[w.client.getBasePositionAndOrientation(log) for log in w.log_bodies.body_ids] for w in (world, other)]
    assert poses[0] == poses[1] and world.log_bodies.stowed == other.log_bodies.stowed
    other.close()


def test_apparent_weight_follows_rotation_and_acceleration():
    level, look_s = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 0.01
    weight = ApparentWeight(look_s)
    rest = weight.now
    for i in range(100):
        weight.update((0.8 * i * look_s, 0.0, 0.0), level)
    assert weight.now == pytest.approx((-0.8, 0.0, -9.81), abs=1e-3) and weight.differs(rest)
    tilted = ApparentWeight(look_s)
    for angle, differs in ((0.9 * WEIGHT_TILT_RAD, False), (1.1 * WEIGHT_TILT_RAD, True)):
        c, s = math.cos(angle), math.sin(angle)
        for _ in range(100):
            tilted.update((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c))
        assert tilted.now == pytest.approx((0.0, -9.81 * s, -9.81 * c), abs=1e-3)
        assert tilted.differs(rest) is differs
    falling = ApparentWeight(look_s)
    for i in range(100):
        falling.update((0.0, 0.0, -2.0 * i * look_s), level)
    assert falling.differs(rest)
