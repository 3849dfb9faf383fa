"""Search and travel by spools: any valve is found roughly, and a soft crane arrives at rest."""

from __future__ import annotations

import random

import msgspec
import numpy as np
import pytest

from autonomy.calibration import spool_travel
from autonomy.calibration.plan import SpoolTask
from autonomy.calibration.procedure_spools import rough_side, rough_spec, suits
from autonomy.calibration.spool_program import REST_PCT, SpoolProgram, allowed_by, wiggle
from autonomy.calibration.spool_run import CLOSE_S, MonitoredSpoolRun
from autonomy.calibration.spool_travel import MAX_LEGS, TOLERANCES, Leg, SpoolTravel
from controller.crane.spool_test_run import MAX_OPEN_NS
from controller.estimation.joint_monitors import SHAKEN_S_AT_LIMIT
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.autonomy.valve_stand_in import LEAD_S, StandIn

SLEW = load_profile("aoro_fc8").joints["slew"]
SOFT = StandIn(
    deadbands=(0.05, 0.05), full_speeds=(1.8, 1.7), exponent=1.0, delay_s=0.14, ring_rad_s=2.6, ring_zeta=0.2
)
GOAL = 0.7


def known(valve: StandIn):
    """The joint with a valve as a search has found it."""
    plus, minus = valve.deadbands
    found = msgspec.structs.replace(
        SLEW.valve,
        deadband_plus_pct=100.0 * plus,
        deadband_minus_pct=100.0 * minus,
        full_speed_plus=valve.full_speeds[0],
        full_speed_minus=valve.full_speeds[1],
        delay_s=valve.delay_s,
    )
    return msgspec.structs.replace(SLEW, valve=found)


def travelled(valve: StandIn, goal: float) -> tuple[np.ndarray, np.ndarray, SpoolProgram]:
    """Times and positions of a leg that shuts itself, and the program that it became."""
    leg = Leg(Joint.SLEW, known(valve), allowed_by(SLEW), 0.0, goal, 0)
    begun = leg.program
    whole = valve.run(Joint.SLEW, 1, "leg", begun, 0.0)
    velocity = np.gradient(np.convolve(whole.position, np.full(15, 1.0 / 15.0), "same"), whole.time_s)
    for t, q, v in zip(whole.time_s - LEAD_S, whole.position, velocity, strict=True):
        leg.follow(float(t), float(q), float(v))
        if leg.closed:
            break
    before = [p for p in begun.points if p[0] < leg.program.points[0][0]]
    program = SpoolProgram((*before, *leg.program.points))
    held = StandIn.run(valve, Joint.SLEW, 1, "leg", SpoolProgram((*program.points, (program.duration_s + 3.0, 0.0))), 0)
    return held.time_s - LEAD_S, held.position, program


def swing_back(valve: StandIn) -> float:
    """How far the joint goes back after its farthest point [rad]."""
    _, position, _ = travelled(valve, GOAL)
    farthest = int(np.argmax(position))
    return float(position[farthest] - np.min(position[farthest:]))


def test_a_crane_on_soft_oil_does_not_swing_back_far_enough_to_alarm() -> None:
    assert swing_back(SOFT) < SHAKEN_S_AT_LIMIT * SLEW.speed_limit


def test_a_valve_that_slams_shut_swings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool_travel, "CLOSE_S", (0.4,) * 5)
    assert swing_back(SOFT) > 2.0 * SHAKEN_S_AT_LIMIT * SLEW.speed_limit


@pytest.mark.parametrize("deadband", [0.03, 0.3])
@pytest.mark.parametrize("full", [0.2, 1.8])
@pytest.mark.parametrize("delay_s", [0.02, 0.25])
def test_a_leg_comes_near_its_goal_in_the_time_that_a_test_has(deadband: float, full: float, delay_s: float) -> None:
    valve = StandIn(deadbands=(deadband, deadband), full_speeds=(full, full), delay_s=delay_s)
    _, position, program = travelled(valve, GOAL)
    assert abs(float(position[-1]) - GOAL) < 4.0 * TOLERANCES[Joint.SLEW]
    assert program.duration_s < 1e-9 * MAX_OPEN_NS


def legs(reached: list[float], goal: float) -> tuple[list[Leg], SpoolTravel]:
    """The legs of a travel of the slew alone that stands at these places one after the other."""
    travel, found = SpoolTravel((goal, 0.0, 0.0, 0.0, 0.0), [Joint.SLEW]), []
    for at in reached:
        leg = travel.next_leg((at, 0.0, 0.0, 0.0, 0.0), [known(SOFT)] * 5, [allowed_by(SLEW)] * 5)
        if leg is None:
            break
        found.append(leg)
    return found, travel


def test_legs_that_overshoot_do_not_get_faster_and_end_near_enough() -> None:
    """A valve with a long dead time moves its joint by more than the tolerance, however briefly it opens."""
    found, travel = legs([0.04 * (-1) ** k for k in range(12)], 0.0)
    assert len(found) == MAX_LEGS and travel.stuck is None
    assert max(abs(leg.program.points[3][1]) for leg in found[2:]) == abs(found[2].program.points[3][1])


def test_a_joint_that_stands_still_gets_faster_legs_and_is_stuck_in_the_end() -> None:
    found, travel = legs([0.0] * 20, 0.12)
    assert len(found) == MAX_LEGS and travel.stuck is Joint.SLEW
    tops = [max(p for _, p in leg.program.points) for leg in found]
    assert tops == sorted(tops) and tops[-1] > tops[0]


def test_a_staircase_on_a_valve_that_is_faster_than_it_seemed_ends_before_the_controller_stops_it() -> None:
    """The search may find two thirds of a valve's full speed; the controller stops a test at 1.25 of the limit."""
    run = MonitoredSpoolRun(SLEW, SpoolTask(Joint.SLEW, 1, "staircase"), 0.0, allowed_by(SLEW))
    planned_s, limit = run.program.duration_s, SLEW.speed_limit
    assert run.follow(2.0, 0.1, 1.05 * limit) is None and run.program.duration_s == planned_s
    assert run.follow(2.1, 0.2, 1.15 * limit) is None and run.closed
    assert run.program.at(2.3) <= REST_PCT and run.program.duration_s < 3.0


# -- a search that knows nothing of a valve
LOADER_SLEW = load_profile("palms_471").joints["slew"]
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
    whole = valve.run(Joint.SLEW, side, "wiggle", wiggle(LOADER_SLEW, side), 0.1, seed)
    moved = next(t for t, p in zip(whole.time_s, side * (whole.position - 0.1), strict=True) if p > MOVED) - 0.2
    begun = wiggle(LOADER_SLEW, side)
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
    valve = LOADER_SLEW.valve
    for change, wanted in (
        ({"deadband_plus_pct": 14.5, "full_speed_minus": 0.6, "delay_s": 0.15}, True),
        ({"deadband_plus_pct": 18.0}, False),
        ({"deadband_minus_pct": 5.0}, False),
        ({"full_speed_plus": 0.25}, False),
        ({"full_speed_minus": 1.0}, False),
        ({"delay_s": 0.2}, False),
    ):
        found = msgspec.structs.replace(LOADER_SLEW, valve=msgspec.structs.replace(valve, **change))
        assert suits(LOADER_SLEW, found) is wanted, change


def test_both_sides_make_a_joint_with_that_valve() -> None:
    valve = StandIn(deadbands=(0.05, 0.25), full_speeds=(1.2, 0.2), delay_s=0.2)
    found = rough_spec(Joint.SLEW, LOADER_SLEW, searched(valve, 1), searched(valve, -1))
    assert found.valve.deadband_plus_pct == pytest.approx(5.0, abs=2.0)
    assert found.valve.deadband_minus_pct == pytest.approx(25.0, abs=2.0)
    assert found.valve.full_speed_plus > 4.0 * found.valve.full_speed_minus
    assert found.valve.delay_s == pytest.approx(0.2, abs=0.02) and not suits(LOADER_SLEW, found)
