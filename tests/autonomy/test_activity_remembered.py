"""A log that hangs in the grapple is not where it was last seen: a camera that cannot show it remembers wrongly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import dist

import pytest

from autonomy.crane_job.activity import Activity
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import GROUND_LOG, StandIn
from tests.autonomy.grasp_scenes import PROFILE

_SHUT = 4


@dataclass
class Remembering(StandIn):
    """A crane whose camera looks while it rests, shows only what lies near the pin, not what hangs under it, and
    remembers the rest."""

    def __post_init__(self) -> None:
        self.last = {log.id: log for log in self.logs}
        self.was = self.q

    def seen(self) -> tuple[LogObservation, ...]:
        """The logs, remembered where they cannot be seen."""
        rests, self.was = self.q == self.was, self.q
        if not rests:
            return ()
        told = []
        for log in self.logs:
            near = dist(self.pin()[:2], log.center_m[:2]) < 1.0 and log.id != self.held
            if near:
                self.last[log.id] = log
            told.append(replace(self.last[log.id], seen=near))
        return tuple(told)

    def report(self) -> StateReport:
        """The report of a controller with an opening sensor: closed empty, or holding."""
        told = super().report()
        return replace(told, grapple_state=_SHUT) if self.gripped and self.held is None else told


@pytest.mark.parametrize("slips", [0, 1])
def test_not_the_remembered_log_but_the_jaws_tell_whether_it_was_lifted(slips: int) -> None:
    crane = Remembering(PROFILE, [GROUND_LOG], slippery=slips)
    planner = Activity(PROFILE, profile_hash(PROFILE))
    crane.run(planner)
    assert planner.done and planner.failure is None, planner.failure
    assert planner.missed == slips


def test_jaws_that_close_on_nothing_three_times_end_the_job() -> None:
    crane = Remembering(PROFILE, [GROUND_LOG], slippery=9)
    planner = Activity(PROFILE, profile_hash(PROFILE))
    crane.run(planner)
    assert planner.failure_code == "activity.log-missed"
