"""Which logs are collected and where they go: the rules alone, and whole missions on the stand-in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection, select_direct
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.sorting import Sorting
from autonomy.manager.transition_table import State
from autonomy.missions.model import ForwardingMission, KnownLog, Landing, Options, Point
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import PLANE, again, at, completed, ended, forwarder, managed, place, states, whole
from tests.autonomy.mapped_logs import lying
from tests.codes import numbers_in

SAW, PULP, ALL, NONE = ("saw logs",), ("pulpwood",), (), ("energy",)
Lie = tuple[str, float, float]
"""A log's assortment and position [m]; it lies along the route."""


def sorting(*takes: tuple[str, ...], sorts: bool = True, only: tuple[str, ...] = ()) -> Sorting:
    landings = tuple(Landing(Point(63.0, 19.0), "", None, names) for names in takes)
    options = Options(logs="listed", sort_by_assortment=sorts, assortments=only)
    return Sorting(ForwardingMission(landings=landings, options=options))


def mission(
    lie: Sequence[Lie], landings: Sequence[tuple[float, float, tuple[str, ...]]] = (), end_m: float = 26.0, **options
) -> ForwardingMission:
    way = (place(10.0, 0.0), place(end_m, 0.0))
    known = tuple(KnownLog(place(x, y), "", 90.0, 2.0, 0.25, "", kind) for kind, x, y in lie)
    piles = tuple(Landing(place(x, y), "" if i else "Road", None, kinds) for i, (x, y, kinds) in enumerate(landings))
    return ForwardingMission("test", way, (), piles, known, Options(logs="listed", **options))


def begin(lie: Sequence[Lie], landings=(), selector=select_direct, **options) -> tuple[Forwarder, ActivityManager]:
    logs = [lying(number, x, y) for number, (_, x, y) in enumerate(lie, 1)]
    return forwarder(logs), managed(mission(lie, landings, **options), plane=PLANE, selector=selector)


BESIDE = (("pulpwood", 18.0, 4.4), ("saw logs", 18.0, 4.9))
PILES = ((34.0, 14.0, SAW), (34.0, -14.0, PULP))


def first_grasp(lie: Sequence[Lie], landings=(), **options) -> list[int]:
    """The logs that a planner which takes several takes first."""
    machine, manager = begin(lie, landings, PlannerSelection(SamplingPlanner()), **options)
    machine.run(manager, lambda m: ended(m) or (m.activity is not None and m.activity.grasp is not None))
    return sorted(log.id for log in manager.activity.grasp.logs)


# -- the rules
def test_without_selection_every_log_is_wanted() -> None:
    plain = sorting(SAW, PULP, sorts=False)
    assert plain.wants("") and plain.wants("veneer")


def test_logs_of_other_and_unknown_assortments_are_left() -> None:
    only = sorting(sorts=False, only=SAW)
    assert only.wants("saw logs") and not only.wants("pulpwood") and not only.wants("")


def test_landings_that_name_an_assortment_precede_those_that_name_none() -> None:
    several = sorting(ALL, SAW, ALL, (*PULP, *SAW))
    assert [several.landing_of(kind) for kind in ("saw logs", "pulpwood", "veneer", "")] == [1, 3, 0, 0]
    assert sorting(SAW).landing_of("pulpwood") is None and not sorting(SAW).wants("pulpwood")


def test_the_first_log_on_board_decides_the_landing() -> None:
    both = sorting(SAW, PULP)
    assert both.wants("saw logs") and both.wants("pulpwood")
    both.book_loaded(["pulpwood", "saw logs"])
    assert both.landing == 1 and both.wants("pulpwood") and not both.wants("saw logs")
    both.book_loaded(["saw logs"])
    assert both.landing == 1, "a log loaded by mistake changes nothing"
    both.book_unloaded()
    assert both.wants("saw logs")


def test_a_first_grasp_holds_logs_of_one_landing() -> None:
    both = sorting(SAW, PULP)
    assert both.may_share_grasp("pulpwood", "pulpwood") and not both.may_share_grasp("saw logs", "pulpwood")
    assert sorting(SAW, PULP, sorts=False).may_share_grasp("saw logs", "pulpwood")


def test_a_load_keeps_the_nearest_landing() -> None:
    plain = sorting(ALL, ALL, sorts=False)
    assert plain.choose_landing([(0.0, 0.0), (9.0, 0.0)], (8.0, 0.0)) == 1
    assert plain.choose_landing([(0.0, 0.0), (9.0, 0.0)], (1.0, 0.0)) == 1
    plain.book_unloaded()
    assert plain.choose_landing([(0.0, 0.0), (9.0, 0.0)], (1.0, 0.0)) == 0
    sorted_ = sorting(SAW, PULP)
    sorted_.book_loaded(PULP)
    assert sorted_.choose_landing([(0.0, 0.0), (9.0, 0.0)], (1.0, 0.0)) == 1


def test_another_round_is_needed_for_logs_of_other_landings() -> None:
    both = sorting(SAW, PULP)
    assert not both.needs_another_round(PULP), "nothing was loaded"
    both.book_loaded(SAW)
    assert both.needs_another_round(PULP) and not both.needs_another_round(SAW) and not both.needs_another_round(NONE)
    both.book_unloaded()
    both.book_loaded(PULP)
    assert both.needs_another_round(SAW), "some of it was passed while the other was on board"
    both.start_round()
    assert both.rounds == 1 and not both.needs_another_round(SAW)
    assert not sorting(SAW, PULP, sorts=False).needs_another_round(PULP)


def test_one_of_several_landings_has_its_name_or_number() -> None:
    several = Sorting(mission((), ((0.0, 0.0, ()), (9.0, 0.0, ()))))
    assert [several.landing_name(i) for i in (0, 1, None)] == ["Road", "landing 2", ""]
    assert sorting(ALL).landing_name(0) == ""


KINDS = st.sampled_from(["", "saw logs", "pulpwood", "energy"])


@given(
    st.lists(st.lists(KINDS.filter(bool), max_size=2).map(tuple), min_size=1, max_size=4),
    st.lists(KINDS.filter(bool), max_size=2).map(tuple),
    st.lists(st.lists(KINDS, min_size=1, max_size=3), max_size=6),
)
def test_wanted_logs_always_belong_to_the_landing_of_the_load(takes, only, grasps) -> None:
    rules = sorting(*takes, only=only)
    for kinds in grasps:
        if not rules.wants(kinds[0]):
            continue  # the machine does not stop for logs to be left
        taken = [k for k in kinds if rules.wants(k) and rules.may_share_grasp(k, kinds[0])]
        rules.book_loaded(taken)
        assert not taken or {rules.landing_of(k) for k in taken} == {rules.landing}
        assert all(rules.landing_of(k) == rules.landing for k in taken) and (not only or set(taken) <= set(only))


# -- whole missions
@whole
def test_the_machine_does_not_stop_for_unwanted_logs() -> None:
    lie = (("pulpwood", 14.0, 4.2), ("saw logs", 22.0, 4.4))
    machine, manager = begin(lie, assortments=SAW)
    completed(machine, manager)
    assert machine.in_bunk == manager.tally.loaded == 1 and states(manager).count(State.APPROACH) == 1
    assert machine.field[1].center_m[:2] == pytest.approx((14.0, 4.2), abs=0.01)


@whole
@pytest.mark.parametrize(("only", "grasp"), [(SAW, [2]), ((), [1, 2])])
def test_an_unwanted_log_is_not_grasped_with_its_neighbour(only, grasp) -> None:
    assert first_grasp(BESIDE, assortments=only) == grasp


@whole
def test_the_first_grasp_of_a_sorted_load_has_one_landing() -> None:
    assert len(first_grasp(BESIDE, PILES, sort_by_assortment=True)) == 1


@whole
def test_two_landings_get_their_own_assortments_in_two_rounds() -> None:
    lie = (("saw logs", 15.0, 4.2), ("pulpwood", 18.0, -4.4), ("veneer", 21.0, 4.4))
    machine, manager = begin(lie, PILES, sort_by_assortment=True)
    said: dict[State, str] = {}

    def over(_: ActivityManager) -> bool:
        said[manager.state] = said.get(manager.state, "") + manager.description
        return ended(manager)

    machine.run(manager, over, 1500.0)
    assert manager.state is State.DONE, manager.failure
    brought = {(load.landing, *(log.assortment for log in load.logs)) for load in manager.tally.loads[:2]}
    assert brought == {(0, "saw logs"), (1, "pulpwood")}
    for number, (x, y, _) in zip((1, 2), PILES, strict=True):
        assert math.dist(machine.field[number].center_m[:2], (x, y)) < 1.6
    assert machine.field[3].center_m[:2] == pytest.approx((21.0, 4.4), abs=0.01), "no landing takes it"
    assert manager.world.sorting.rounds == 1, "in the second one both were served"
    assert all(name in said[state] for state in (State.HAUL, State.UNLOAD) for name in ("Road", "landing 2"))
    assert 2 in numbers_in(said[State.SEARCH]), "the round"


@whole
def test_a_planner_restarted_with_a_load_drives_the_second_round(tmp_path: Path) -> None:
    lie = (("saw logs", 15.0, 4.2), ("pulpwood", 18.0, -4.4))
    machine, manager = begin(lie, PILES, sort_by_assortment=True)
    machine.run(manager, at(State.HAUL))
    told = mission(lie, PILES, sort_by_assortment=True)
    manager = again(machine, manager, told, tmp_path / "progress.json", auto=True)
    completed(machine, manager, 1500.0)
    assert manager.tally.unloaded == 2 and manager.world.sorting.rounds == 1


@whole
def test_the_round_in_which_nothing_was_loaded_is_the_last() -> None:
    """A listed log that is not found needs one more round, not endless ones."""
    lie = (("saw logs", 15.0, 4.2), ("pulpwood", 18.0, -9.5))
    machine, manager = begin(lie, PILES, sort_by_assortment=True)
    completed(machine, manager, 1500.0)
    assert manager.world.sorting.rounds == 1 and manager.tally.loaded == manager.tally.unloaded == 1
    assert machine.field[2].center_m[:2] == pytest.approx((18.0, -9.5), abs=0.01)


@whole
def test_an_unsorted_load_goes_to_the_nearest_landing() -> None:
    machine, manager = begin((("saw logs", 15.0, 4.2),), ((-30.0, 12.0, SAW), (34.0, 14.0, PULP)))
    machine.run(manager, at(State.HAUL))
    completed(machine, manager, 900.0)
    (load,) = manager.tally.loads
    assert load.landing == 1 and math.dist(machine.field[1].center_m[:2], (34.0, 14.0)) < 1.6
