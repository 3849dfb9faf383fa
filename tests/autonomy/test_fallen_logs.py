"""A log that lies where the loaded machine has been fell off it; a camera that looks ahead sees it on the next lap."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from autonomy.manager.load_bookkeeping import MAX_PLACES, MIN_HITS, FallenLogs, LoadBookkeeping
from autonomy.manager.log_map import LogMap, MappedLog
from autonomy.manager.sorting import Sorting
from autonomy.manager.tally import LoadedLog
from autonomy.missions.model import ForwardingMission, Point
from machine.loading.profile_file import load_profile
from tests.autonomy.mapped_logs import base, lying
from tests.codes import numbers_in

PROFILE = load_profile("aoro_fc8")
BUNK = PROFILE.bunk


def seen_often(number: int, x_m: float, y_m: float) -> MappedLog:
    return replace(lying(number, x_m, y_m, 0.3), hits=MIN_HITS)


def driven(to_m: float = 30.0, next_number: int = 5) -> FallenLogs:
    """The crane's base went east, looking back over the bunk."""
    fallen = FallenLogs(BUNK)
    for x_m in range(round(2 * to_m)):
        fallen.passes(base(0.5 * x_m, 0.0, math.pi), next_number)
    return fallen


@pytest.mark.parametrize(
    ("number", "y_m", "fell"),
    [(5, 1.3, True), (5, -1.5, True), (5, 0.0, True), (5, 3.0, False), (4, 1.3, False)],
    ids=["beside", "on the other side", "under it", "where logs are laid", "known before"],
)
def test_a_new_log_where_the_bunk_was_has_fallen_off(number: int, y_m: float, fell: bool) -> None:
    assert bool(driven().fallen([seen_often(number, 12.0, y_m)])) is fell


def test_it_is_told_once_and_only_when_it_is_certain() -> None:
    fallen, log = driven(), seen_often(5, 12.0, 1.3)
    assert not fallen.fallen([replace(log, hits=MIN_HITS - 1)])
    assert fallen.fallen([log]) == [log]
    assert not fallen.fallen([log])


def test_nothing_falls_where_the_machine_has_not_been_or_out_of_an_empty_bunk() -> None:
    fallen, log = driven(to_m=5.0), seen_often(5, 12.0, 1.3)
    assert not fallen.fallen([log])
    fallen = driven()
    fallen.forget()
    assert not fallen.fallen([log])
    assert MAX_PLACES >= 2 * 1000


def test_a_log_that_fell_off_is_booked_and_said() -> None:
    told = ForwardingMission("test", (Point(0.0, 0.0), Point(0.0, 0.001)))
    field = LogMap(BUNK)
    world: Any = SimpleNamespace(
        sorting=Sorting(told), log_map=field, base=base(0.0, 0.0, math.pi), is_on_landing=lambda log: False
    )
    load = LoadBookkeeping(PROFILE, told, world)
    load.tally.book_loaded([LoadedLog(Point(0.0, 0.0), 1, 0.1)] * 3, 300.0)
    for x_m in range(20):
        world.base = base(float(x_m), 0.0, math.pi)
        assert load.check_fallen(x_m) == 0
    field.restore(seen_often(1, 8.0, 1.4))
    assert load.check_fallen(30) == 1 and load.check_fallen(31) == 0
    tally = load.tally
    assert (tally.loaded, tally.on_board) == (2, 2)
    (remark,) = tally.remarks
    assert remark.at_ns == 30 and 1 in numbers_in(remark.text)
