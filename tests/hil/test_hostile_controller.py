"""The guard alone against a hostile controller: safety off, mode forged, valves ramped at a legal rate."""

from __future__ import annotations

import pytest

from controller.guard.verdicts import Verdict
from tests.hil.hostile_controller import Hostile, attack

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
