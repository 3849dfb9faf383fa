"""Recovery when closed jaws hold too much, the wrong part or nothing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from autonomy.crane_job.grasp_verification import MAX_REGRIPS_HIGHER, MAX_RESTARTS, REGRIP_STEP_M, GraspRecovery
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Pose
from autonomy.perception.log_list import LogObservation
from tests.autonomy.grasp_scenes import MEASURED


class Told(SimpleNamespace):
    """A grapple whose state the test sets."""

    is_still, empty, wide, missed, holds_nothing = True, False, False, False, False

    def is_stalled_wide(self, grasp: Grasp, raised_count: int) -> bool:
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


def test_jaws_that_stall_wide_close_again_higher_up() -> None:
    regrip, now = GraspRecovery(), grasp()
    for i in range(MAX_REGRIPS_HIGHER):
        phase, now = regrip.after_closing(now, Told(wide=True))
        assert phase is Phase.DESCEND
        assert now.pose.z_m == pytest.approx(grasp().pose.z_m + (i + 1) * REGRIP_STEP_M)
    assert regrip.after_closing(now, Told(wide=True))[0] is Phase.LIFT


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


def test_closed_jaws_higher_up_may_hold_an_undetected_thin_log() -> None:
    regrip = GraspRecovery()
    _, now = regrip.after_closing(grasp(), Told(wide=True))
    assert regrip.after_closing(now, Told(missed=True, empty=True))[0] is Phase.LIFT


def test_closed_jaws_higher_up_are_weighed_once_the_crane_is_still() -> None:
    regrip = GraspRecovery()
    _, now = regrip.after_closing(grasp(), Told(wide=True))
    assert regrip.after_closing(now, Told(empty=True, is_still=False))[0] is None, "its load swings, too"
    assert regrip.after_closing(now, Told(empty=True, holds_nothing=True))[0] is Phase.ABOVE


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
    regrip, wide = GraspRecovery(), row(0.3, -0.3, 0.0)
    _, now = regrip.after_closing(wide, Told(wide=True))
    assert regrip.after_closing(now, Told(empty=True, holds_nothing=True))[0] is Phase.ABOVE
    assert regrip.excluded_logs == (3,) and regrip.raised_count == 0, "one at its end is taken, from the ground"
    drawn = replace(row(0.3), extracts=True)
    regrip.after_closing(drawn, Told(missed=True, empty=True))
    assert regrip.excluded_logs == (3, 1)
    _, now = regrip.after_closing(row(0.3), Told(wide=True))
    assert regrip.after_closing(now, Told(empty=True, holds_nothing=True))[0] is Phase.LIFT, "twice, and no more"


def test_a_grasp_of_two_has_no_inner_logs() -> None:
    regrip = GraspRecovery()
    _, now = regrip.after_closing(row(0.0, 0.3), Told(wide=True))
    assert regrip.after_closing(now, Told(holds_nothing=True))[0] is Phase.ABOVE and regrip.excluded_logs == ()


def test_exactly_known_logs_are_lifted_as_they_are() -> None:
    told = grasp(measured=False)
    for tongs in (Told(wide=True), Told(missed=True, empty=True)):
        assert GraspRecovery().after_closing(told, tongs) == (Phase.LIFT, told)
