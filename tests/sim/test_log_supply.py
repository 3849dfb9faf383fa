"""Logs of a mission: at the places of the plan; those of later laps wait on the plant's ground."""

from __future__ import annotations

import math
from itertools import combinations

from machine.loading.profile_file import load_profile
from sim.ground.terrain import EXTENT_M
from sim.site.log_supply import LogPlace, place_logs

PROFILE = load_profile("aoro_fc8")


def test_logs_lie_at_their_places_and_later_ones_wait_apart() -> None:
    places = [LogPlace(4.0 * i, 3.0, 0.1 * i, 2.0, 0.25) for i in range(12)]
    scene = place_logs(PROFILE, "nominal", 1, places, rounds=2)
    assert len(scene) == 24
    for spec, place in zip(scene, places, strict=False):
        assert (spec.x_m, spec.y_m, spec.yaw_rad) == (place.x_m, place.y_m, place.yaw_rad)
        assert (spec.length_m, spec.diameter_m) == (2.0, 0.25)
    for spec in scene[12:]:
        assert max(abs(spec.x_m), abs(spec.y_m)) + spec.length_m < EXTENT_M / 2
    for a, b in combinations(scene[12:], 2):
        assert math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) > a.length_m
