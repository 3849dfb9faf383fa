"""The guard alone against a hostile controller: safety off, mode forged, valves ramped at a legal rate."""

from __future__ import annotations

import pytest

from can_dbc.messages.crane import OperatorAction
from controller.guard.verdicts import Verdict
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.hil.hostile_controller import Hostile, attack, is_armed, standing
from tests.hil.stand_ins import Nobody, press

pytestmark = pytest.mark.long
MS = 1_000_000
STOPPING_MS = 250
"""From the cut until the joint is slow: the node's ramp of 60 ms, dead time and lag of the valve, and the oil."""
END_STOP = 0.015
"""Where the drive's own end stops begin, past the range [rad, m]."""


@pytest.mark.parametrize(
    ("machine", "joint", "signal"), [("palms_471", 0, "Slew"), ("aoro_fc8", 0, "Slew"), ("aoro_fc8", 1, "Lift")]
)
def test_a_joint_that_is_too_fast_is_cut(machine: str, joint: int, signal: str) -> None:
    found = attack(machine, Hostile(signal, 99.0, 300.0), joint, 2.0)
    assert found.verdict is Verdict.OVERSPEED
    assert 0 < found.exceeded_ns < found.cut_ns <= found.exceeded_ns + 100 * MS
    assert found.over_ns <= (100 + STOPPING_MS) * MS


def test_a_joint_that_is_driven_out_is_cut_before_its_end_stop() -> None:
    """At a speed that breaks no rule."""
    found = attack("aoro_fc8", Hostile("Lift", 60.0, 300.0), 1, 4.0)
    assert found.verdict is Verdict.OUTSIDE and found.fastest < 1.0
    assert found.beyond < END_STOP


@pytest.mark.parametrize("percent", [-35.0, -60.0])
def test_a_closed_grapple_is_not_driven_into_the_ground(percent: float) -> None:
    """At a speed that breaks no rule; its tips meet 0.8 m below the pin."""
    jaws = {"GrappleMode": 2, "Grapple": 100.0}
    found = attack("palms_471", Hostile("Lift", percent, 25.0, jaws=jaws), Joint.LIFT, 14.0)
    assert found.verdict is Verdict.REACH and found.fastest < 1.0
    assert found.lowest_m > load_profile("palms_471").workspace.ground_z_m + 0.7


def test_a_controller_that_nobody_armed_is_cut_at_once() -> None:
    system = standing("palms_471", Hostile("Slew", 99.0, 300.0), Nobody(), lambda s: s.now_ns > 4_000_000_000)
    begun_ns, begin = system.now_ns, system.plant.joint_positions()
    try:
        assert system._guard.enabled
        while system._guard.enabled:
            system.advance()
        assert system._guard.verdict is Verdict.NOT_ARMED and system.now_ns <= begun_ns + 15 * MS
        while system.now_ns < begun_ns + 500 * MS:
            system.advance()
        assert system.plant.joint_positions() == pytest.approx(begin, abs=2e-3)
    finally:
        system.plant.close()


def test_a_controller_that_goes_on_after_a_person_s_stop_is_cut_within_100_ms() -> None:
    hostile = Hostile("Slew", 40.0, 100.0)
    system = standing("palms_471", hostile, None, is_armed)
    try:
        while system.now_ns < hostile.begin_ns + 1_000 * MS:
            system.advance()
        assert system._guard.enabled
        stopped_ns = system.now_ns
        press(system, OperatorAction.STOP)
        while system._guard.enabled:
            system.advance()
        assert system._guard.verdict is Verdict.NOT_ARMED and system.now_ns <= stopped_ns + 100 * MS
    finally:
        system.plant.close()
