"""The ground: one surface for tyres, cameras and Bullet."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from sim.bullet.client import new_client
from sim.errors import PlantError
from sim.ground.terrain import KINDS, ROUGHNESS_LAYERS, Terrain
from tests.codes import coded


@pytest.mark.parametrize("kind", KINDS)
def test_bullet_and_height_are_one_surface(kind):
    terrain, client, rng = Terrain(kind, 5, 0.3), new_client(), random.Random(1)
    terrain.add_to(client, 0.9)
    points = [(rng.uniform(-25.0, 25.0), rng.uniform(-25.0, 25.0)) for _ in range(300)]
    hits = client.rayTestBatch([[x, y, 9.0] for x, y in points], [[x, y, -9.0] for x, y in points])
    for (x, y), hit in zip(points, hits, strict=True):
        assert hit[0] == terrain.body
        assert hit[3][2] == pytest.approx(terrain.height(x, y), abs=1e-4)
        assert hit[4] == pytest.approx(terrain.normal(x, y), abs=2e-3)
    client.disconnect()


@pytest.mark.parametrize("kind", KINDS)
def test_the_grid_agrees_with_the_height(kind):
    terrain = Terrain(kind, 2)
    x0, y0 = terrain.origin_m
    for i, j in ((0, 0), (1, 0), (0, 1), (len(terrain.heights) - 1,) * 2):
        at = terrain.height(x0 + i * terrain.cell_m, y0 + j * terrain.cell_m)
        assert at == pytest.approx(terrain.heights[i, j], abs=1e-9)


def test_terrain_kinds():
    assert Terrain("flat", 1, -1.3).height(3.0, -7.0) == -1.3
    slope = Terrain("slope")
    assert slope.height(5.0, 2.0) == pytest.approx(0.2)
    assert slope.normal(5.0, 2.0) == pytest.approx((0.0, -0.1 / math.sqrt(1.01), 1.0 / math.sqrt(1.01)))
    with pytest.raises(PlantError, check=coded("terrain.unknown-kind")):
        Terrain("lunar")


def test_rough_terrain_follows_its_seed_and_has_the_stated_roughness():
    one, same, other = Terrain("rough", 1), Terrain("rough", 1), Terrain("rough", 2)
    assert np.array_equal(one.heights, same.heights)
    assert not np.array_equal(one.heights, other.heights)
    assert one.height(0.0, 0.0) == 0.0
    assert one.heights.std() == pytest.approx(math.hypot(*(sigma for sigma, _ in ROUGHNESS_LAYERS)), rel=0.05)
    steepness = np.hypot(*np.gradient(one.heights, one.cell_m))
    assert 0.03 < steepness.mean() < 0.12 and steepness.max() < 0.4


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "flat"])
def test_a_wider_ground_is_the_same_nearer_by_and_reaches_farther(kind):
    near, wide = Terrain(kind, 3), Terrain(kind, 3, 0.0, 71.0)
    rng = random.Random(2)
    for _ in range(200):
        x, y = rng.uniform(-38.0, 38.0), rng.uniform(-38.0, 38.0)
        assert wide.height(x, y) == pytest.approx(near.height(x, y), abs=1e-6)
    client = new_client()
    wide.add_to(client, 0.9)
    for x, y in ((70.0, 3.0), (-70.0, 3.0), (3.0, 70.0), (3.0, -70.0)):
        (hit,) = client.rayTestBatch([[x, y, 20.0]], [[x, y, -20.0]])
        assert hit[0] == wide.body and hit[3][2] == pytest.approx(wide.height(x, y), abs=1e-4)
    client.disconnect()


def test_drawn_ground_has_obstacles_and_ruts_and_leaves_the_machines_first_place_free():
    for seed in range(4):
        ground = Terrain("drawn", seed)
        x = (np.arange(len(ground.heights)) - len(ground.heights) // 2) * ground.cell_m
        away = np.hypot(x[:, None], x[None, :])
        steep = np.hypot(*np.gradient(ground.heights, ground.cell_m))
        assert steep[away < 3.5].max() < 0.35 < steep[away > 6.0].max(), "stones and stumps are steep"
        assert ground.height(0.0, 0.0) == 0.0 and np.abs(ground.heights).max() < 6.0
    assert not np.array_equal(Terrain("drawn", 1).heights, Terrain("drawn", 2).heights)


def test_a_box_comes_to_rest_on_rough_ground():
    terrain, client = Terrain("rough", 4), new_client()
    client.setGravity(0.0, 0.0, -9.81)
    client.setPhysicsEngineParameter(fixedTimeStep=0.0025)
    terrain.add_to(client, 1.0)
    shape = client.createCollisionShape(client.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1])
    body = client.createMultiBody(5.0, shape, basePosition=[3.0, -2.0, terrain.height(3.0, -2.0) + 0.15])
    for _ in range(800):
        client.stepSimulation()
    x, y, z = client.getBasePositionAndOrientation(body)[0]
    assert z - terrain.height(x, y) == pytest.approx(0.1, abs=0.02)
    assert math.hypot(x - 3.0, y + 2.0) < 0.1
    client.disconnect()
