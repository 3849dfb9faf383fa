"""Every transition of both tables, the invariants of the tables, and the page that shows them."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest

from autonomy.manager.state_chart import page
from autonomy.manager.transition_table import (
    EVENT_DESCRIPTIONS,
    FINAL_STATES,
    OURS,
    PAPER_B,
    RULES,
    Event,
    Height,
    State,
    awaited_events,
    next_state,
)

TABLES = {"paper_b": PAPER_B, "ours": OURS}
PAIRS = list(itertools.product(TABLES, State, Event))


@pytest.mark.parametrize(("name", "state", "event"), PAIRS)
def test_only_transitions_of_the_table_are_possible(name: str, state: State, event: Event) -> None:
    table = TABLES[name]
    if (state, event) in table:
        assert next_state(table, state, event) is table[state, event]
    elif event is Event.TIME_OUT:
        assert next_state(table, state, event) is State.FAILED
    else:
        with pytest.raises(KeyError):
            next_state(table, state, event)


def reached_from(table, *begins: State, without: State | None = None) -> set[State]:
    """The states that a mission comes to after these, by ways that do not lead through one."""
    reached, front = set(begins), list(begins)
    while front:
        state = front.pop()
        for (begin, _), end in table.items():
            if begin is state and end not in reached and end is not without:
                reached.add(end)
                front.append(end)
    return reached


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_every_state_is_reached_and_left(table) -> None:
    used = {state for state, _ in table} | set(table.values())
    reached = reached_from(table, State.IDLE)
    assert reached == used
    assert State.DONE in reached
    for state in used - FINAL_STATES:
        assert awaited_events(table, state), state


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_final_states_have_no_transitions(table) -> None:
    assert not any(state in FINAL_STATES for state, _ in table)


def test_every_state_and_event_has_a_description_and_an_end() -> None:
    assert set(RULES) == set(State) and set(EVENT_DESCRIPTIONS) == set(Event)
    for state, rule in RULES.items():
        assert rule.description
        waits = state in FINAL_STATES or state is State.IDLE
        assert math.isinf(rule.timeout_s) == waits and bool(rule.timeout_reason) != waits


def test_the_machine_only_drives_after_the_crane_is_stowed() -> None:
    for table in TABLES.values():
        seen = reached_from(table, State.COLLECT, State.UNLOAD, without=State.STOW)
        assert not any(RULES[state].drives for state in seen), seen


def test_the_crane_only_works_at_standstill_with_the_frame_lowered() -> None:
    for table in TABLES.values():
        for (begin, event), end in table.items():
            if end is not State.STOW and RULES[end].crane and not RULES[begin].crane:  # there it has been at work
                assert RULES[begin].height is Height.LOADING and event is Event.AT_HEIGHT
    assert not any(rule.crane and rule.drives for rule in RULES.values())


def test_paper_b_observes_at_standstill_and_passes_the_log_before_loading() -> None:
    """Fig. 8: every path from the search to the crane includes these states."""
    for needed in (State.HALT, State.LOOK, State.APPROACH, State.CHECK, State.LOWER):
        assert State.COLLECT not in reached_from(PAPER_B, State.SEARCH, without=needed), needed


def test_the_page_of_the_activity_manager_is_as_the_code_has_it() -> None:
    shown = Path(__file__).parents[2] / "docs" / "activity.md"
    assert shown.read_text() == page(), "run `timberhand mission states --docs docs`"
