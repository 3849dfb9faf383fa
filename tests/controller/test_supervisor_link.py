"""The link of an operator who watches: a lost one holds the machine, an ended or absent one does nothing."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from can_dbc.messages.crane import LinkWatch, OperatorAction
from controller.operator_link import OperatorLink
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, SETTINGS, Bench, T

PROFILE = load_profile("palms_471")
LIMIT_TICKS = PROFILE.timeouts.operator_link_ms * MS // T
WATCH, WATCH_END = OperatorAction.WATCH, OperatorAction.WATCH_END
REPORT_TICKS = 4


def limited(limit_ms: int) -> Profile:
    timeouts = msgspec.structs.replace(PROFILE.timeouts, operator_link_ms=limit_ms)
    return msgspec.structs.replace(PROFILE, timeouts=timeouts)


def watched(bench: Bench) -> Bench:
    bench.press(WATCH)
    return bench


def work(bench: Bench, ticks: int, beat_ticks: int = 0) -> int:
    """Ticks until the machine no longer works, at most ``ticks``; the planner goes on, heartbeats only if asked."""
    for k in range(ticks):
        sent = [bench.moving(0, 0.01)] if k % 10 == 0 and bench.mode is Mode.ACTIVE else []
        if beat_ticks and k % beat_ticks == 0:
            sent.append(bench.operator(WATCH))
        bench.tick(sent)
        if bench.mode not in (Mode.ARMED, Mode.ACTIVE):
            return k + 1
    return ticks


def state(bench: Bench) -> int:
    bench.run(REPORT_TICKS)
    return bench.reports[-1].operator_link


# -- the watch itself


def test_the_link_is_lost_from_the_limit_on_after_the_stamp_of_the_last_heartbeat() -> None:
    link = OperatorLink(limited(1000))
    assert link.state(10**15) is LinkWatch.OFF
    link.beat(5_000 * MS)
    assert (link.stamp_ns, link.lost_from_ns) == (5_000 * MS, 6_000 * MS)
    assert link.state(6_000 * MS - 1) is LinkWatch.WATCHED and link.state(6_000 * MS) is LinkWatch.LOST
    link.beat(6_100 * MS)
    assert link.state(6_100 * MS) is LinkWatch.WATCHED
    link.end(6_200 * MS)
    assert link.state(10**15) is LinkWatch.OFF


def test_what_is_stamped_no_later_than_the_last_changes_nothing() -> None:
    link = OperatorLink(limited(1000))
    link.beat(5_000 * MS)
    for stamp_ns in (5_000 * MS, 4_000 * MS):
        link.beat(stamp_ns)
        link.end(stamp_ns)
        assert link.lost_from_ns == 6_000 * MS
    link.end(5_500 * MS)
    for stamp_ns in (5_500 * MS, 5_400 * MS):
        link.beat(stamp_ns)
        assert link.state(10**15) is LinkWatch.OFF, "a heartbeat on its way while the watch ended"


def test_a_limit_of_zero_watches_nothing() -> None:
    link = OperatorLink(limited(0))
    link.beat(5_000 * MS)
    assert link.state(10**15) is LinkWatch.OFF


# -- the supervisor


def test_a_lost_link_holds_a_working_machine_in_time() -> None:
    bench = watched(Bench().active())
    assert state(bench) == LinkWatch.WATCHED
    ticks = work(bench, 2 * LIMIT_TICKS) + REPORT_TICKS
    assert bench.mode is Mode.STOP and bench.reason == Reason.OPERATOR_LINK_LOST
    assert LIMIT_TICKS - 1 <= ticks <= LIMIT_TICKS == FAULTS[Reason.OPERATOR_LINK_LOST].bound_ms * MS // T
    assert bench.controller.supervisor.ramping, "a hold, and no cut"
    assert state(bench) == LinkWatch.LOST
    age_ms, limit_ms, _ = bench.reports[-1].numbers
    assert (age_ms, limit_ms) == (pytest.approx(1000.0, abs=T / MS), 1000.0)
    bench.run(100)
    assert bench.neutral and bench.mode is Mode.STOP


def test_a_lost_link_holds_an_armed_machine() -> None:
    bench = watched(Bench().armed())  # stamped one tick before it arrived
    assert bench.run(LIMIT_TICKS - 2) is Mode.ARMED
    bench.tick()
    assert bench.mode is Mode.STOP and bench.reason == Reason.OPERATOR_LINK_LOST


def test_heartbeats_keep_the_machine_working() -> None:
    bench = Bench().active()
    assert work(bench, 3 * LIMIT_TICKS, beat_ticks=LIMIT_TICKS - 20) == 3 * LIMIT_TICKS
    assert bench.mode is Mode.ACTIVE and bench.reports[-1].operator_link == LinkWatch.WATCHED


@pytest.mark.parametrize("watch", ["nobody", "ended", "switched off by the profile"])
def test_without_a_watcher_nothing_changes(watch: str) -> None:
    bench = Bench(replace(SETTINGS, profile=limited(0)) if watch.startswith("switched") else SETTINGS).active()
    if watch != "nobody":
        watched(bench)
    if watch == "ended":
        bench.press(WATCH_END)
    assert work(bench, 3 * LIMIT_TICKS) == 3 * LIMIT_TICKS and bench.mode is Mode.ACTIVE
    assert state(bench) == LinkWatch.OFF


def test_a_link_that_comes_back_does_not_resume_the_work() -> None:
    bench = watched(Bench().active())
    work(bench, 2 * LIMIT_TICKS)
    for k in range(100):
        bench.tick([bench.operator(WATCH), bench.hold()] if k % 10 == 0 else ())
    assert bench.mode is Mode.STOP and bench.reason == Reason.OPERATOR_LINK_LOST
    assert bench.press(OperatorAction.ARM) is Mode.ARMED
    bench.tick([bench.hold()])
    assert bench.mode is Mode.ACTIVE


@pytest.mark.parametrize("back", [WATCH, WATCH_END])
def test_arming_is_refused_while_the_link_is_lost_and_says_what_to_do(back: OperatorAction) -> None:
    bench = watched(Bench().boot())
    assert bench.run(LIMIT_TICKS + REPORT_TICKS) is Mode.STANDBY and bench.reason == Reason.OPERATOR_LINK_LOST
    bench.press(OperatorAction.ARM)
    assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is Reason.OPERATOR_LINK_LOST
    assert "unwatch" in describe(Reason.OPERATOR_LINK_LOST)
    bench.press(back)
    assert bench.reason == Reason.NONE
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_a_stopped_machine_is_not_armed_while_the_link_is_lost() -> None:
    bench = watched(Bench().active())
    work(bench, 2 * LIMIT_TICKS)
    bench.run(100)
    assert bench.press(OperatorAction.ARM) is Mode.STOP and bench.controller.gate.refusal is Reason.OPERATOR_LINK_LOST


def test_a_lost_link_is_no_second_fault_of_a_stop() -> None:
    bench = watched(Bench().active())
    bench.press(OperatorAction.STOP)
    assert bench.run(2 * LIMIT_TICKS) is Mode.STOP and bench.reason == Reason.OPERATOR_STOP


def test_a_harder_fault_wins_over_the_lost_link() -> None:
    bench = watched(Bench().active())
    work(bench, LIMIT_TICKS - 4)
    bench.dropped.add("EstopStat")
    work(bench, 20)
    assert bench.run(20) is Mode.FAULT and bench.reason == Reason.ESTOP_LOST


# -- the gate


def test_a_planner_neither_watches_nor_ends_the_watch() -> None:
    bench = Bench().armed()
    bench.tick_with(planner=[bench.operator(WATCH)])
    assert bench.controller.gate.refusal is Reason.NO_AUTHORITY and state(bench) == LinkWatch.OFF
    watched(bench)
    bench.tick_with(planner=[bench.operator(WATCH_END)])
    assert state(bench) == LinkWatch.WATCHED


def test_a_replayed_heartbeat_keeps_no_link() -> None:
    bench = Bench().armed()
    beat = bench.operator(WATCH)
    for _ in range(LIMIT_TICKS - 1):
        bench.tick([beat])
    assert bench.mode is Mode.ARMED
    bench.tick([beat])
    assert bench.mode is Mode.STOP and bench.reason == Reason.OPERATOR_LINK_LOST
    bench.tick([beat])
    assert bench.controller.gate.refusal is Reason.STAMP_OLD


def test_the_slower_of_two_senders_is_not_refused() -> None:
    bench = Bench().armed()
    slow = bench.operator(WATCH)
    bench.run(4)
    bench.tick([bench.operator(WATCH), slow])
    assert bench.controller.gate.refused == 0 and state(bench) == LinkWatch.WATCHED


@pytest.mark.parametrize(
    ("fields", "refusal"),
    [
        ({"profile_hash": 1}, Reason.WRONG_PROFILE),
        ({"stamp_ns": 1}, Reason.STAMP_OLD),
        ({"stamp_ns": 1 << 60}, Reason.STAMP_FUTURE),
    ],
)
def test_a_heartbeat_is_checked_as_every_command(fields: dict[str, int], refusal: Reason) -> None:
    bench = Bench().armed()
    bench.press(WATCH, **fields)
    assert bench.controller.gate.refusal is refusal and state(bench) == LinkWatch.OFF


def test_a_late_heartbeat_counts_from_its_stamp() -> None:
    bench = Bench().armed()
    beat = bench.operator(WATCH)
    bench.run(LIMIT_TICKS - 10)
    bench.tick([beat])
    assert work(bench, LIMIT_TICKS) == 9 and bench.reason == Reason.OPERATOR_LINK_LOST


def test_a_heartbeat_outruns_no_command() -> None:
    """An ARM that was pressed before a heartbeat of another sender, and comes after it, is heard."""
    bench = Bench().boot()
    arm = bench.operator(OperatorAction.ARM)
    bench.run(2)
    bench.press(WATCH)
    bench.tick([arm])
    assert bench.mode is Mode.ARMED
    bench.tick([arm])
    assert bench.controller.gate.refusal is Reason.OUT_OF_ORDER
