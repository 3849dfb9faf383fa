"""Recovery when closed jaws hold too much, the wrong part or nothing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from autonomy.crane_job.grasp_verification import MAX_RESTARTS, GraspRecovery
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Pose
from autonomy.perception.log_list import LogObservation
from tests.autonomy.grasp_scenes import MEASURED


class Told(SimpleNamespace):
    """A grapple whose state the test sets."""

    is_still, empty, wide, missed, holds_nothing = True, False, False, False, False

    def is_stalled_wide(self, grasp: Grasp) -> bool:
        return self.wide

    def has_missed(self, grasp: Grasp) -> bool:
        return self.missed


def grasp(extracts: bool = False, measured: bool = True) -> Grasp:
    log = LogObservation(1, (0.0, 4.0, -1.2), (1.0, 0.0, 0.0), 2.6, 0.28, MEASURED if measured else None)
    return Grasp(log, Pose(0.0, 4.0, -0.4, 0.3, 0.1), -1.3, 0.0, extracts=extracts)


def test_held_logs_are_lifted() -> None:
    first = grasp()
    assert GraspRecovery().after_closing(first, Told()) == (Phase.LIFT, first)


@pytest.mark.parametrize("trouble", ["wide", "missed"])
def test_moving_jaws_are_waited_for(trouble: str) -> None:
    assert GraspRecovery().after_closing(grasp(), Told(is_still=False, **{trouble: True}))[0] is None


def test_jaws_that_stall_wide_lift_what_they_clasp() -> None:
    assert GraspRecovery().after_closing(grasp(), Told(wide=True)) == (Phase.LIFT, grasp())


def test_a_miss_restarts_from_above_a_few_times() -> None:
    regrip = GraspRecovery()
    phases = [regrip.after_closing(grasp(), Told(missed=True, empty=True))[0] for _ in range(MAX_RESTARTS + 1)]
    assert phases == [Phase.ABOVE] * MAX_RESTARTS + [Phase.LIFT]


def test_a_pinched_log_in_a_row_is_dragged_once_before_a_restart() -> None:
    regrip = GraspRecovery()
    phase, now = regrip.after_closing(grasp(extracts=True), Told(missed=True))
    assert phase is Phase.CLOSE and now.dragging
    phase, now = regrip.after_closing(now, Told(missed=True))
    assert phase is Phase.ABOVE and not now.dragging
    assert regrip.after_closing(grasp(extracts=True), Told(missed=True, empty=True))[0] is Phase.ABOVE, (
        "nothing to drag"
    )


def test_jaws_that_rise_empty_restart_as_often_as_jaws_that_closed_on_nothing() -> None:
    regrip, empty = GraspRecovery(), Told(empty=True, holds_nothing=True)
    assert regrip.after_rising(grasp(), Told()) is None
    assert regrip.after_rising(grasp(), Told(holds_nothing=True, is_still=False)) is None, "they may close on it yet"
    assert regrip.after_rising(grasp(measured=False), empty) is None
    assert [regrip.after_rising(grasp(), empty) is not None for _ in range(MAX_RESTARTS + 1)] == [
        True
    ] * MAX_RESTARTS + [False]


def row(*across_m: float) -> Grasp:
    first, *others = (replace(grasp().log, id=i, center_m=(0.0, 4.0 + y, -1.2)) for i, y in enumerate(across_m, 1))
    return replace(grasp(), log=first, others=tuple(others))


def test_after_a_failed_row_its_inner_logs_are_excluded() -> None:
    regrip, wide, empty = GraspRecovery(), row(0.3, -0.3, 0.0), Told(empty=True, holds_nothing=True)
    regrip.after_closing(wide, Told(wide=True))
    assert regrip.after_rising(wide, empty) is not None and regrip.excluded_logs == (3,)
    drawn = replace(row(0.3), extracts=True)
    regrip.after_closing(drawn, Told(missed=True, empty=True))
    assert regrip.excluded_logs == (3, 1)
    regrip.after_closing(row(0.3), Told(wide=True))
    assert regrip.after_rising(row(0.3), empty) is None, "twice, and no more"


@pytest.mark.parametrize(("across_m", "wide"), [((0.0, 0.3), True), ((0.3, -0.3, 0.0), False)])
def test_no_inner_logs_are_excluded_of_two_or_where_the_jaws_had_closed(
    across_m: tuple[float, ...], wide: bool
) -> None:
    regrip = GraspRecovery()
    regrip.after_closing(row(*across_m), Told(wide=wide))
    regrip.after_rising(row(*across_m), Told(holds_nothing=True))
    assert regrip.restart_count == 1 and regrip.excluded_logs == ()


def test_exactly_known_logs_are_lifted_as_they_are() -> None:
    told = grasp(measured=False)
    for tongs in (Told(wide=True), Told(missed=True, empty=True)):
        assert GraspRecovery().after_closing(told, tongs) == (Phase.LIFT, told)
