"""Tongs that tell that they have missed open, and are sent anew after another look, before the crane goes up empty."""

from __future__ import annotations

from dataclasses import replace

import pytest
from crane_stand_in import StandIn
from grasp_scenes import PROFILE, pair

from autonomy.activity import Activity
from autonomy.cycle import ANEW
from autonomy.grasp.direct import Planned
from autonomy.grasp.search import Search
from autonomy.logs import TRIANGLE, LogObservation
from autonomy.phases import Phase
from can_dbc.setpoint import StateReport
from machine.load import profile_hash

SHUT, HOLDING = 4, 5


class Slipping(StandIn):
    """Tongs shut on nothing ``misses`` times and say so; then they hold the pair."""

    misses = 1
    measures = True

    def report(self) -> StateReport:
        shut = self.gripped and self._closings <= self.misses
        return replace(super().report(), grapple_state=SHUT if shut else HOLDING if self.gripped else 0)

    @property
    def _closings(self) -> int:
        phases = [m.phase for m in self.trace]
        return sum(now == "CLOSE" != was for was, now in zip(["", *phases], phases, strict=False))

    def seen(self) -> tuple[LogObservation, ...]:
        variances = tuple(1e-6 if i in (0, 7, 13) else 0.0 for i in range(TRIANGLE))
        return tuple(replace(log, covariance=variances) if self.measures else log for log in self.logs)


def thick_pair() -> list[LogObservation]:
    return [replace(log, diameter_m=0.21, center_m=(*log.center_m[:2], log.center_m[2] + 0.005)) for log in pair()]


def phases_until_lifted(crane: Slipping) -> list[Phase]:
    planner = Activity(PROFILE, profile_hash(PROFILE), chooser=Planned(Search()))
    phases = [planner.phase]
    for _ in range(3000):
        if planner.phase is Phase.LIFT or planner.idle:
            break
        crane.step(planner)
        if planner.phase is not phases[-1]:
            phases.append(planner.phase)
    assert planner.phase is Phase.LIFT, planner.failure
    return phases[phases.index(Phase.CLOSE) :]


def test_tongs_that_shut_on_nothing_open_look_and_close_again() -> None:
    crane = Slipping(PROFILE, thick_pair())
    assert phases_until_lifted(crane) == [Phase.CLOSE, Phase.ABOVE, Phase.DESCEND, Phase.CLOSE, Phase.LIFT]
    risen = [m for m in crane.trace if m.phase == "ABOVE"][-1]
    closed = next(m for m in crane.trace if m.phase == "CLOSE")
    assert risen.pin[2] > closed.pin[2] + 0.2 and risen.tong_rad < 0.2, "from above, and open"


def test_after_some_times_the_crane_goes_up_all_the_same() -> None:
    crane = Slipping(PROFILE, thick_pair())
    crane.misses = 99
    assert phases_until_lifted(crane).count(Phase.CLOSE) == 1 + ANEW


@pytest.mark.parametrize("known_how", ["told", "thin", "blind"])
def test_what_nobody_measured_or_may_be_in_shut_tongs_is_lifted_as_it_is(known_how: str) -> None:
    thin = [replace(log, diameter_m=0.15) for log in pair()]
    crane = Slipping(PROFILE, thin if known_how == "thin" else thick_pair(), feedback=known_how != "blind")
    crane.measures = known_how != "told"
    if known_how == "blind":
        crane.misses = 0  # nobody tells
    assert phases_until_lifted(crane).count(Phase.CLOSE) == 1
