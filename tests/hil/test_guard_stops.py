"""A valve that sticks open: the guard alone stops the crane by the pilot supply, with the real plant and real bytes."""

from __future__ import annotations

import math

import pytest

from controller.guard.verdicts import Verdict
from machine.loading.profile_file import load_profile
from sim.plant import Plant
from tests.hil.stand_ins import Idle, Nobody, in_lockstep

pytestmark = pytest.mark.long
VALVE_NS = 150_000_000
"""Dead time and lag of a valve that closes."""
DEADBAND = 0.12


@pytest.fixture
def system():
    plant = Plant(load_profile("palms_471"), seed=3, logs=0)
    run = in_lockstep("palms_471", plant, Idle(), Nobody())
    while run.now_ns < 4_000_000_000:
        run.advance()
    assert run._guard.enabled and plant.estop.pilot_on
    yield run
    plant.close()


@pytest.mark.parametrize(("function", "position"), [("slew", 0.35), ("lift", -0.5), ("ext", 0.4)])
def test_a_valve_that_sticks_open_is_stopped_by_the_guard_alone(system, function, position):
    plant, begin, began_ns = system.plant, system.plant.tip(), system.now_ns
    plant.spool_faults.stuck[function] = position
    moved_ns = refused_ns = open_ns = 0
    verdict, travel_m = Verdict.GOOD, 0.0
    while system.now_ns < began_ns + 2_000_000_000:
        system.advance()
        travel_m = max(travel_m, math.dist(plant.tip(), begin))
        spool = abs(plant.world.hydraulics.spools[function])
        if spool > DEADBAND:
            moved_ns, open_ns = moved_ns or system.now_ns, system.now_ns
        if not refused_ns and not system._guard.enabled:
            refused_ns, verdict = system.now_ns, system._guard.verdict
    assert verdict is Verdict.SPOOL and system._guard.verdict is Verdict.LATCHED
    assert not plant.estop.pilot_on
    assert 0 < moved_ns <= refused_ns <= moved_ns + 30_000_000
    assert refused_ns <= began_ns + 150_000_000, "catalogue, case 17"
    assert open_ns <= refused_ns + VALVE_NS
    assert 0.005 < travel_m < 0.20, "catalogue, case 17"
    assert spool < 0.02
