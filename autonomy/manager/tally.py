"""What is on board and what was done: loads, volumes, and every log that was given up, with its reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

from autonomy.missions.model import Point
from machine.profile import Bunk

PACKING: Final = 0.60
"""Share of a bunk's volume that is wood when logs lie in it as a crane lays them (assumed; 0.55 to 0.65)."""


def volume_m3(length_m: float, diameter_m: float) -> float:
    """Of a cylinder."""
    return 0.25 * math.pi * diameter_m**2 * length_m


class Taken(msgspec.Struct, frozen=True):
    """A log that was brought into the bunk: where it had lain, when, and its solid volume."""

    position: Point
    at_ns: int
    volume_m3: float
    assortment: str = ""


class Load(msgspec.Struct, frozen=True):
    """What was brought at once to a landing, by its place in the mission; ``driven_m`` since the load before."""

    logs: tuple[Taken, ...]
    at_ns: int
    driven_m: float
    landing: int = 0


@dataclass(slots=True)
class Tally:
    """Counts and sums of a mission; ``on_board`` logs are in the bunk now, ``board`` are those of them that the mission
    took, ``loads`` went to landings, the last one after ``counted_m`` of the mission's way.
    """

    loaded: int = 0
    unloaded: int = 0
    grasps: int = 0
    missed: int = 0
    on_board: int = 0
    board_m3: float = 0.0
    board_kg: float = 0.0
    brimful: bool = False
    """A log was gripped for which the bunk had no room."""
    given_up: dict[int, str] = field(default_factory=dict)
    loads: list[Load] = field(default_factory=list)
    board: list[Taken] = field(default_factory=list)
    counted_m: float = 0.0

    def took(self, logs: Sequence[Taken], load_kg: float) -> None:
        """A grasp that went into the bunk."""
        self.grasps += 1
        self.loaded += len(logs)
        self.on_board += len(logs)
        self.board += logs
        self.board_m3 += sum(log.volume_m3 for log in logs)
        self.board_kg += load_kg if math.isfinite(load_kg) else 0.0

    def full(self, bunk: Bunk, next_m3: float = 0.0) -> bool:
        """Whether the bunk has no room for so much more wood [m3]."""
        room = PACKING * bunk.length_m * bunk.width_m * bunk.stake_height_m
        return self.board_m3 + next_m3 > room

    def laid_down(self, logs: int) -> None:
        """A grasp that went from the bunk to a landing; it may have held logs that were on board before the mission."""
        self.grasps += 1
        self.unloaded += logs
        self.on_board = max(0, self.on_board - logs)

    def emptied(self, now_ns: int, driven_m: float, landing: int = 0) -> None:
        """Nothing is left in the bunk, after so much way of the whole mission [m]."""
        if self.board:  # and not only what was on board before
            self.loads.append(Load(tuple(self.board), now_ns, driven_m - self.counted_m, landing))
        self.board, self.counted_m = [], driven_m
        self.on_board, self.board_m3, self.board_kg, self.brimful = 0, 0.0, 0.0, False
