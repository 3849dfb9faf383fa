"""The fits of a calibration: they find what a known valve, spool and crane were given, and say when they cannot."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from math import pi
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from autonomy.calibration.loop_gain import GAIN_MARGIN_DB, PHASE_MARGIN_DEG, borne_gain_1_s, margins
from autonomy.calibration.plan import Findings
from autonomy.calibration.procedure_state import MIN_FIRST_TURN_RAD
from autonomy.calibration.result import identify
from autonomy.calibration.spool_program import (
    PULSES,
    TURN_TOPS_PCT,
    SpoolProgram,
    allowed_by,
    reversed_sweep,
    staircase,
    sweep,
    turn_search,
    wiggle,
)
from autonomy.calibration.survey import SurveyReading, fit_survey, most_informative_poses
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import YAW_SIGMA_RAD, SideFit, Turn, TurnFit, fit_turns, pulse_to
from autonomy.calibration.valve_fit import deadband_difference, fit_delay, fit_valve, response_s
from controller.crane.spool_test_run import MAX_OPEN_UNSENSED_NS
from machine.geometry.sag import true_pin
from machine.joints import Joint
from machine.loading.checks import MAX_GAIN_DELAY
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
    assert fit.delay_s == pytest.approx(machine.delay_s, abs=0.003)
    assert fit.lag_s == pytest.approx(2 * machine.spool_zeta / machine.spool_rad_s, abs=0.004)
    for t in stairs:
        assert machine.delay_s < response_s(t, 0.12) < 0.5


def test_a_valve_node_without_spool_sensors_gives_no_dead_time() -> None:
    silent = [replace(t, spool=None) for t in measured(StandIn()) if t.kind == "staircase"]
    assert fit_delay(silent) is None
    dead = [replace(t, spool=np.zeros_like(t.position)) for t in measured(StandIn())]
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
    candidates = list(product((-0.4, 0.0, 0.4), (0.4, 0.8, 1.2), (-2.0, -1.2, -0.4), (0.3, 1.0, 1.6), (0.0,)))
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
    wrong = np.subtract((*OFFSETS, 0.0), (*offsets, 0.0))
    places = np.array(list(product((0.2,), (0.2, 0.6, 1.0), (-1.8, -1.0, -0.5), (0.2, 1.5), (0.0,))))
    found = [true_pin(sag, PALMS.kinematics, q, load_kg) for q in places + wrong]
    true = [true_pin(SAG, PALMS.kinematics, q, load_kg) for q in places]
    return float(np.linalg.norm(np.subtract(found, true), axis=1).max())


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
    tests[1] = replace(tests[1], position=held)
    problems = identify(PALMS, found(tuple(tests))).implausible
    assert any(problem.code == "implausible.motion-residual" for problem in problems), problems


# -- surveyed turns of a rotator that has no encoder
AORO = load_profile("aoro_fc8")
ROT = AORO.joints["rot"]
READINGS = 8
SLOW_PLUS = StandIn(deadbands=(0.122, 0.085), full_speeds=(1.65, 2.35), hysteresis=0.024)
SLOW_MINUS = StandIn(deadbands=(0.083, 0.12), full_speeds=(2.4, 1.6), hysteresis=0.015)
FAR_OFF = StandIn(deadbands=(0.14, 0.07), full_speeds=(3.2, 1.3))


def turned(
    machine: StandIn, seed: int = 3, readings: int = READINGS, searched: bool = False
) -> tuple[list[Turn], list[float]]:
    """The turns of a calibration, and where the rotator stood after each [rad]."""
    rng = np.random.default_rng(seed)

    def read() -> float:
        return (0.3 + angle + rng.normal(0.0, YAW_SIGMA_RAD / readings**0.5)) % pi

    angle, turns, stood = 0.0, [], []
    before = read()

    def turn(side: int, kind: str, program: SpoolProgram) -> float:
        """One more, and how far it went."""
        nonlocal angle, before
        record, was = machine.run(Joint.ROT, side, kind, program, angle), angle
        angle = float(record.position[-1])
        after = read()
        turns.append(Turn(record, before, after, readings))
        before = after
        return abs(angle - was)

    for side in (1, -1) if searched else ():
        for top_pct in TURN_TOPS_PCT:  # rising ramps until one turns it, as the procedure does
            if turn(side, "search", turn_search(ROT, side, top_pct, allowed_by(ROT))) > MIN_FIRST_TURN_RAD:
                break
    for share, far in PULSES:
        for side, goal in ((1, far), (-1, 0.0)):
            turn(side, "pulse", pulse_to(ROT, fit_turns(turns, ROT), side, share, goal))
            stood.append(angle)
    return turns, stood


def errors_of(fit: TurnFit, machine: StandIn) -> tuple[list[float], list[float]]:
    """Of dead-bands [share of the stroke] and full speeds [relative]."""
    sides = (fit.plus, fit.minus)
    return (
        [abs(s.deadband - true) for s, true in zip(sides, machine.deadbands, strict=True)],
        [abs(s.full_speed / true - 1.0) for s, true in zip(sides, machine.full_speeds, strict=True)],
    )


@pytest.mark.parametrize("machine", [SLOW_PLUS, SLOW_MINUS], ids=["slow to plus", "slow to minus"])
def test_the_valve_is_found_though_its_metering_is_another(machine: StandIn) -> None:
    turns, stood = turned(machine)
    fit = fit_turns(turns, ROT)
    deadbands, fulls = errors_of(fit, machine)
    assert max(deadbands) < 0.02 and max(fulls) < 0.05
    assert max(fit.plus.errors[0], fit.minus.errors[0]) < 0.004
    assert max(map(abs, (*fit.plus.left_rad, *fit.minus.left_rad))) < 0.03
    assert fit.angle_rad == pytest.approx(stood[-1], abs=0.03) and abs(stood[-1]) < 0.15, "it is back"
    result = identify(AORO, Findings(turns=turns))
    assert result.turns == fit and result.implausible == () and result.kept == ()


def test_half_turns_are_not_mistaken_on_a_machine_far_from_its_profile() -> None:
    turns, stood = turned(FAR_OFF)
    fit = fit_turns(turns, ROT)
    assert max(abs(a - b) for a, b in zip(stood, (0.0, *stood), strict=False)) > pi / 2, "a turn that looks shorter"
    true = [b - a for a, b in zip((0.0, *stood), stood, strict=False)]
    assert fit.plus.turns_rad == pytest.approx(true[::2], abs=0.03)
    assert fit.minus.turns_rad == pytest.approx([-turn for turn in true[1::2]], abs=0.03)
    assert min(stood) > -0.3 and max(stood) < pi, "never farther than half a turn"
    assert abs(stood[-1]) < 0.15


def test_single_readings_of_a_person_are_plausible() -> None:
    turns, _ = turned(SLOW_PLUS, readings=1, searched=True)
    result = identify(AORO, Findings(turns=turns))
    assert result.turns is not None and result.implausible == ()
    assert max(errors_of(result.turns, SLOW_PLUS)[1]) < 0.1


@pytest.mark.parametrize(("deadband", "full"), [(0.03, 0.67), (0.052, 0.8), (0.18, 0.67), (0.3, 0.67), (0.3, 6.0)])
def test_no_pulse_lasts_longer_than_the_controller_lets_one(deadband: float, full: float) -> None:
    """The opening grows as slowly as the faster side needs it: a slow one beside it was stopped."""
    slow, fast = SideFit(deadband, full, (0.01, 0.1)), SideFit(0.097, 4.25, (0.01, 0.1))
    for share, far in PULSES:
        for fit in (TurnFit(slow, slow), TurnFit(slow, fast)):
            assert pulse_to(ROT, fit, 1, share, far).duration_s < 1e-9 * MAX_OPEN_UNSENSED_NS


def test_without_turns_a_side_keeps_the_profiles_values() -> None:
    fit = fit_turns([], ROT)
    assert (fit.plus.deadband, fit.minus.full_speed) == (0.01 * ROT.valve.deadband_plus_pct, ROT.valve.full_speed_minus)
    assert fit.angle_rad == 0.0


def test_implausible_turns_are_reported() -> None:
    turns, _ = turned(SLOW_PLUS)
    wrong = [*turns[:-2], replace(turns[-2], after_rad=turns[-2].after_rad + 0.9), turns[-1]]
    problems = identify(AORO, Findings(turns=wrong)).implausible
    assert "implausible.turn-residual" in {problem.code for problem in problems}, problems
    crawling, _ = turned(replace(SLOW_PLUS, full_speeds=(0.3, 2.35)))
    problems = identify(AORO, Findings(turns=crawling)).implausible
    assert "implausible.out-of-range" in {problem.code for problem in problems}, problems


# -- loop gains that a measured dead time bears
PROFILES = {name: load_profile(name) for name in ("palms_471", "aoro_fc8")}


def dead_time(delay_s: float, lag_s: float = 0.04, oil_s: float = 0.04):
    """A joint's result as far as a gain depends on it."""
    return SimpleNamespace(
        delay=SimpleNamespace(delay_s=delay_s, lag_s=lag_s), valve=SimpleNamespace(lags_s=(oil_s, oil_s))
    )


def test_margins_of_a_pure_delay_are_the_closed_forms() -> None:
    phase_deg, gain_db = margins(2.0, 0.2, 1e-4, 0.0)
    assert phase_deg == pytest.approx(90.0 - 2.0 * 0.2 * 57.3, abs=0.6)
    assert gain_db == pytest.approx(11.9, abs=0.2)  # 20 log10(pi / 2 / 0.4)


@pytest.mark.parametrize("name", PROFILES)
def test_the_shipped_gains_stay_at_the_shipped_dead_times(name: str) -> None:
    for spec in PROFILES[name].joints.values():
        assert borne_gain_1_s(spec, dead_time(spec.valve.delay_s)) == spec.law.kp_1_s


@pytest.mark.parametrize("delay_s", [0.149, 0.2, 0.25])
@pytest.mark.parametrize("name", PROFILES)
def test_a_lowered_gain_has_its_margins_and_is_no_lower_than_it_must_be(name: str, delay_s: float) -> None:
    lowered = 0
    for spec in PROFILES[name].joints.values():
        kp = borne_gain_1_s(spec, dead_time(delay_s))
        assert kp * delay_s <= MAX_GAIN_DELAY and kp <= spec.law.kp_1_s
        phase_deg, gain_db = margins(kp, delay_s, 0.04, 0.04)
        assert phase_deg >= PHASE_MARGIN_DEG and gain_db >= GAIN_MARGIN_DB
        if kp < spec.law.kp_1_s:
            lowered += 1
            more = margins(1.15 * kp, delay_s, 0.04, 0.04)
            assert more[0] < PHASE_MARGIN_DEG or more[1] < GAIN_MARGIN_DB or 1.15 * kp * delay_s > 0.9 * MAX_GAIN_DELAY
    assert lowered >= 1 or delay_s < 0.2


def test_without_a_measured_dead_time_a_gain_stays() -> None:
    spec = PROFILES["palms_471"].joints["ext"]
    assert borne_gain_1_s(msgspec.structs.replace(spec), SimpleNamespace(delay=None)) == spec.law.kp_1_s
