"""The joint laws: the six feedbacks, their common structure, end positioning, and all joints together."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.estimation.joint_estimator import JointEstimator
from controller.laws.crane import FLOW_SHARE, CraneLaw
from controller.laws.feedback import (
    ESTIMATING,
    ESTIMATING_SHARE,
    INTEGRAL_SHARE,
    LAWS,
    PLAIN_PERIOD_S,
    PLAIN_SHARE,
    REACHING_SHARE,
)
from controller.laws.joint import (
    ACCELERATION_FACTOR,
    INCH_SHARE,
    MAX_OPENING_SHARE,
    EndPositioning,
    JointLaw,
    VibrationFilter,
)
from controller.laws.response import GAIN_SPEED_SHARE, LEAST_GAIN, MOST_SHARE, DelayCompensation
from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS, Joint
from machine.profile import SPEED_HEADROOM_SHARE
from tests.controller.bench import SPECS, T, with_pump

SLEW = SPECS[0]
T_S = T * 1e-9
KINDS = tuple(LAWS)
SLIDING = ("sliding_mode", ESTIMATING, "super_twisting")


def spec_of(kind="pd", spec=SLEW, **law):
    return msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=kind, **law))


def made(kind="pd", spec=SLEW, **law):
    spec = spec_of(kind, spec, **law)
    return JointLaw(spec, ValveMap(spec.valve), T_S)


def budget(kind, law):
    """Greatest gain of a law over its budget."""
    shares = {"pd_plain": PLAIN_SHARE, ESTIMATING: 1.0 - REACHING_SHARE + ESTIMATING_SHARE}
    return law.kp_1_s * shares.get(kind, 1.0)


def step(law, q_ref=0.0, v_ref=0.0, lead=0.0, q=0.0, v=0.0, load=math.nan, elapsed_s=T_S, cap=1.0):
    law.desired_velocity(q_ref, v_ref, lead, q, v, load, elapsed_s)
    return law.command(law.feasible_share(cap), elapsed_s)


@pytest.mark.parametrize("kind", KINDS)
def test_gain_is_the_budget_at_most(kind):
    law = spec_of(kind, kd=0.0).law
    small, large = 1e-4 * law.layer, 100.0 * law.layer
    gain = budget(kind, law)
    once = LAWS[kind](law).step(small, 0.0, 0.0, True)
    assert 0.0 < once <= gain * small * (1 + 1e-9)
    if kind != "super_twisting":  # whose gain falls with the error
        assert once == pytest.approx(gain * small, rel=1e-3)
    assert LAWS[kind](law).step(large, 0.0, 0.0, True) <= gain * large * (1 + 1e-9)
    at_layer = LAWS[kind](law).step(law.layer, 0.0, 0.0, True)
    share = {"sliding_mode": REACHING_SHARE, ESTIMATING: ESTIMATING_SHARE}.get(kind, 0.0)
    assert at_layer == pytest.approx((gain - law.kp_1_s * share * (1.0 - math.tanh(1.0))) * law.layer)


@pytest.mark.parametrize("kind", KINDS)
@given(error=st.floats(-1, 1), rate=st.floats(-1, 1))
def test_every_feedback_is_odd(kind, error, rate):
    law = spec_of(kind).law
    one, other = LAWS[kind](law), LAWS[kind](law)
    for _ in range(3):
        assert one.step(error, rate, T_S, False) == pytest.approx(-other.step(-error, -rate, T_S, False))


@pytest.mark.parametrize("kind", ["pid", *SLIDING])
def test_integrals_grow_freeze_and_reset(kind):
    law = spec_of(kind, kd=0.0).law
    feedback, error = LAWS[kind](law), 0.01 * spec_of(kind).law.layer
    first = feedback.step(error, 0.0, T_S, True)
    for _ in range(200):
        assert feedback.step(error, 0.0, T_S, True) == first
    for _ in range(200):
        grown = feedback.step(error, 0.0, T_S, False)
    assert grown - first == pytest.approx(INTEGRAL_SHARE * law.kp_1_s**2 * error, rel=0.02)
    feedback.reset()
    assert feedback.step(error, 0.0, T_S, True) == first


@pytest.mark.parametrize("kind", SLIDING)
def test_integrals_of_the_sliding_laws_are_bounded(kind):
    law = spec_of(kind).law
    feedback = LAWS[kind](law)
    for _ in range(200_000):
        out = feedback.step(law.layer, 0.0, 0.05, False)
    assert out <= 2.0 * law.kp_1_s * law.layer


def test_feed_forward_leads_and_the_change_per_second_is_limited():
    law = made()
    assert law.lead_ns == round((SLEW.valve.delay_s + SLEW.valve.lag_s) * 1e9)
    assert step(law, lead=0.2) == pytest.approx(ACCELERATION_FACTOR * SLEW.acceleration_limit * T_S)
    for _ in range(300):
        command = step(law, v_ref=0.2, lead=0.2, v=0.2)
    assert command == pytest.approx(0.2)


def test_paper_as_pd_has_no_lead_and_holds_its_command_for_a_cycle_of_the_plc():
    assert step(made("pd_plain"), v_ref=0.0, lead=0.2, v=0.0) == 0.0
    law = LAWS["pd_plain"](spec_of("pd_plain", kd=0.0).law)
    given = [law.step(1e-3 * k, 0.0, T_S, False) for k in range(1, 9)]
    cycle = round(PLAIN_PERIOD_S / T_S)
    assert given == [given[0]] * cycle + [given[cycle]] * cycle
    assert given[cycle] == pytest.approx((cycle + 1) * given[0])


class Followed:
    """A joint whose valve gives a share of what is commanded, a reaction time later, under its law at half speed."""

    def __init__(self, kind, share, stuck_after_s=math.inf):
        self.law, self.share, self.stuck_after_s = made(kind), share, stuck_after_s
        self.reaction = [0.0] * round((SLEW.valve.delay_s + SLEW.valve.lag_s) / T_S)
        self.q = self.q_ref = self.time_s = self.greatest = 0.0

    def drive(self, seconds, speed):
        """The errors [rad] while the reference moves at a speed [rad/s]."""
        errors = []
        for _ in range(round(seconds / T_S)):
            command = step(self.law, self.q_ref, speed, speed, self.q, speed)
            self.reaction.append(command)
            self.greatest = max(self.greatest, command)
            moves = self.time_s < self.stuck_after_s
            self.q += self.share * self.reaction.pop(0) * T_S * moves
            self.q_ref += speed * T_S
            self.time_s += T_S
            errors.append(self.q_ref - self.q)
        return errors


@pytest.mark.parametrize("share", [0.7, 1.3])
def test_the_estimating_law_learns_what_the_valve_gives_and_keeps_it(share):
    speed = 0.5 * SLEW.speed_limit
    trailing = abs(Followed("pd", share).drive(6.0, speed)[-1])
    joint = Followed(ESTIMATING, share)
    first = joint.drive(6.0, speed)
    assert abs(first[-1]) < 0.1 * trailing
    assert joint.law._gain.of(speed) == pytest.approx(share, rel=0.03)
    joint.law.reset()
    assert joint.law._gain.of(speed) == pytest.approx(share, rel=0.03), "a stop does not change the valve"
    assert joint.law._gain.of(-speed) == 1.0, "the other direction is another edge of the spool"


@pytest.mark.parametrize(("share", "most"), [(1.3, MOST_SHARE / 1.3), (0.7, MOST_SHARE)])
def test_a_valve_that_gives_more_is_commanded_less_at_the_speed_limit_and_one_that_gives_less_no_more(share, most):
    joint = Followed(ESTIMATING, share)
    joint.q = joint.q_ref = 0.9 * SLEW.lower
    joint.drive(3.0, 0.5 * SLEW.speed_limit)
    joint.q_ref += 1.0  # far behind its reference: the law asks for all that it may
    joint.drive(1.0, SLEW.speed_limit)
    assert joint.greatest <= 1.01 * most * SLEW.speed_limit


def test_an_estimate_stays_within_what_calibration_temperature_and_load_leave():
    joint = Followed(ESTIMATING, 1.0, stuck_after_s=3.0)
    joint.drive(6.0, 0.5 * SLEW.speed_limit)
    assert joint.law._gain.of(1.0) == LEAST_GAIN
    joint = Followed(ESTIMATING, 1.0)
    joint.drive(3.0, 0.5 * GAIN_SPEED_SHARE * SLEW.speed_limit)
    assert joint.law._gain.of(1.0) == 1.0, "a slow joint says little about its valve"


def test_travel_in_flight_is_not_commanded_again():
    law, error = made("pd", kp_1_s=2.0, kd=0.0), 0.05
    ticks = round((SLEW.valve.delay_s + SLEW.valve.lag_s) / T_S)
    commands = [step(law, error, 0.01, 0.01) - 0.01 for _ in range(ticks)]
    assert max(commands) == pytest.approx(2.0 * error, rel=0.1)
    asked = sum(commands) * T_S
    assert commands[-1] == pytest.approx(2.0 * (error - asked), rel=0.05), "travel in flight counts as done"


def test_in_flight_is_the_travel_of_the_last_delay():
    flight = DelayCompensation(5 * T_S, T_S)
    for k in range(1, 9):
        flight.add(float(k))
    assert flight.travel == 4 + 5 + 6 + 7 + 8
    flight.reset()
    assert flight.travel == 0.0


def test_vibration_has_no_mean_and_is_zero_for_an_unknown_pressure():
    vibration = VibrationFilter()
    assert vibration.step(90.0, T_S) == 0.0
    for _ in range(4000):
        steady = vibration.step(120.0, T_S)
    assert abs(steady) < 0.01
    swing = [vibration.step(120.0 + 10.0 * math.sin(9.0 * k * T_S), T_S) for k in range(2000)]
    assert 7.0 < max(swing[1000:]) < 11.0
    assert vibration.step(math.nan, T_S) == 0.0
    assert vibration.step(50.0, T_S) == 0.0, "the filter restarts"


def test_joint_yields_to_a_vibration_of_its_load():
    law = made(damping_per_bar=1e-3)
    for k in range(400):
        command = step(law, v_ref=0.1, lead=0.1, q=0.0, v=0.1, load=50.0 if k < 399 else 60.0, elapsed_s=T_S)
    before = made(damping_per_bar=0.0)
    for _ in range(400):
        plain = step(before, v_ref=0.1, lead=0.1, q=0.0, v=0.1, load=50.0, elapsed_s=T_S)
    assert command < plain


@pytest.mark.parametrize("kind", KINDS)
@given(st.floats(-4, 4), st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(-2, 2), st.floats(-300, 300))
def test_law_never_exceeds_its_cap_and_never_drives_out_of_the_range(kind, q_ref, v_ref, lead, q, v, load):
    for cap in (1.0, 0.5):
        law = made(kind)
        for _ in range(2):
            command = step(law, q_ref, v_ref, lead, q, v, load, 10.0, cap)
        assert abs(command) <= min(SPEED_HEADROOM_SHARE * SLEW.speed_limit * cap, 0.5) + 1e-12
        assert not (q > SLEW.upper and command > 0.0)
        assert not (q < SLEW.lower and command < 0.0)


def test_joint_without_an_encoder_is_driven_by_feed_forward():
    law = JointLaw(msgspec.structs.replace(SLEW, encoder=None), ValveMap(SLEW.valve), T_S)
    assert step(law, q_ref=1.0, lead=0.001, q=math.nan, v=math.nan) == pytest.approx(0.001)
    assert not law.resting


# -- rest


class Oil:
    """A joint on soft oil: dead time, a dead-band that is ``wrong`` [share of the full speed], a slow lag."""

    def __init__(self, wrong=0.0, delay_s=0.12, lag_s=0.15):
        self.q = self.x = 0.0
        self.wrong, self.lag_s = wrong, lag_s
        self.line = [0.0] * round(delay_s / T_S)
        self.full = SLEW.valve.full_speed_plus

    def move(self, command):
        self.line.append(command)
        metered = self.line.pop(0)
        if metered:
            metered = math.copysign(max(0.0, abs(metered) + self.wrong * self.full), metered)
        self.x += metered * T_S
        self.q += (self.x - self.q) * T_S / self.lag_s


def settle(wrong, start, seconds=20.0, rest=None):
    """(final error, time of the last opening, number of openings) of a joint that rests ``start`` off its goal."""
    rest, oil = rest or EndPositioning(SLEW), Oil(wrong)
    rest.reset()
    rest.follow()
    last_s, openings, before = 0.0, 0, 0.0
    for k in range(int(seconds / T_S)):
        error = start - oil.q
        command = rest.step(error, error, SLEW.law.kp_1_s * error, T_S)
        openings += command != 0.0 and before == 0.0
        last_s = k * T_S if command else last_s
        before = command
        oil.move(command)
    return start - oil.q, last_s, openings


@pytest.mark.parametrize("wrong", [0.0, 0.02, -0.01, 0.06, -0.06])
@pytest.mark.parametrize("start", [0.002, -0.006, 0.011, 0.04, -0.12])
def test_joint_rests_near_its_goal_for_any_dead_band(wrong, start):
    error, last_s, openings = settle(wrong, start)
    assert abs(error) <= 2.0 * SLEW.law.stop_band
    assert last_s < 16.0 and openings <= 8


def test_learning_shortens_the_next_stop():
    rest = EndPositioning(SLEW)
    first = settle(-0.04, 0.01, rest=rest)
    second = settle(-0.04, 0.01, rest=rest)
    assert second[2] < first[2] and abs(second[0]) <= SLEW.law.stop_band


def first_inch(rest, way, oil):
    """(seconds for which the valve opens first, what is left when it would open again) of a joint that rests so far
    off.
    """
    rest.reset()
    rest.follow()
    open_s, shut_s = 0.0, 0.0
    while shut_s < 3.0:
        command = rest.step(way - oil.q, way - oil.q, 0.0, T_S)
        if shut_s and command:
            break
        open_s += T_S * (command != 0.0)
        shut_s += T_S * (open_s > 0.0 and command == 0.0)
        oil.move(command)
    return open_s, way - oil.q


def test_long_inch_ends_when_enough_travel_is_in_flight():
    _, left = first_inch(EndPositioning(SLEW), 0.01, Oil(wrong=INCH_SHARE))
    assert -0.006 < left < 0.0, "by time alone the inch would overshoot by nearly its length"


def test_short_inch_teaches_little():
    def next_inch_s(*earlier):
        rest = EndPositioning(SLEW)
        for way in earlier:
            first_inch(rest, way, Oil(wrong=INCH_SHARE))  # it goes twice as far
        return first_inch(rest, 0.01, Oil(wrong=-1.0))[0]

    assert next_inch_s(0.0015) > 0.7 * next_inch_s() > next_inch_s(0.006)


def test_valve_stays_shut_within_the_stop_band():
    rest = EndPositioning(SLEW)
    rest.follow()
    for k in range(2000):
        error = 0.9 * SLEW.law.stop_band * math.sin(3.0 * k * T_S)
        assert rest.step(error, error, SLEW.law.kp_1_s * error, T_S) == 0.0
    assert rest.resting


def test_swinging_load_is_not_chased():
    rest, commands = EndPositioning(SLEW), 0
    rest.follow()
    for k in range(4000):
        error = 0.0025 * math.sin(3.5 * k * T_S) * math.exp(-0.1 * k * T_S)
        commands += rest.step(error, error, SLEW.law.kp_1_s * error, T_S) != 0.0
    assert commands < 0.05 * 4000


def test_opening_of_a_stuck_valve_is_bounded():
    rest = EndPositioning(SLEW)
    rest.follow()
    widest = max(abs(rest.step(0.005, 0.005, 0.005, T_S)) for _ in range(20_000))
    assert widest <= MAX_OPENING_SHARE * SLEW.valve.full_speed_plus + 1e-12
    assert widest > INCH_SHARE * SLEW.valve.full_speed_plus


def test_moving_reference_returns_control_to_the_law():
    law = made()
    for _ in range(200):
        assert step(law) == 0.0
    assert law.resting
    assert step(law, v_ref=0.05, lead=0.05) > 0.0 and not law.resting


def test_reference_jump_uses_the_law_and_noise_is_ignored():
    law = made()
    for k in range(200):
        assert step(law, q_ref=0.4 * SLEW.law.stop_band * (-1) ** k) == 0.0
    assert law.resting
    far = 0.05
    for _ in range(20):
        command = step(law, q_ref=far)
    assert not law.resting and command == pytest.approx(SLEW.law.kp_1_s * far, rel=0.3)
    law.reset()
    assert step(law, q_ref=far, q=far) == 0.0 and law.resting, "the first reference is no jump"


# -- all joints


def crane(flow_m3_s=1.0):
    return CraneLaw(with_pump(flow_m3_s), T_S)


def standing(positions):
    """Estimators at rest."""
    out = [JointEstimator(spec, T_S) for spec in SPECS]
    for e, q in zip(out, positions, strict=True):
        e.predict(0)
        e.update(q, 0)
    return out


MIDDLE = [0.5 * (s.lower + s.upper) for s in SPECS]
UNKNOWN = [math.nan] * 5


def run(law, velocities, cap=1.0):
    law.step(MIDDLE, velocities, velocities, standing(MIDDLE), UNKNOWN, cap, 10.0)
    return law.commands


def test_limit_of_one_joint_scales_all_joints():
    wanted = [0.2, 0.05, -0.1, 0.1, 0.3]
    free, slow = list(run(crane(), wanted)), run(crane(), wanted, cap=0.1)
    shares = [s / f for s, f in zip(slow, free, strict=True)]
    assert max(shares) < 1.0 and shares == pytest.approx([shares[0]] * 5)


def test_joints_stay_within_the_pump_flow():
    wanted, limit = [0.2, 0.1, -0.2, 0.2, 0.3], 4.0e-4
    law = crane(limit)
    commands = run(law, wanted)
    flow = sum(
        (c * s.valve.flow_plus if c >= 0 else -c * s.valve.flow_minus) * v.arm
        for c, s, v in zip(commands, SPECS, law.valves, strict=True)
    )
    assert flow == pytest.approx(FLOW_SHARE * limit, rel=1e-6)
    free = run(crane(), wanted)
    assert [c / f for c, f in zip(commands, free, strict=True)] == pytest.approx([commands[0] / free[0]] * 5)


def test_load_pressure_counts_the_chambers_by_their_areas():
    law = crane()
    lift = SPECS[Joint.LIFT].valve
    expected = 90.0 - 20.0 * lift.flow_minus / lift.flow_plus
    assert law.load_pressure_bar(Joint.LIFT, 90.0, 20.0) == pytest.approx(expected)
    assert math.isnan(law.load_pressure_bar(Joint.LIFT, None, 20.0))
    assert math.isnan(law.load_pressure_bar(Joint.LIFT, 90.0, None))


def test_stop_fades_the_last_commands_and_reset_clears_them():
    law = crane()
    before = list(run(law, [0.1] * 5))
    law.fade(0.5)
    assert law.commands == pytest.approx([0.5 * b for b in before])
    law.reset()
    assert law.commands == [0.0] * len(JOINTS)


def opened_s(left: float) -> float:
    """Time of the first opening for a joint that arrived some stop bands away and swings by one and a half."""
    rest, band = EndPositioning(SLEW), SLEW.law.stop_band
    rest.follow()
    for k in range(600):
        error = band * (left + 1.5 * math.sin(2.0 * math.pi * k * 0.005))
        if rest.step(error, error, 0.0, 0.005):
            return k * 0.005
    return math.inf


def test_only_a_joint_near_its_goal_must_settle_first():
    assert opened_s(8.0) < 0.5
    assert opened_s(1.5) > 1.0


def test_feed_forward_leads_by_delay_lag_and_oil():
    valve = msgspec.structs.replace(SLEW.valve, delay_s=0.08, lag_s=0.04, oil_s=0.13)
    spec = msgspec.structs.replace(SLEW, valve=valve)
    assert JointLaw(spec, ValveMap(valve), 0.005).lead_ns == pytest.approx(250_000_000, abs=1)
