"""What became of a fault: what stopped, why, after how many ms, how far the tip moved."""

from __future__ import annotations

import json
import math
from dataclasses import replace

from can_dbc.messages.crane import StateReport
from console.fault_watch import FOLLOWED_NS, REST_NS, FaultWatch
from machine.geometry import kinematics
from machine.loading.profile_file import load_profile
from machine.status.explanation import explain
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.console import state_reports

PROFILE = load_profile("palms_471")
Q = (0.1, 0.4, -1.6, 0.5, 0.0)
MS = 1_000_000
REPORT = state_reports.at(Q, 0)
STUCK = pack(Reason.JOINT_STUCK, 1)


def at(ms: float, slew: float = 0.1, **more) -> StateReport:
    return replace(REPORT, stamp_ns=round(ms * MS), position=(slew, *Q[1:]), **more)


def moved_mm(a: float, b: float) -> float:
    pins = [kinematics.chain_points(PROFILE.kinematics, (slew, *Q[1:]))[4] for slew in (a, b)]
    return 1000 * math.dist(*pins)


def followed(*reports: StateReport, late: bool = False) -> dict:
    """The card after a fault at 1000 ms; with ``late`` the order is answered after all reports."""
    watch = FaultWatch(PROFILE)
    told = [at(980), *reports]
    for report in told[: None if late else 1]:
        watch.on_report(report)
    watch.begin("a fault", "done", 1000 * MS)
    for report in told[len(told) if late else 1 :]:
        watch.on_report(report)
    card = watch.card()
    assert card is not None
    json.dumps(card, allow_nan=False)
    return card


STOP = {"mode": Mode.STOP, "reason": STUCK, "since_ns": 1040 * MS, "numbers": (0.4, 0.1, 0.0)}


def test_a_stop_is_told_with_its_time_and_both_ways() -> None:
    story = (at(1020, 0.105), at(1060, 0.11, **STOP), at(1100, 0.112, **STOP), at(1040 + REST_NS / MS, 0.111, **STOP))
    for late in (False, True):
        card = followed(*story, late=late)
        told = explain(STUCK, STOP["numbers"])
        assert (card["stop"]["code"], card["stop"]["mode"], card["stop"]["advice"]) == (told.code, "STOP", told.advice)
        assert (card["ms"], card["begun_in"], card["done"]) == (40.0, "ACTIVE", True)
        assert abs(card["before_mm"] - moved_mm(0.1, 0.11)) < 0.1
        assert abs(card["after_mm"] - moved_mm(0.11, 0.112)) < 0.1


def test_a_stop_behind_a_slower_motion_is_told_with_the_time_of_the_first() -> None:
    slow = at(1030, reason=pack(Reason.JOINT_STUCK, 0), since_ns=1030 * MS, numbers=(0.0, 0.0, 0.0))
    card = followed(slow, at(1060, **STOP))
    assert (card["ms"], card["stop"]["mode"]) == (30.0, "STOP")


def test_the_motion_after_the_next_arming_does_not_count() -> None:
    card = followed(at(1060, 0.11, **STOP), at(1500, 0.111, **STOP), at(1600, 0.111), at(1700, 0.5))
    assert card["done"] and abs(card["after_mm"] - moved_mm(0.11, 0.111)) < 0.1


def test_a_fault_without_effect_is_told_so() -> None:
    card = followed(at(1000 + FOLLOWED_NS / MS - 1))
    assert card["stop"] is None and not card["done"]
    assert followed(at(1000 + FOLLOWED_NS / MS))["done"]


def test_a_machine_that_stood_has_no_stop_of_this_fault() -> None:
    watch = FaultWatch(PROFILE)
    watch.on_report(at(980, **STOP))
    watch.begin("a fault", "done", 1000 * MS)
    watch.on_report(at(1020, **STOP))
    card = watch.card()
    assert card is not None and card["stood"] and card["stop"] is None


def test_an_unknown_place_is_unknown() -> None:
    unknown = (math.nan, *Q[1:])
    card = followed(replace(at(1060, **STOP), position=unknown), replace(at(1100, **STOP), position=unknown))
    assert (card["ms"], card["before_mm"]) == (40.0, None)
