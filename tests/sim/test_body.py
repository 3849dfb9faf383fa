"""The crane's body: kinematics equal to the profile's, tongs as the profile's table, scenes, truth."""

from __future__ import annotations

import ast
import math
import random
from dataclasses import astuple
from pathlib import Path

import pytest

from machine.kinematics import pin_position
from machine.load import load_profile
from sim.scene import random_scene
from sim.truth import load_truth
from sim.world import World

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def world():
    w = World(PROFILE, NOMINAL, seed=0, logs=1)
    yield w
    w.close()


def test_hanger_pin_of_the_urdf_equals_the_denavit_hartenberg_chain(world):
    rng = random.Random(1)
    for _ in range(50):
        names = ("slew", "lift", "tilt", "ext")
        q = [rng.uniform(PROFILE.joints[n].lower, PROFILE.joints[n].upper) for n in names]
        world.crane.place(dict(zip(names, q, strict=True)))
        assert math.dist(world.tip(), pin_position(PROFILE.kinematics, [*q, 0.0])) < 1e-6


def test_slew_zero_reaches_along_y_and_positive_pitch_lifts(world):
    world.crane.place({"lift": 0.0, "tilt": 0.0, "ext": 0.5})
    x, y, z = world.tip()
    assert abs(x) < 1e-6 and y > 5.0
    world.crane.place({"lift": 0.3, "tilt": 0.0, "ext": 0.5})
    assert world.tip()[2] > z + 1.0


def test_tong_tips_follow_the_profile_table(world):
    table = PROFILE.grapple.tongs
    for angle, half_gap, below in zip(table.angle_rad, table.half_gap_m, table.tip_below_pin_m, strict=True):
        world.crane.place({"lift": 0.6, "tilt": -1.2, "ext": 0.5, "tong_left": angle, "tong_right": angle})
        pin, poses = world.tip(), world.crane.link_poses()
        for side, link in ((-1, "tong_left"), (1, "tong_right")):
            position, turn = poses[link]
            tip, _ = world.client.multiplyTransforms(position, turn, (side * 0.458, 0.02, -0.458), (0, 0, 0, 1))
            assert side * (tip[0] - pin[0]) == pytest.approx(half_gap, abs=2e-3)
            assert pin[2] - tip[2] == pytest.approx(below, abs=2e-3)


def test_scene_depends_on_the_seed_alone_and_keeps_logs_apart():
    first, again, other = (random_scene(PROFILE, NOMINAL.contact, s, 3) for s in (5, 5, 6))
    assert first == again != other
    (cx, cy), half = PROFILE.workspace.pick_center_m, PROFILE.workspace.pick_half_size_m
    for log in first:
        assert abs(log.x_m - cx) <= half and abs(log.y_m - cy) <= half
        assert 2.5 <= log.length_m <= 2.8 and 0.10 <= log.diameter_m <= 0.30
    with pytest.raises(ValueError, match="fewer logs"):
        random_scene(PROFILE, NOMINAL.contact, 5, 60)


def test_a_sampled_individual_is_repeatable_and_close_to_the_nominal_one():
    one, again, other = (load_truth("sampled", s) for s in (1, 1, 2))
    assert one == again and one != other and one != NOMINAL
    assert load_truth("nominal", 1) == NOMINAL
    for name, valve in one.valves.items():
        assert all(0.6 < a / b < 1.4 for a, b in zip(_floats(valve), _floats(NOMINAL.valves[name]), strict=True))


def _floats(struct) -> list[float]:
    return [getattr(struct, f) for f in struct.__struct_fields__]


def test_nobody_outside_sim_reads_the_truth():
    folders = ("can_dbc", "machine", "controller", "autonomy", "recorder", "hil", "console", "timberhand")
    sinners = []
    for path in (p for folder in folders for p in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{a.name}" for a in node.names]
            sinners += [str(path) for n in names if n.startswith("sim.truth") or "load_truth" in n]
    assert not sinners


def test_a_log_lies_still_on_the_ground(world):
    before = world.yard.states()[0]
    for _ in range(200):
        world.client.stepSimulation()
    after = world.yard.states()[0]
    assert math.dist(before.position_m, after.position_m) < 1e-3 and after.speed_m_s < 5e-3
    assert after.position_m[2] == pytest.approx(PROFILE.workspace.ground_z_m + after.diameter_m / 2, abs=1e-3)
    assert math.hypot(*after.axis) == pytest.approx(1.0) and len(astuple(after)) == 7
