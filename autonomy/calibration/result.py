"""The result of a calibration and its plausibility: values per joint, and a problem for each implausible value.

``identify`` turns the tests of a run into a `CalibrationResult`.  ``implausible`` holds one problem per value that is
outside the range of such machines, that differs between repetitions, or that the data do not determine.  A profile is
written only when there is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import degrees, isfinite
from typing import Final

from autonomy.calibration.plan import Findings
from autonomy.calibration.survey import MIN_POSES, OFFSETS, SurveyFit, fit_survey
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import SIDES, TurnFit, fit_turns
from autonomy.calibration.valve_fit import DelayFit, ValveFit, deadband_difference, fit_delay, fit_valve, response_s
from can_dbc.messages.crane import GrappleCommand
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, Profile, joint
from runtime.errors import Problem

DEADBAND_BOUNDS: Final = (0.01, 0.35)
"""Range of a mobile valve's overlap, as shares of full command."""
MAX_HYSTERESIS: Final = 0.06
FULL_SPEED_BOUNDS: Final = (0.28, 3.6)
"""Found full speed over the profile's, which may be off by three: outside this range profile, pump or unit is wrong."""
MAX_SIDE_RATIO: Final = 11.0
"""Greatest ratio of the two sides' full speeds: one side throttled to a third, the other three times as fast."""
MAX_DEADBAND_ERROR: Final = 0.008
MAX_GAIN_ERROR: Final = 0.04
"""Greatest standard errors: a calibration promises twice as much."""
MAX_REPEAT_DIFFERENCE: Final = 0.03
"""Greatest difference between the dead-band of the wiggle, a coarse test, and that of the other tests."""
MAX_RESIDUAL_S: Final = 0.03
"""Root mean square residual of the positions, as time at the joint's speed limit."""
DELAY_BOUNDS_S: Final = (0.01, 0.27)
LAG_BOUNDS_S: Final = (0.005, 0.2)
MAX_SIDE_DELAY_DIFFERENCE_S: Final = 0.01
MAX_SPOOL_RESIDUAL: Final = 0.01
MAX_OFFSET: Final = (0.1, 0.03, 0.03, 0.03)
"""Zero errors [rad, m] above which an encoder was mounted wrongly, not inexactly."""
MAX_SAG_RAD_M: Final = 0.02
MAX_COMPLIANCE_RAD_NM: Final = 6e-6
"""A column more compliant than this bends by 0.1 rad under a small crane's own weight."""
MAX_MOMENT_RESIDUAL_NM: Final = 2000.0
"""Root mean square residual of the moments: more than twice the friction of a lift cylinder."""
MAX_TURN_RESIDUAL_RAD: Final = 0.1
"""Residual of a turn: four times the noise of two single readings; a mistaken half turn leaves more."""
MAX_TURN_DEADBAND_ERROR: Final = 0.01
"""Greatest standard error of a dead-band by turns, where six rests replace thousands of samples."""
MIN_TURNS: Final = 2
"""Turns per side: a single turn cannot separate dead-band from full speed."""
MAX_SURVEY_RESIDUAL_M: Final = 0.012
"""Root mean square distance of surveyed pins after the fit."""
GRAPPLE_TIME_BOUNDS_S: Final = (0.5, 10.0)


@dataclass(frozen=True, slots=True)
class JointResult:
    """One joint: its valve, its delay (None without spool feedback), response times and repetition, plus and minus."""

    joint: Joint
    valve: ValveFit
    delay: DelayFit | None
    responses_s: tuple[float, float]
    repeats: tuple[float, float]
    fastest: float
    """Greatest speed reached [rad/s, m/s]."""
    tests: tuple[SpoolTestRecord, ...]


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A whole calibration.  ``survey`` is None without a survey, ``turns`` when no rotator was tested by surveyed
    directions.  ``kept`` holds a sentence for each value that stays as in the profile, for want of a sensor.
    """

    joints: dict[Joint, JointResult]
    grapple_s: dict[GrappleCommand, float]
    survey: SurveyFit | None
    implausible: tuple[Problem, ...] = field(default=())
    turns: TurnFit | None = None
    kept: tuple[str, ...] = ()


def identify(profile: Profile, found: Findings) -> CalibrationResult:
    """Fit and check everything of a complete run."""
    joints = {}
    for j in JOINTS:
        tests = [t for t in found.tests if t.joint is j]
        if tests:
            spec = found.specs.get(j) or joint(profile, j)
            joints[j] = _joint_result(j, spec, tests, [w for w in found.wiggles if w.joint is j])
    survey = fit_survey(profile.kinematics, found.readings, profile.sag) if len(found.readings) >= MIN_POSES else None
    problems = [s for r in joints.values() for s in _joint_problems(r, joint(profile, r.joint))]
    problems += list(_grapple_problems(found.grapple_s))
    if survey is not None:
        problems += list(_survey_problems(survey))
    turns, unchanged_valves = None, []
    if joint(profile, Joint.ROT).encoder is None:
        turned = [*found.searched, *found.turns]
        if found.turns and all(sum(t.record.side == side for t in turned) >= MIN_TURNS for side in SIDES):
            turns = fit_turns(turned, joint(profile, Joint.ROT))
            problems += list(_turn_problems(turns, joint(profile, Joint.ROT)))
        else:
            unchanged_valves.append(
                "rot: its valve's values stay as they were, it has no encoder and no turn of it was surveyed"
            )
    return CalibrationResult(joints, dict(found.grapple_s), survey, tuple(problems), turns, tuple(unchanged_valves))


def _joint_result(
    which: Joint, spec: JointSpec, tests: Sequence[SpoolTestRecord], wiggles: Sequence[SpoolTestRecord]
) -> JointResult:
    valve = fit_valve(tests, spec)
    stairs = [t for t in tests if t.kind == "staircase"]

    def side(sign: int) -> tuple[float, float]:
        first = next((t for t in stairs if t.side == sign), None)
        again = next((w for w in wiggles if w.side == sign), None)
        deadband = valve.deadbands[0 if sign > 0 else 1]
        response = response_s(first, deadband) if first else float("nan")
        return response, deadband_difference(valve, again) if again else float("nan")

    (plus_s, plus), (minus_s, minus) = side(+1), side(-1)
    steps = 20
    fastest = max(
        float(max(abs(t.position[steps:] - t.position[:-steps])) / (steps * (t.time_s[1] - t.time_s[0])))
        for t in stairs
    )
    return JointResult(which, valve, fit_delay(stairs), (plus_s, minus_s), (plus, minus), fastest, tuple(tests))


def _outside(
    name: str, what: str, value: float, bounds: tuple[float, float], scale: float, unit: str
) -> Iterator[Problem]:
    low, high = bounds
    if not low <= value <= high:
        yield Problem(
            "implausible.out-of-range",
            f"{name}: {what} {scale * value:.3g} {unit} is outside {scale * low:.3g} to {scale * high:.3g} {unit} "
            "of such machines",
        )


def _side_problems(
    name: str, deadband: float, full_speed: float, errors: tuple[float, float], nominal: float, most: float
) -> Iterator[Problem]:
    """Find the problems of one side of a valve; ``errors`` are the standard errors of its dead-band and, as a share,
    its speed; ``most`` is the greatest of the dead-band.
    """
    yield from _outside(name, "dead-band", deadband, DEADBAND_BOUNDS, 100.0, "%")
    yield from _outside(name, "full speed over the profile's", full_speed / nominal, FULL_SPEED_BOUNDS, 1.0, "")
    if not errors[0] <= most:
        why = f"{name}: the dead-band is known only within {100 * errors[0]:.1f} %; repeat at rest, without load"
        yield Problem("implausible.deadband-uncertain", why)
    if not errors[1] <= MAX_GAIN_ERROR:
        why = f"{name}: its speed is known only within {100 * errors[1]:.1f} %; repeat with warm oil"
        yield Problem("implausible.full-speed-uncertain", why)


def _pair_problems(name: str, full_speeds: tuple[float, float]) -> Iterator[Problem]:
    if not 1.0 / MAX_SIDE_RATIO <= full_speeds[0] / full_speeds[1] <= MAX_SIDE_RATIO:
        why = f"{name}: one side is over {MAX_SIDE_RATIO} times faster than the other; look for a throttle or a load"
        yield Problem("implausible.sides-differ", why)


def _turn_problems(fit: TurnFit, spec: JointSpec) -> Iterator[Problem]:
    for name, side, nominal in (
        ("rot plus", fit.plus, spec.valve.full_speed_plus),
        ("rot minus", fit.minus, spec.valve.full_speed_minus),
    ):
        errors = (side.errors[0], side.errors[1] / side.full_speed)
        yield from _side_problems(name, side.deadband, side.full_speed, errors, nominal, MAX_TURN_DEADBAND_ERROR)
        left = max(map(abs, side.left_rad))
        if not left <= MAX_TURN_RESIDUAL_RAD:
            why = f"{name}: its turns do not fit a valve, {degrees(left):.0f} deg are left; check the directions read"
            yield Problem("implausible.turn-residual", why)
    yield from _pair_problems("rot", (fit.plus.full_speed, fit.minus.full_speed))


def _joint_problems(r: JointResult, spec: JointSpec) -> Iterator[Problem]:
    name, valve = r.joint.name.lower(), r.valve
    for side, i in (("plus", 0), ("minus", 1)):
        nominal = spec.valve.full_speed_plus if i == 0 else spec.valve.full_speed_minus
        errors = (valve.errors[f"deadband_{side}"], valve.errors[f"speed_{side}"])
        side_values = (valve.deadbands[i], valve.full_speeds[i], errors, nominal)
        yield from _side_problems(f"{name} {side}", *side_values, MAX_DEADBAND_ERROR)
        if not abs(r.repeats[i]) <= MAX_REPEAT_DIFFERENCE:
            known = r.repeats[i] == r.repeats[i]
            off = f"differs by {100 * r.repeats[i]:.1f} % of the spool" if known else "cannot be told"
            why = f"{name} {side}: the dead-band of the wiggle {off}; look for a sticking spool"
            yield Problem("implausible.deadband-not-repeatable", why)
    if not 0.0 <= valve.hysteresis <= MAX_HYSTERESIS:
        why = f"{name}: a hysteresis of {100 * valve.hysteresis:.1f} % of the spool: look for dirt or missing dither"
        yield Problem("implausible.hysteresis", why)
    yield from _pair_problems(name, valve.full_speeds)
    if valve.residual > MAX_RESIDUAL_S * spec.speed_limit:
        why = f"{name}: the motion does not fit a valve (residual {valve.residual:.4f}); look for contact or play"
        yield Problem("implausible.motion-residual", why)
    yield from _delay_problems(name, r.delay)


def _delay_problems(name: str, delay: DelayFit | None) -> Iterator[Problem]:
    if delay is None:
        return
    yield from _outside(name, "dead time", delay.delay_s, DELAY_BOUNDS_S, 1e3, "ms")
    yield from _outside(name, "spool lag", delay.lag_s, LAG_BOUNDS_S, 1e3, "ms")
    apart = abs(delay.sides_s[0] - delay.sides_s[1])
    if not apart <= MAX_SIDE_DELAY_DIFFERENCE_S:
        why = f"{name}: the dead times of the two sides differ by {1e3 * apart:.0f} ms; check the bus load and repeat"
        yield Problem("implausible.dead-times-differ", why)
    if delay.residual > MAX_SPOOL_RESIDUAL:
        why = f"{name}: the reported spool does not follow its command like a spool; check the valve node"
        yield Problem("implausible.spool-residual", why)


def _grapple_problems(times_s: dict[GrappleCommand, float]) -> Iterator[Problem]:
    for command, seconds in times_s.items():
        yield from _outside("grapple", f"time to {command.name.lower()}", seconds, GRAPPLE_TIME_BOUNDS_S, 1.0, "s")


def _survey_problems(fit: SurveyFit) -> Iterator[Problem]:
    for j, offset, most in zip(OFFSETS, fit.offsets, MAX_OFFSET, strict=True):
        if not abs(offset) <= most:
            shown = f"{1e3 * offset:.0f} mm" if j is Joint.EXT else f"{degrees(offset):.1f} deg"
            why = f"{j.name.lower()}: its zero is {shown} off; check the encoder's mounting and the survey's frame"
            yield Problem("implausible.zero-offset", why)
    sag = fit.sag
    if not max(abs(sag.head_rad_m), abs(sag.pin_rad_m)) <= MAX_SAG_RAD_M:
        why = "the column leans more than any steel column does; check the survey's frame and its units"
        yield Problem("implausible.column-lean", why)
    if fit.moments_nm:
        if not 0.0 <= sag.load_rad_nm <= MAX_COMPLIANCE_RAD_NM:
            yield Problem(
                "implausible.column-compliance",
                f"the column would give {1e6 * sag.load_rad_nm:.2f} rad/MNm under a load; check the lift's pressure "
                "sensors, flow_plus and lever in the profile, and the survey's frame",
            )
        left = (sum(m * m for m in fit.moments_nm) / len(fit.moments_nm)) ** 0.5
        if not (left <= MAX_MOMENT_RESIDUAL_NM and sag.head_nm_m > 0.0 and sag.pin_nm_m > 0.0):
            why = f"the lift's pressures do not weigh a crane ({1e-3 * left:.1f} kNm are left); check PressA's sensors"
            yield Problem("implausible.moment-residual", why)
    after = (sum(d * d for d in fit.after_m) / len(fit.after_m)) ** 0.5
    if not (isfinite(after) and after <= MAX_SURVEY_RESIDUAL_M):
        why = f"the survey does not fit the crane: {1e3 * after:.0f} mm are left; check the surveyed points"
        yield Problem("implausible.survey-residual", why)
