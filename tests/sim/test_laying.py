"""Logs of a site on any ground: they rest where they are laid, or are laid so that they do."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from autonomy.missions.mission_file import load_mission
from hil.missions.site import site_of
from machine.loading.profile_file import load_profile
from sim.errors import PlantError
from sim.ground.terrain import KINDS, Terrain
from sim.site.log_supply import LogSupplier
from sim.site.site_file import MAX_ATTEMPTS, Site, laid_at_rest
from sim.wood.log_shape import LogSpec
from tests.codes import coded

ROOT = Path(__file__).resolve().parents[2]
PROFILE = load_profile("aoro_fc8")
MISSION = load_mission(ROOT / "docs" / "examples" / "paper_b.geojson", route_wanted=True).mission
HILL = Terrain("hill")
ACROSS, ALONG = LogSpec(9.0, 4.0, 0.0, 2.0, 0.3, 900.0), LogSpec(9.0, 9.0, 1.6, 2.0, 0.3, 900.0)


class Slope:
    """Builds plants on which a log rolls that lies across the slope; ``stubborn`` ones need a place farther aside."""

    def __init__(self, stubborn: float = 0.0, by_error: bool = False) -> None:
        self.scenes: list[tuple[LogSpec, ...]] = []
        self._stubborn, self._by_error = stubborn, by_error

    def build(self, scene: tuple[LogSpec, ...]) -> Any:
        self.scenes.append(scene)
        rolling = tuple(i for i, log in enumerate(scene) if self.rolls(log))
        if rolling and self._by_error:
            error = PlantError("logs.not-at-rest", "it rolls")
            error.logs = rolling
            raise error
        states = [
            SimpleNamespace(position_m=(log.x_m, log.y_m - 3.0 * (i in rolling), 0.0)) for i, log in enumerate(scene)
        ]
        return SimpleNamespace(logs=lambda: states, close=lambda: None, scene=scene)

    def rolls(self, log: LogSpec) -> bool:
        return abs(math.sin(log.yaw_rad)) < 0.9 or abs(log.x_m - 9.0) < self._stubborn


@pytest.mark.parametrize("by_error", [False, True])
def test_a_log_that_rolls_is_turned_into_the_slope_and_the_others_stay(by_error: bool) -> None:
    slope = Slope(by_error=by_error)
    plant: Any = laid_at_rest(slope.build, (ACROSS, ALONG), HILL)
    turned, other = plant.scene
    assert other == ALONG and len(slope.scenes) == 2
    assert replace(turned, yaw_rad=0.0) == replace(ACROSS, yaw_rad=0.0)
    assert abs(math.sin(turned.yaw_rad)) == pytest.approx(1.0)


def test_a_log_that_still_rolls_is_laid_aside() -> None:
    slope = Slope(stubborn=0.7)
    plant: Any = laid_at_rest(slope.build, (ACROSS,), HILL)
    assert 0.7 <= abs(plant.scene[0].x_m - 9.0) < 1.5


def test_a_log_that_never_rests_ends_with_the_reason() -> None:
    slope = Slope(stubborn=100.0, by_error=True)
    with pytest.raises(PlantError, check=coded("logs.not-at-rest")):
        laid_at_rest(slope.build, (ACROSS,), HILL)
    assert len(slope.scenes) == MAX_ATTEMPTS + 1


def test_another_fault_of_the_scene_is_not_tried_again() -> None:
    def build(scene: tuple[LogSpec, ...]) -> Any:
        raise PlantError("logs.overlap", "they overlap")

    with pytest.raises(PlantError, check=coded("logs.overlap")):
        laid_at_rest(build, (ACROSS,), HILL)


@pytest.mark.parametrize("kind", ["slope", "hill", "drawn"])
def test_thick_and_bowed_logs_across_the_slope_rest_at_their_places(kind: str) -> None:
    logs = tuple(LogSpec(3.0 * i - 9.0, 8.0, 0.2 * i, 2.2, 0.2 + 0.03 * i, 900.0, 0.008, 0.005 * i) for i in range(5))
    plant = Site(63.65, 19.9, logs, terrain=kind).plant(PROFILE, "nominal", 3)
    for log, state in zip(logs, plant.logs(), strict=True):
        assert math.dist(state.position_m[:2], (log.x_m, log.y_m)) < 0.8
        turned_rad = math.remainder(math.atan2(state.axis[1], state.axis[0]) - log.yaw_rad, math.pi)
        assert kind == "drawn" or abs(turned_rad) < 0.35, "the floor of the forest held it; nobody turned it"
        assert abs(state.position_m[2] - plant.world.terrain.height(*state.position_m[:2])) < 0.5
    plant.close()


def test_a_later_lap_lies_on_the_slope_and_not_in_the_air() -> None:
    first, later = LogSpec(18.0, 9.0, 0.3, 2.0, 0.25, 900.0), LogSpec(-20.0, -6.0, 0.3, 2.0, 0.25, 900.0)
    plant = Site(63.65, 19.9, (first, later), 1, 2, "slope").plant(PROFILE, "nominal", 1)
    supply = LogSupplier(plant, 1, 2)
    plant.world.log_bodies.wake()
    plant.world.log_bodies.move(0, 0.0, 30.0)
    supply.step()
    x, y, z = plant.logs()[1].position_m
    assert math.dist((x, y), (18.0, 9.0)) < 0.3
    assert 0.0 < z - plant.world.terrain.height(x, y) < 0.3
    plant.close()


@pytest.mark.long
@pytest.mark.parametrize("logs", [0, 24])
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_mission_can_be_laid_out_on_any_ground(kind: str, seed: int, logs: int) -> None:
    plant = site_of(MISSION, PROFILE, seed, "nominal", logs, kind).plant(PROFILE, "nominal", seed)
    assert len(plant.logs()) == 24
    plant.close()
