"""A search that knows nothing of a valve: what its first opening tells, and when the profile may stay in force."""

from __future__ import annotations

import random

import msgspec
import pytest

from autonomy.calibration.procedure_spools import rough_side, rough_spec, suits
from autonomy.calibration.spool_program import WIGGLE_TOP_PCT, SpoolProgram, wiggle
from autonomy.calibration.spool_run import CLOSE_S
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.autonomy.valve_stand_in import StandIn

SLEW = load_profile("palms_471").joints["slew"]
MOVED = 0.008
SEEDS = range(93_000, 93_012)


def any_valve(seed: int) -> StandIn:
    """A valve from the whole range of mobile valves."""
    rng = random.Random(seed)

    def between(low: float, high: float) -> float:
        return low * (high / low) ** rng.random()

    return StandIn(
        deadbands=(between(0.03, 0.3), between(0.03, 0.3)),
        delay_s=between(0.02, 0.25),
        full_speeds=(0.5 * between(1 / 3, 3.0), 0.5 * between(1 / 3, 3.0)),
    )


def searched(valve: StandIn, side: int, seed: int = 0):
    """The record of a search that ends itself once the joint has moved."""
    whole = valve.run(Joint.SLEW, side, "wiggle", wiggle(SLEW, side), 0.1, seed)
    moved = next(t for t, p in zip(whole.time_s, side * (whole.position - 0.1), strict=True) if p > MOVED) - 0.2
    begun = wiggle(SLEW, side)
    shut = begun.ending(moved, CLOSE_S)
    program = SpoolProgram((begun.points[0], *shut.points))
    return valve.run(Joint.SLEW, side, "wiggle", program, 0.1, seed)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("reported", [True, False], ids=["spool reported", "no spool reported"])
def test_any_valve_is_found_roughly(seed: int, reported: bool) -> None:
    valve = any_valve(seed)
    for i, side in ((0, 1), (1, -1)):
        record = searched(valve, side, seed)
        if not reported:
            record = type(record)(*(None if f == "spool" else getattr(record, f) for f in record.__slots__))
        found = rough_side(record)
        assert found.deadband == pytest.approx(valve.deadbands[i], abs=0.02 if reported else 0.035)
        assert found.full_speed == pytest.approx(valve.full_speeds[i], rel=0.35)
        if reported:
            assert found.delay_s == pytest.approx(valve.delay_s, abs=0.02)


def test_a_profile_suits_its_own_kind_of_valves_and_no_other() -> None:
    valve = SLEW.valve
    for change, wanted in (
        ({"deadband_plus_pct": 14.5, "full_speed_minus": 0.6, "delay_s": 0.15}, True),
        ({"deadband_plus_pct": 18.0}, False),
        ({"deadband_minus_pct": 5.0}, False),
        ({"full_speed_plus": 0.25}, False),
        ({"full_speed_minus": 1.0}, False),
        ({"delay_s": 0.2}, False),
    ):
        found = msgspec.structs.replace(SLEW, valve=msgspec.structs.replace(valve, **change))
        assert suits(SLEW, found) is wanted, change


def test_a_search_begins_at_neutral_and_is_slow() -> None:
    program = wiggle(SLEW, -1)
    assert program.points[0] == (0.0, 0.0) and program.points[1][1] == -WIGGLE_TOP_PCT
    assert abs(program.at(1.0)) == pytest.approx(10.0), "10 % a second"


def test_both_sides_make_a_joint_with_that_valve() -> None:
    valve = StandIn(deadbands=(0.05, 0.25), full_speeds=(1.2, 0.2), delay_s=0.2)
    found = rough_spec(Joint.SLEW, SLEW, searched(valve, 1), searched(valve, -1))
    assert found.valve.deadband_plus_pct == pytest.approx(5.0, abs=2.0)
    assert found.valve.deadband_minus_pct == pytest.approx(25.0, abs=2.0)
    assert found.valve.full_speed_plus > 4.0 * found.valve.full_speed_minus
    assert found.valve.delay_s == pytest.approx(0.2, abs=0.02) and not suits(SLEW, found)
