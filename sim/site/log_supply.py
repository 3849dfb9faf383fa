"""The logs of a mission's site: where they lie first, and their replacement for the next lap.

Paper B replaced the logs as soon as the machine had collected them (section 5.2): here every place has one log per
lap, and those of later laps wait far away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from machine.profile import Profile
from sim.plant import Plant
from sim.scenes.arrangements import arrangement
from sim.truth.load import load_truth
from sim.wood.log_shape import LogSpec

SUPPLY_DISTANCE_M: Final = 35.0
SUPPLY_SPACING_M: Final = 4.0
MACHINE_DISTANCE_M: Final = 14.0
"""A collected log is replaced when the machine is farther away than this."""
COLLECTED_M: Final = 1.5
"""A log farther than this from its place counts as collected."""


@dataclass(frozen=True, slots=True)
class LogPlace:
    """Place of a log in the world [m, rad]; values that are None are drawn from the truth's wood."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None
    length_m: float | None = None
    diameter_m: float | None = None


def place_logs(
    profile: Profile, truth: str, seed: int, places: Sequence[LogPlace], rounds: int = 1
) -> tuple[LogSpec, ...]:
    """Lay logs at the places, then as many for every further lap, far away.

    Raises:
        PlantError: the truth is unknown.
    """
    if not places:
        return ()
    wood = load_truth(truth, seed, profile.name).wood
    count = len(places) * rounds
    drawn = arrangement("row", profile, wood, seed, count, route=((0.0, 0.0), (10.0 * count + 20.0, 0.0)))
    placed_specs = []
    for i, spec in enumerate(drawn):
        location = places[i % len(places)]
        x_m, y_m = (
            (location.x_m, location.y_m)
            if i < len(places)
            else (-SUPPLY_DISTANCE_M, SUPPLY_SPACING_M * (i - len(drawn) / 2))
        )
        placed_specs.append(
            replace(
                spec,
                x_m=x_m,
                y_m=y_m,
                yaw_rad=spec.yaw_rad if location.yaw_rad is None else location.yaw_rad,
                length_m=location.length_m or spec.length_m,
                diameter_m=location.diameter_m or spec.diameter_m,
            )
        )
    return tuple(placed_specs)


def along_route(
    profile: Profile, truth: str, seed: int, logs: int, route: Sequence[tuple[float, float]]
) -> tuple[LogSpec, ...]:
    """Lay ``logs`` logs beside a route [m], drawn from the truth's wood.

    Raises:
        PlantError: there is no room beside the route.
    """
    return arrangement("row", profile, load_truth(truth, seed, profile.name).wood, seed, logs, route=route)


class LogSupplier:
    """Replaces collected logs once the machine is away."""

    def __init__(self, plant: Plant, places: int, rounds: int) -> None:
        self._plant = plant
        self._at = [(spec.x_m, spec.y_m) for spec in plant.world.log_bodies.scene[:places]]
        self._lying = list(range(places))
        self._waiting = [[i + k * places for k in range(1, rounds)] for i in range(places)]

    def step(self) -> int:
        """Check all places; returns how many logs were replaced."""
        laid, log_bodies = 0, self._plant.world.log_bodies
        if not any(self._waiting):
            return laid
        states, machine = log_bodies.states(), self._plant.base_pose()[0]
        for i, at in enumerate(self._at):
            taken = math.dist(states[self._lying[i]].position_m[:2], at) > COLLECTED_M
            if self._waiting[i] and taken and math.dist(machine[:2], at) > MACHINE_DISTANCE_M:
                fresh = self._lying[i] = self._waiting[i].pop(0)
                x, y, _ = states[fresh].position_m
                log_bodies.wake()
                log_bodies.move(fresh, at[0] - x, at[1] - y)
                laid += 1
        return laid
