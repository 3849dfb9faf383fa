"""The valve of a rotator that has no encoder, from surveyed turns: found through noise, half turns not mistaken."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from autonomy.calibration.plan import Findings
from autonomy.calibration.procedure_state import MIN_FIRST_TURN_RAD
from autonomy.calibration.result import identify
from autonomy.calibration.spool_program import PULSES, TURN_TOPS_PCT, allowed_by, turn_search
from autonomy.calibration.turn_fit import YAW_SIGMA_RAD, SideFit, Turn, TurnFit, fit_turns, pulse_to
from controller.crane.spool_test_run import MAX_OPEN_UNSENSED_NS
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.autonomy.valve_stand_in import StandIn

AORO = load_profile("aoro_fc8")
ROT = AORO.joints["rot"]
READINGS = 8
SLOW_PLUS = StandIn(deadbands=(0.122, 0.085), full_speeds=(1.65, 2.35), hysteresis=0.024)
SLOW_MINUS = StandIn(deadbands=(0.083, 0.12), full_speeds=(2.4, 1.6), hysteresis=0.015)
FAR_OFF = StandIn(deadbands=(0.14, 0.07), full_speeds=(3.2, 1.3))


def surveyed(
    machine: StandIn, seed: int = 3, readings: int = READINGS, searched: bool = False
) -> tuple[list[Turn], list[float]]:
    """The turns of a calibration, and where the rotator stood after each [rad]."""
    rng = np.random.default_rng(seed)

    def read() -> float:
        return (0.3 + angle + rng.normal(0.0, YAW_SIGMA_RAD / readings**0.5)) % pi

    angle, turns, stood = 0.0, [], []
    before = read()
    for side in (1, -1) if searched else ():
        for top_pct in TURN_TOPS_PCT:  # rising ramps until one turns it, as the procedure does
            record = machine.run(Joint.ROT, side, "search", turn_search(ROT, side, top_pct, allowed_by(ROT)), angle)
            turned, angle = abs(float(record.position[-1]) - angle), float(record.position[-1])
            after = read()
            turns.append(Turn(record, before, after, readings))
            before = after
            if turned > MIN_FIRST_TURN_RAD:
                break
    for share, far in PULSES:
        for side, goal in ((1, far), (-1, 0.0)):
            program = pulse_to(ROT, fit_turns(turns, ROT), side, share, goal)
            record = machine.run(Joint.ROT, side, "pulse", program, angle)
            angle = float(record.position[-1])
            after = read()
            turns.append(Turn(record, before, after, readings))
            stood.append(angle)
            before = after
    return turns, stood


def errors(fit: TurnFit, machine: StandIn) -> tuple[list[float], list[float]]:
    """Of dead-bands [share of the stroke] and full speeds [relative]."""
    sides = (fit.plus, fit.minus)
    return (
        [abs(s.deadband - true) for s, true in zip(sides, machine.deadbands, strict=True)],
        [abs(s.full_speed / true - 1.0) for s, true in zip(sides, machine.full_speeds, strict=True)],
    )


@pytest.mark.parametrize("machine", [SLOW_PLUS, SLOW_MINUS], ids=["slow to plus", "slow to minus"])
def test_the_valve_is_found_though_its_metering_is_another(machine: StandIn) -> None:
    turns, stood = surveyed(machine)
    fit = fit_turns(turns, ROT)
    deadbands, fulls = errors(fit, machine)
    assert max(deadbands) < 0.02 and max(fulls) < 0.05
    assert max(fit.plus.errors[0], fit.minus.errors[0]) < 0.004
    assert max(map(abs, (*fit.plus.left_rad, *fit.minus.left_rad))) < 0.03
    assert fit.angle_rad == pytest.approx(stood[-1], abs=0.03) and abs(stood[-1]) < 0.15, "it is back"
    result = identify(AORO, Findings(turns=turns))
    assert result.turns == fit and result.implausible == () and result.kept == ()


def test_half_turns_are_not_mistaken_on_a_machine_far_from_its_profile() -> None:
    turns, stood = surveyed(FAR_OFF)
    fit = fit_turns(turns, ROT)
    assert max(abs(a - b) for a, b in zip(stood, (0.0, *stood), strict=False)) > pi / 2, "a turn that looks shorter"
    true = [b - a for a, b in zip((0.0, *stood), stood, strict=False)]
    assert fit.plus.turns_rad == pytest.approx(true[::2], abs=0.03)
    assert fit.minus.turns_rad == pytest.approx([-turn for turn in true[1::2]], abs=0.03)
    assert min(stood) > -0.3 and max(stood) < pi, "never farther than half a turn"
    assert abs(stood[-1]) < 0.15


def test_single_readings_of_a_person_are_plausible() -> None:
    turns, _ = surveyed(SLOW_PLUS, readings=1, searched=True)
    result = identify(AORO, Findings(turns=turns))
    assert result.turns is not None and result.implausible == ()
    assert max(errors(result.turns, SLOW_PLUS)[1]) < 0.1


@pytest.mark.parametrize(("deadband", "full"), [(0.03, 0.67), (0.18, 0.67), (0.3, 0.67), (0.3, 6.0)])
def test_no_pulse_lasts_longer_than_the_controller_lets_one(deadband: float, full: float) -> None:
    slow = SideFit(deadband, full, (0.01, 0.1))
    for share, far in PULSES:
        assert pulse_to(ROT, TurnFit(slow, slow), 1, share, far).duration_s < 1e-9 * MAX_OPEN_UNSENSED_NS


def test_without_turns_a_side_keeps_the_profiles_values() -> None:
    fit = fit_turns([], ROT)
    assert (fit.plus.deadband, fit.minus.full_speed) == (0.01 * ROT.valve.deadband_plus_pct, ROT.valve.full_speed_minus)
    assert fit.angle_rad == 0.0


def test_implausible_turns_are_reported() -> None:
    turns, _ = surveyed(SLOW_PLUS)
    wrong = [*turns[:-2], replace(turns[-2], after_rad=turns[-2].after_rad + 0.9), turns[-1]]
    problems = identify(AORO, Findings(turns=wrong)).implausible
    assert "implausible.turn-residual" in {problem.code for problem in problems}, problems
    crawling, _ = surveyed(replace(SLOW_PLUS, full_speeds=(0.3, 2.35)))
    problems = identify(AORO, Findings(turns=crawling)).implausible
    assert "implausible.out-of-range" in {problem.code for problem in problems}, problems
