"""The fits of a calibration: they find what a known valve, spool and crane were given, and say when they cannot."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from autonomy.calibration.plan import Findings
from autonomy.calibration.result import identify
from autonomy.calibration.spool_program import reversed_sweep, staircase, sweep, wiggle
from autonomy.calibration.survey import SurveyReading, fit_survey, most_informative_poses
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.valve_fit import deadband_difference, fit_delay, fit_valve, response_s
from machine.geometry.sag import true_pin
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Sag
from machine.sensing import empty_moment_nm
from runtime.errors import InputRefused
from tests.autonomy.valve_stand_in import StandIn
from tests.codes import coded

PALMS = load_profile("palms_471")
SLEW = PALMS.joints["slew"]
OTHER = StandIn(deadbands=(0.105, 0.142), hysteresis=0.026, full_speeds=(0.6, 0.42), delay_s=0.131)


MACHINES = [StandIn(), pytest.param(OTHER, marks=pytest.mark.long)]


@cache
def measured(machine: StandIn) -> tuple[SpoolTestRecord, ...]:
    """Sweeps and staircases of both sides of a slew."""
    tests = []
    start = -0.3
    for side in (1, -1):
        for kind, program in (("sweep", reversed_sweep(sweep(SLEW, side), 2.0)), ("staircase", staircase(SLEW, side))):
            tests.append(machine.run(Joint.SLEW, side, kind, program, start, seed=len(tests)))
            start = float(tests[-1].position[-1])
    return tuple(tests)


@pytest.mark.parametrize("machine", MACHINES, ids=["near the profile", "far from it"])
def test_the_valve_is_found(machine: StandIn) -> None:
    fit = fit_valve(measured(machine), SLEW)
    assert fit.deadbands == pytest.approx(machine.deadbands, abs=0.004)
    assert fit.full_speeds == pytest.approx(machine.full_speeds, rel=0.03)
    assert fit.hysteresis == pytest.approx(machine.hysteresis, abs=0.006)
    assert fit.ringing[0] == pytest.approx(machine.ring_rad_s, rel=0.15)
    assert fit.residual < 1e-3
    assert fit.errors["deadband_plus"] < 0.008 and fit.errors["full_plus"] < 0.04 * fit.full_speeds[0]


@pytest.mark.long
def test_a_fast_valve_is_known_where_it_is_driven() -> None:
    """Nobody opens it fully: the speed limit takes a quarter of its stroke."""
    fast = StandIn(full_speeds=(1.4, 0.3), exponent=1.04)
    fit = fit_valve(measured(fast), SLEW)
    assert fit.errors["speed_plus"] < 0.6 * fit.errors["full_plus"] / fit.full_speeds[0]
    assert fit.errors["speed_minus"] == pytest.approx(fit.errors["full_minus"] / fit.full_speeds[1]), (
        "all of its stroke"
    )
    opening = (SLEW.speed_limit / fast.full_speeds[0]) ** (1.0 / fast.exponent)
    spool = fast.deadbands[0] + opening * (1.0 - fast.deadbands[0])
    found = fit.full_speeds[0] * ((spool - fit.deadbands[0]) / (1.0 - fit.deadbands[0])) ** fit.exponent
    assert found == pytest.approx(SLEW.speed_limit, rel=3.0 * fit.errors["speed_plus"] + 0.01)


@pytest.mark.parametrize("machine", MACHINES, ids=["near the profile", "far from it"])
def test_dead_time_and_lag_are_found_to_milliseconds(machine: StandIn) -> None:
    stairs = [t for t in measured(machine) if t.kind == "staircase"]
    fit = fit_delay(stairs)
    assert fit is not None
    assert fit.delay_s == pytest.approx(machine.delay_s, abs=0.003)
    assert fit.lag_s == pytest.approx(2 * machine.spool_zeta / machine.spool_rad_s, abs=0.004)
    for t in stairs:
        assert machine.delay_s < response_s(t, 0.12) < 0.5


def test_a_valve_node_without_spool_sensors_gives_no_dead_time() -> None:
    silent = [dataclasses.replace(t, spool=None) for t in measured(StandIn()) if t.kind == "staircase"]
    assert fit_delay(silent) is None
    dead = [dataclasses.replace(t, spool=np.zeros_like(t.position)) for t in measured(StandIn())]
    assert fit_delay(dead) is None


@pytest.mark.long
def test_a_repetition_agrees_and_another_valve_does_not() -> None:
    fit = fit_valve(measured(StandIn()), SLEW)
    program = wiggle(SLEW, 1)
    again = StandIn().run(Joint.SLEW, 1, "wiggle", program, 0.0, seed=9)
    moved = StandIn(deadbands=(0.17, 0.11)).run(Joint.SLEW, 1, "wiggle", program, 0.0, seed=9)
    assert abs(deadband_difference(fit, again)) < 0.005
    assert deadband_difference(fit, moved) == pytest.approx(0.04, abs=0.008)


SAG = Sag(0.0054, 0.0036, 0.028, 1.2e-6, 4500.0, 3000.0)
OFFSETS = (0.002, -0.0025, 0.0015, 0.002)


def surveyed(noise_m: float, friction_nm: float = 0.0, weighed: bool = True) -> list[SurveyReading]:
    rng = np.random.default_rng(3)
    candidates = [
        (slew, lift, tilt, ext, 0.0)
        for slew in (-0.4, 0.0, 0.4)
        for lift in (0.4, 0.8, 1.2)
        for tilt in (-2.0, -1.2, -0.4)
        for ext in (0.3, 1.0, 1.6)
    ]
    chosen = most_informative_poses(PALMS.kinematics, candidates, 7)
    assert len(set(chosen)) == 7
    readings = []
    for i in chosen:
        pin = np.array(true_pin(SAG, PALMS.kinematics, candidates[i])) + rng.normal(0.0, noise_m, 3)
        moment_nm = empty_moment_nm(SAG, PALMS.kinematics, candidates[i]) + friction_nm * rng.uniform(-1.0, 1.0)
        shown = tuple(q + o for q, o in zip(candidates[i], (*OFFSETS, 0.0), strict=True))
        readings.append(SurveyReading(shown, tuple(pin), moment_nm if weighed else np.nan))
    return readings


def off_m(sag: Sag, offsets: tuple[float, ...], load_kg: float) -> float:
    """Greatest error of the true pin over the work space when encoders and column are read by a fit."""
    worst = 0.0
    for lift in (0.2, 0.6, 1.0):
        for tilt in (-1.8, -1.0, -0.5):
            for ext in (0.2, 1.5):
                q = (0.2, lift, tilt, ext, 0.0)
                read = tuple(v + true - found for v, true, found in zip(q, (*OFFSETS, 0), (*offsets, 0), strict=True))
                true = true_pin(SAG, PALMS.kinematics, q, load_kg)
                worst = max(
                    worst, float(np.linalg.norm(np.subtract(true_pin(sag, PALMS.kinematics, read, load_kg), true)))
                )
    return worst


def test_zeros_and_sag_come_out_of_a_survey_that_weighs_the_crane() -> None:
    exact = fit_survey(PALMS.kinematics, surveyed(0.0))
    assert exact.offsets == pytest.approx(OFFSETS, abs=3e-4)
    assert exact.sag.load_rad_nm == pytest.approx(SAG.load_rad_nm, rel=0.02)
    assert (exact.sag.head_nm_m, exact.sag.pin_nm_m) == pytest.approx((SAG.head_nm_m, SAG.pin_nm_m), rel=0.02)
    assert max(exact.after_m) < 5e-4 < 0.01 < max(exact.before_m)
    noisy = fit_survey(PALMS.kinematics, surveyed(0.0007, friction_nm=700.0))
    for found, true, error in zip(noisy.offsets, OFFSETS, noisy.errors, strict=False):
        assert abs(found - true) < 4 * error
    assert off_m(noisy.sag, noisy.offsets, 0.0) < 0.004
    assert off_m(noisy.sag, noisy.offsets, 200.0) < 0.012 < 0.08 < off_m(Sag(0.0, 0.0, 0.0), OFFSETS, 200.0)


def test_without_pressures_the_empty_crane_is_known_and_loads_are_not() -> None:
    fit = fit_survey(PALMS.kinematics, surveyed(0.0007, weighed=False))
    assert (fit.sag.load_rad_nm, fit.sag.head_nm_m, fit.sag.pin_nm_m, fit.moments_nm) == (0.0, 0.0, 0.0, ())
    assert off_m(fit.sag, fit.offsets, 0.0) < 0.006


def test_a_crane_with_a_known_sag_is_compared_with_that() -> None:
    readings = surveyed(0.0)
    known = fit_survey(PALMS.kinematics, readings, SAG).before_m
    assert max(known) < 0.5 * max(fit_survey(PALMS.kinematics, readings).before_m)


def test_too_few_surveyed_poses_are_refused() -> None:
    with pytest.raises(InputRefused, check=coded("survey.too-few-poses")):
        fit_survey(PALMS.kinematics, surveyed(0.0)[:4])


def found(tests: tuple[SpoolTestRecord, ...]) -> Findings:
    wiggles = [StandIn().run(Joint.SLEW, side, "wiggle", wiggle(SLEW, side), 0.0) for side in (1, -1)]
    return Findings(wiggles=wiggles, tests=list(tests))


@pytest.mark.long
def test_a_good_run_is_plausible() -> None:
    assert identify(PALMS, found(measured(StandIn()))).implausible == ()


@pytest.mark.long
@pytest.mark.parametrize(
    ("machine", "code"),
    [
        (StandIn(deadbands=(0.37, 0.37)), "implausible.out-of-range"),
        (StandIn(hysteresis=0.09, deadbands=(0.12, 0.12)), "implausible.hysteresis"),
        (StandIn(full_speeds=(0.45, 0.04)), "implausible.out-of-range"),
    ],
    ids=["wide", "sticking", "one-sided"],
)
def test_implausible_values_are_reported(machine: StandIn, code: str) -> None:
    result = identify(PALMS, found(measured(machine)))
    assert any(problem.code == code for problem in result.implausible), result.implausible


@pytest.mark.long
def test_a_joint_that_was_held_does_not_fit_a_valve() -> None:
    tests = list(measured(StandIn()))
    held = tests[1].position.copy()
    held[len(held) // 2 :] = held[len(held) // 2]
    tests[1] = dataclasses.replace(tests[1], position=held)
    problems = identify(PALMS, found(tuple(tests))).implausible
    assert any(problem.code == "implausible.motion-residual" for problem in problems), problems
