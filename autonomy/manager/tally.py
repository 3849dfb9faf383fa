"""Counts of a mission: logs on board, loads brought to landings, volumes, and logs given up with the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

from autonomy.missions.model import Point
from machine.profile import Bunk

PACKING_SHARE: Final = 0.60
"""Solid share of a bunk's volume when a crane loads it (assumed; 0.55 to 0.65)."""


def volume_m3(length_m: float, diameter_m: float) -> float:
    """Compute the volume of a cylinder."""
    return 0.25 * math.pi * diameter_m**2 * length_m


class LoadedLog(msgspec.Struct, frozen=True):
    """A log that was loaded into the bunk: where it had lain, when it was loaded, its solid volume."""

    position: Point
    at_ns: int
    volume_m3: float
    assortment: str = ""
    species: str = ""
    product_key: int | None = None


class Load(msgspec.Struct, frozen=True):
    """Logs unloaded together at one landing, by the landing's index; ``driven_m`` since the load before."""

    logs: tuple[LoadedLog, ...]
    at_ns: int
    driven_m: float
    landing: int = 0


class Remark(msgspec.Struct, frozen=True):
    """What the machine found out about its load against its expectation, in words, and when."""

    at_ns: int
    text: str


@dataclass(slots=True)
class Tally:
    """Counts and sums of a mission.

    ``on_board`` counts logs in the bunk, ``board`` lists those that this mission loaded, ``loads`` went to landings.
    ``counted_m`` is the driven distance at the last unloading; ``remarks`` are for the report.
    """

    loaded: int = 0
    unloaded: int = 0
    grasps: int = 0
    missed: int = 0
    on_board: int = 0
    board_m3: float = 0.0
    bunk_full: bool = False
    """The bunk had no room for a grasp."""
    given_up: dict[int, str] = field(default_factory=dict)
    loads: list[Load] = field(default_factory=list)
    board: list[LoadedLog] = field(default_factory=list)
    counted_m: float = 0.0
    remarks: list[Remark] = field(default_factory=list)

    def book_loaded(self, logs: Sequence[LoadedLog]) -> None:
        """Book a grasp that was placed in the bunk."""
        self.grasps += 1
        self.loaded += len(logs)
        self.on_board += len(logs)
        self.board += logs
        self.board_m3 += sum(log.volume_m3 for log in logs)

    def remark(self, now_ns: int, text: str) -> None:
        """Add a remark."""
        self.remarks.append(Remark(now_ns, text))

    def book_lost(self, logs: int) -> None:
        """Book that logs are no longer on board: which ones is unknown, so those loaded last."""
        self.loaded, self.on_board = max(0, self.loaded - logs), max(0, self.on_board - logs)
        for _ in range(min(logs, len(self.board))):
            self.board_m3 -= self.board.pop().volume_m3
        self.bunk_full = False

    def book_found(self, logs: int) -> None:
        """Book that more logs are on board than were booked: where they had lain and their size are those of the last
        one.
        """
        self.loaded, self.on_board = self.loaded + logs, self.on_board + logs
        if self.board:
            self.board_m3 += logs * self.board[-1].volume_m3
            self.board += logs * [self.board[-1]]

    def full(self, bunk: Bunk, next_m3: float = 0.0) -> bool:
        """Tell whether the bunk has no room for ``next_m3`` more wood [m3]."""
        room = PACKING_SHARE * bunk.length_m * bunk.width_m * bunk.stake_height_m
        return self.board_m3 + next_m3 > room

    def book_unloaded(self, logs: int) -> None:
        """Book a grasp from the bunk to a landing; it may include logs that were on board before the mission."""
        self.grasps += 1
        self.unloaded += logs
        self.on_board = max(0, self.on_board - logs)

    def book_empty(self, now_ns: int, driven_m: float, landing: int = 0) -> None:
        """Book an empty bunk after a driven distance of the whole mission [m]."""
        if self.board:  # else only logs from before the mission were unloaded
            self.loads.append(Load(tuple(self.board), now_ns, driven_m - self.counted_m, landing))
        self.board, self.counted_m = [], driven_m
        self.on_board, self.board_m3, self.bunk_full = 0, 0.0, False
