"""The numbers of a shift: what is counted, what is not, and that they outlive a page."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import msgspec
import pytest

from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import encode_mission
from console.access_guards import TOKEN_HEADER
from console.console import Console
from console.state import MIN_RATE_NS, CraneState, Shift
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.page_client import page_client
from tests.console.state_reports import REPORT

S = 10**9
PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)


def mission(**changed):
    return msgspec.structs.replace(MISSION_REPORT, **changed)


def test_only_what_follows_is_counted_of_a_mission_that_had_begun() -> None:
    shift = Shift()
    shift.begin(0)
    shift.on_mission(mission(loaded=4, on_board_m3=0.29, driven_m=41.5))
    shift.on_mission(mission(loaded=5, on_board_m3=0.39, driven_m=50.0))
    shift.on_mission(mission(loaded=6, on_board_m3=0.59, driven_m=50.0))
    numbers = shift.numbers(S)
    assert numbers is not None
    assert (numbers["logs"], numbers["m3"], numbers["driven_m"]) == (2, 0.3, 8.5)


def test_unloading_takes_nothing_away_and_a_new_mission_is_added() -> None:
    shift = Shift()
    shift.begin(0)
    for told in (
        mission(loaded=0, on_board_m3=0.0, driven_m=0.0),
        mission(loaded=1, on_board_m3=0.2, driven_m=10.0),
        mission(loaded=1, on_board_m3=0.0, driven_m=20.0, unloaded=1),
        mission(name="next", loaded=0, on_board_m3=0.0, driven_m=0.0),
        mission(name="next", loaded=1, on_board_m3=0.1, driven_m=5.0),
        mission(name="next", loaded=0, on_board_m3=0.0, driven_m=0.0),  # begun again
        mission(name="next", loaded=1, on_board_m3=0.1, driven_m=1.0),
        mission(name="next", loaded=2, on_board_m3=nan, driven_m=1.0),
    ):
        shift.on_mission(told)
    numbers = shift.numbers(S)
    assert numbers is not None
    assert (numbers["logs"], numbers["m3"], numbers["driven_m"]) == (4, 0.4, 26.0)


def test_volume_per_hour_is_told_when_it_says_something() -> None:
    shift = Shift()
    assert shift.numbers(S) is None
    shift.begin(0)
    shift.on_mission(mission(loaded=0, on_board_m3=0.0))
    shift.on_mission(mission(loaded=1, on_board_m3=0.5))
    early, later = shift.numbers(MIN_RATE_NS - 1), shift.numbers(1800 * S)
    assert early is not None and early["m3_h"] is None
    assert later is not None and later["m3_h"] == 1.0


def test_stops_lifts_and_working_time_come_from_the_controllers_reports() -> None:
    state = CraneState(PROFILE, None, HASH)
    report = replace(REPORT, profile_hash=HASH, reason=0)
    for k in range(10):
        state.accept(replace(report, stamp_ns=k * S // 2, grapple_state=5 if k >= 5 else 2), k * S // 2)
    stopped = replace(report, mode=Mode.STOP, reason=pack(Reason.JOINT_STUCK, 1), stamp_ns=6 * S)
    for k in range(3):
        state.accept(replace(stopped, stamp_ns=(6 + k) * S), (6 + k) * S)
    numbers = state.state(8 * S)["shift"]
    assert (numbers["stops"], numbers["lifts"], numbers["working_s"], numbers["seconds"]) == (1, 1, 4, 8)


def test_a_silent_controller_is_not_at_work() -> None:
    shift = Shift()
    for now_ns in (0, S // 2, 100 * S):
        shift.on_report(replace(REPORT, mode=Mode.ACTIVE), now_ns, 0, 0)
    numbers = shift.numbers(100 * S)
    assert numbers is not None and numbers["working_s"] == 0  # half a second, rounded


@pytest.mark.parametrize(("page", "status", "logs"), [(True, 204, 0), (False, 403, 1)])
def test_the_numbers_outlive_the_page_until_one_begins_a_new_shift(page: bool, status: int, logs: int) -> None:
    console = Console(PROFILE, HASH, clock=lambda: 20 * S)
    state = console.crane_state
    state.on_report(encode(replace(REPORT, profile_hash=HASH)), 19 * S)
    for k, told in enumerate((mission(loaded=0), mission(loaded=1))):
        assert state.on_report(encode_mission(told, k + 1, HASH, 19 * S + k), 19 * S + k)
    for _ in range(2):  # a page, and the page after its reload
        assert page_client(console).get("/api/state").json()["shift"]["logs"] == 1
    client = page_client(console)
    if not page:
        del client.headers[TOKEN_HEADER]
    assert client.post("/api/shift/begin").status_code == status
    assert client.get("/api/state").json()["shift"]["logs"] == logs
