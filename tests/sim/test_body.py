"""The machines' bodies: rigid kinematics equal to the profile's, jaws as in its table, collision pairs."""

from __future__ import annotations

import math
import random

import pybullet
import pytest

from machine.geometry.kinematics import pin_position, solve
from machine.loading.profile_file import load_profile
from sim.bullet.client import new_client
from sim.truth.load import load_truth
from sim.world import World, home_pose

MACHINES = ("palms_471", "aoro_fc8")
ACTIVE = ("slew", "lift", "tilt", "ext")


@pytest.fixture(scope="module", params=MACHINES)
def world(request):
    profile = load_profile(request.param)
    w = World(profile, load_truth("nominal", 0, request.param), 0, ())
    yield w
    w.close()


def pose(world, **joints):
    """The crane in a rigid pose, nothing stepped."""
    straight = {"flex_pitch": 0.0, "flex_roll": 0.0, "hanger": -joints.get("lift", 0.0) - joints.get("tilt", 0.0)}
    world.crane.place(straight | joints)
    world._read()


def test_hanger_pin_of_the_urdf_equals_the_denavit_hartenberg_chain(world):
    rng = random.Random(1)
    joints = world.profile.joints
    for _ in range(50):
        q = [rng.uniform(joints[n].lower, joints[n].upper) for n in ACTIVE]
        pose(world, **dict(zip(ACTIVE, q, strict=True)))
        expected = pin_position(world.profile.kinematics, [*q, 0.0])
        assert math.dist(world.rigid_tip(), expected) < 1e-6
        # Bullet returns single-precision poses; a machine that has moved away from the origin loses a little more.
        assert math.dist(world.tip(), expected) < (1e-6 if world.carrier is None else 1e-5)


def test_slew_zero_points_forward_and_positive_pitch_lifts(world):
    pose(world, slew=0.0, lift=0.0, tilt=-0.1, ext=0.5)
    x, y, z = world.tip()
    forward, aside = (y, x) if world.profile.name == "palms_471" else (x, y)
    assert abs(aside) < 1e-5 and forward > 5.0
    pose(world, slew=0.0, lift=0.3, tilt=-0.1, ext=0.5)
    assert world.tip()[2] > z + 1.0
    pose(world, slew=0.3, lift=0.3, tilt=-0.1, ext=0.5)
    x, y, _ = world.tip()
    turned = -x if world.profile.name == "palms_471" else y
    assert turned > 1.0


def test_jaw_tips_follow_the_profile_table(world):
    table, p = world.profile.grapple.jaws, world.client
    base = p.invertTransform(*world.base_pose())
    reach = {"slew": 0.0, "lift": 0.6, "tilt": -1.2, "ext": 0.5, "rot": 0.0, "fork": 0.0}
    pose(world, **reach, tong_left=0.0, tong_right=0.0)
    # The tips in the jaw frames, from the open row: half gap from the pivots, below the pivots.
    k = world.profile.kinematics
    pivot_z = k.hanger_to_fork_m + k.fork_to_rotator_m + k.rotator_to_tong_pivot_m
    pivot_x = abs(p.getJointInfo(world.crane.body, world.crane.index["tong_right"])[14][0])
    out, down = table.half_gap_m[0] - pivot_x, table.tip_below_pin_m[0] - pivot_z
    for angle, half_gap, below in zip(table.angle_rad, table.half_gap_m, table.tip_below_pin_m, strict=True):
        pose(world, **reach, tong_left=angle, tong_right=angle)
        poses = {n: p.multiplyTransforms(*base, *at) for n, at in world.link_poses().items()}
        pin, rotator = poses["hanger"][0], poses["rotator"]
        for side, link in ((-1, "tong_left"), (1, "tong_right")):
            tip, _ = p.multiplyTransforms(*poses[link], (side * out, 0.0, -down), (0, 0, 0, 1))
            across, _ = p.multiplyTransforms(*p.invertTransform(*rotator), tip, (0, 0, 0, 1))
            assert side * across[0] == pytest.approx(half_gap, abs=3e-3)
            assert pin[2] - tip[2] == pytest.approx(below, abs=3e-3)


def test_the_grapple_collides_only_with_the_bunk():
    profile = load_profile("aoro_fc8")
    w = World(profile, load_truth("nominal", 0, "aoro_fc8"), 0, ())
    bunk = profile.bunk
    name = {i: n for n, i in w.crane.link.items()}

    def touching(x: float, y: float, z: float) -> set[tuple[str, str]]:
        q = dict(zip(ACTIVE, solve(profile, x, y, z), strict=True))
        w.crane.place(q | {"rot": -q["slew"], "hanger": -q["lift"] - q["tilt"], "flex_pitch": 0.0, "flex_roll": 0.0})
        w.client.performCollisionDetection()
        return {(name[c[3]], name[c[4]]) for c in w.client.getContactPoints(w.crane.body, w.crane.body)}

    high, low = bunk.floor_z_m + 2.6, bunk.floor_z_m + 1.6
    stakes = [s for s in w.client.getCollisionShapeData(w.crane.body, -1) if s[3][2] == bunk.stake_height_m]
    assert stakes
    middle = bunk.center_m[0]
    assert touching(middle, 0.0, high) == set()
    assert touching(middle, 0.0, low) == set()
    floor = touching(middle, 0.0, bunk.floor_z_m + 1.1)
    assert {link for _, link in floor} == {"tong_left", "tong_right"} and {link for link, _ in floor} == {"rear"}
    for angle in (0.0, 1.2, 2.234):
        w.crane.place({"tong_left": angle, "tong_right": angle})
        assert touching(middle, 0.0, high) == set()
    w.close()


def test_the_column_is_plumb_and_still_at_home(world):
    w = World(world.profile, world.truth, 0, ())
    for joint, value in home_pose(world.profile).items():
        assert w.q[joint] == pytest.approx(value, abs=2e-3)
    before = w.tip()
    for _ in range(400):
        w.step([0.0] * len(w.functions))
    assert math.dist(w.tip(), before) < 2e-3
    assert math.dist(w.tip(), w.rigid_tip()) < 2e-3
    assert w.load_kg() < 2.0
    w.close()


def test_equal_inputs_give_bit_identical_motion(world):
    def run():
        w = World(world.profile, world.truth, 3, ())
        n = len(w.functions)
        for i in range(200):
            w.step([math.sin(0.02 * i + k) for k in range(n)])
        end = (repr(w.q), repr(w.link_poses()), w.hydraulics.energy_j)
        w.close()
        return end

    assert run() == run()


# -- the physics client: it caches functions, but never beyond its own lifetime


def test_a_closed_client_does_not_reach_a_later_one():
    first = new_client()
    assert first.getNumBodies() == 0
    number = first._client
    first.disconnect()
    second = new_client()
    try:
        assert second._client == number  # Bullet reuses it
        with pytest.raises(pybullet.error):
            first.getNumBodies()
    finally:
        second.disconnect()


def test_two_clients_do_not_share_cached_functions():
    one, other = new_client(), new_client()
    try:
        one.createMultiBody(1.0, one.createCollisionShape(one.GEOM_SPHERE, radius=0.1))
        assert (one.getNumBodies(), other.getNumBodies()) == (1, 0)
    finally:
        one.disconnect()
        other.disconnect()
