"""The joint laws: the four feedbacks, the shell around them, rest, and all joints together."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.estimation.joint_estimator import JointEstimator
from controller.laws.crane import FLOW_SHARE, CraneLaw
from controller.laws.end_positioning import INCH_SHARE, MAX_OPENING_SHARE, EndPositioning
from controller.laws.feedback import INTEGRAL_SHARE, LAWS, PID_SHARE
from controller.laws.joint import ACCELERATION_FACTOR, DelayCompensation, JointLaw, VibrationFilter
from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS, Joint
from machine.motion_limits import SPEED_HEADROOM_SHARE
from tests.controller.bench import PROFILE, SPECS, T

SLEW = SPECS[0]
T_S = T * 1e-9
KINDS = tuple(LAWS)


def spec_of(kind="pd", spec=SLEW, **law):
    return msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=kind, **law))


def made(kind="pd", spec=SLEW, **law):
    spec = spec_of(kind, spec, **law)
    return JointLaw(spec, ValveMap(spec.valve), T_S)


def budget(kind, law):
    """The gain that a law may spend."""
    return law.kp_1_s * (PID_SHARE if kind == "pid" else 1.0)


def step(law, q_ref=0.0, v_ref=0.0, lead=0.0, q=0.0, v=0.0, load=math.nan, elapsed_s=T_S, cap=1.0):
    law.desired_velocity(q_ref, v_ref, lead, q, v, load, elapsed_s)
    return law.command(law.feasible_share(cap), elapsed_s)


@pytest.mark.parametrize("kind", KINDS)
def test_a_small_error_gets_the_budget_and_a_large_one_no_more(kind):
    law = spec_of(kind, kd=0.0).law
    small, large = 1e-4 * law.layer, 100.0 * law.layer
    gain = budget(kind, law)
    once = LAWS[kind](law).step(small, 0.0, 0.0, True)
    assert 0.0 < once <= gain * small * (1 + 1e-9)
    if kind != "super_twisting":  # whose gain falls with the error
        assert once == pytest.approx(gain * small, rel=1e-3)
    assert LAWS[kind](law).step(large, 0.0, 0.0, True) <= gain * large * (1 + 1e-9)
    at_layer = LAWS[kind](law).step(law.layer, 0.0, 0.0, True)
    assert at_layer == pytest.approx(gain * law.layer * (0.5 + 0.5 * math.tanh(1)) if kind == "sliding_mode"
                                     else gain * law.layer)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@given(error=st.floats(-1, 1), rate=st.floats(-1, 1))
def test_every_feedback_is_odd(kind, error, rate):
    law = spec_of(kind).law
    one, other = LAWS[kind](law), LAWS[kind](law)
    for _ in range(3):
        assert one.step(error, rate, T_S, False) == pytest.approx(-other.step(-error, -rate, T_S, False))


@pytest.mark.parametrize("kind", KINDS[1:])
def test_integrals_grow_with_the_error_stand_while_frozen_and_are_forgotten(kind):
    law = spec_of(kind, kd=0.0).law
    feedback, error = LAWS[kind](law), 0.01 * spec_of(kind).law.layer
    first = feedback.step(error, 0.0, T_S, True)
    for _ in range(200):
        assert feedback.step(error, 0.0, T_S, True) == first
    for _ in range(200):
        grown = feedback.step(error, 0.0, T_S, False)
    assert grown - first == pytest.approx(INTEGRAL_SHARE * budget(kind, law) ** 2 * error, rel=0.02)
    feedback.reset()
    assert feedback.step(error, 0.0, T_S, True) == first


@pytest.mark.parametrize("kind", KINDS[2:])
def test_integrals_of_the_sliding_laws_are_bounded(kind):
    law = spec_of(kind).law
    feedback = LAWS[kind](law)
    for _ in range(200_000):
        out = feedback.step(law.layer, 0.0, 0.05, False)
    assert out <= 2.0 * law.kp_1_s * law.layer


def test_the_feed_forward_leads_and_the_change_per_second_is_limited():
    law = made()
    assert law.lead_ns == round((SLEW.valve.delay_s + SLEW.valve.lag_s) * 1e9)
    assert step(law, lead=0.2) == pytest.approx(ACCELERATION_FACTOR * SLEW.acceleration_limit * T_S)
    for _ in range(300):
        command = step(law, v_ref=0.2, lead=0.2, v=0.2)
    assert command == pytest.approx(0.2)


def test_the_plain_pid_has_no_feed_forward():
    assert step(made("pid"), v_ref=0.2, lead=0.2, v=0.2) == 0.0


def test_what_is_in_flight_is_not_commanded_again():
    law, error = made("pd", kp_1_s=2.0, kd=0.0), 0.05
    ticks = round((SLEW.valve.delay_s + SLEW.valve.lag_s) / T_S)
    commands = [step(law, error, 0.01, 0.01) - 0.01 for _ in range(ticks)]
    assert max(commands) == pytest.approx(2.0 * error, rel=0.1)
    asked = sum(commands) * T_S
    assert commands[-1] == pytest.approx(2.0 * (error - asked), rel=0.05), "what is under way counts as done"


def test_in_flight_is_the_travel_of_the_last_delay():
    flight = DelayCompensation(5 * T_S, T_S)
    for k in range(1, 9):
        flight.add(float(k))
    assert flight.travel == 4 + 5 + 6 + 7 + 8
    flight.reset()
    assert flight.travel == 0.0


def test_a_vibration_has_no_mean_and_an_unknown_pressure_is_none():
    vibration = VibrationFilter()
    assert vibration.step(90.0, T_S) == 0.0
    for _ in range(4000):
        steady = vibration.step(120.0, T_S)
    assert abs(steady) < 0.01
    swing = [vibration.step(120.0 + 10.0 * math.sin(9.0 * k * T_S), T_S) for k in range(2000)]
    assert 7.0 < max(swing[1000:]) < 11.0
    assert vibration.step(math.nan, T_S) == 0.0
    assert vibration.step(50.0, T_S) == 0.0, "it begins anew"


def test_the_joint_gives_way_to_a_vibration_of_its_load():
    law = made(damping_per_bar=1e-3)
    for k in range(400):
        command = step(law, v_ref=0.1, lead=0.1, q=0.0, v=0.1, load=50.0 if k < 399 else 60.0, elapsed_s=T_S)
    before = made(damping_per_bar=0.0)
    for _ in range(400):
        plain = step(before, v_ref=0.1, lead=0.1, q=0.0, v=0.1, load=50.0, elapsed_s=T_S)
    assert command < plain


@pytest.mark.parametrize("kind", KINDS)
@given(st.floats(-4, 4), st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4), st.floats(-2, 2), st.floats(-300, 300))
def test_a_law_never_exceeds_its_cap_and_never_drives_out_of_the_range(kind, q_ref, v_ref, lead, q, v, load):
    for cap in (1.0, 0.5):
        law = made(kind)
        for _ in range(2):
            command = step(law, q_ref, v_ref, lead, q, v, load, 10.0, cap)
        assert abs(command) <= min(SPEED_HEADROOM_SHARE * SLEW.speed_limit * cap, 0.5) + 1e-12
        assert not (q > SLEW.upper and command > 0.0)
        assert not (q < SLEW.lower and command < 0.0)


def test_a_joint_without_an_encoder_is_driven_by_its_reference_alone():
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
    """(error at the end, when the valve opened last, how often it opened) of a joint that rests ``start`` off."""
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
def test_a_joint_comes_to_rest_near_its_goal_whatever_its_dead_band(wrong, start):
    error, last_s, openings = settle(wrong, start)
    assert abs(error) <= 2.0 * SLEW.law.stop_band
    assert last_s < 16.0 and openings <= 8


def test_what_is_learned_makes_the_next_stop_shorter():
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


def test_a_long_inch_of_a_valve_that_gives_more_than_is_known_ends_when_enough_is_under_way():
    _, left = first_inch(EndPositioning(SLEW), 0.01, Oil(wrong=INCH_SHARE))
    assert -0.006 < left < 0.0, "by the clock alone it would go nearly as far beyond as it came from"


def test_a_short_inch_that_a_swinging_load_may_have_moved_teaches_little():
    def next_inch_s(*earlier):
        rest = EndPositioning(SLEW)
        for way in earlier:
            first_inch(rest, way, Oil(wrong=INCH_SHARE))  # it goes twice as far
        return first_inch(rest, 0.01, Oil(wrong=-1.0))[0]

    assert next_inch_s(0.0015) > 0.7 * next_inch_s() > next_inch_s(0.006)


def test_within_the_stop_band_nothing_happens():
    rest = EndPositioning(SLEW)
    rest.follow()
    for k in range(2000):
        error = 0.9 * SLEW.law.stop_band * math.sin(3.0 * k * T_S)
        assert rest.step(error, error, SLEW.law.kp_1_s * error, T_S) == 0.0
    assert rest.resting


def test_a_load_that_swings_on_the_oil_is_not_chased():
    rest, commands = EndPositioning(SLEW), 0
    rest.follow()
    for k in range(4000):
        error = 0.0025 * math.sin(3.5 * k * T_S) * math.exp(-0.1 * k * T_S)
        commands += rest.step(error, error, SLEW.law.kp_1_s * error, T_S) != 0.0
    assert commands < 0.05 * 4000


def test_a_stuck_valve_is_not_opened_ever_further():
    rest = EndPositioning(SLEW)
    rest.follow()
    widest = max(abs(rest.step(0.005, 0.005, 0.005, T_S)) for _ in range(20_000))
    assert widest <= MAX_OPENING_SHARE * SLEW.valve.full_speed_plus + 1e-12
    assert widest > INCH_SHARE * SLEW.valve.full_speed_plus


def test_a_moving_reference_takes_the_joint_back():
    law = made()
    for _ in range(200):
        assert step(law) == 0.0
    assert law.resting
    assert step(law, v_ref=0.05, lead=0.05) > 0.0 and not law.resting


def test_a_reference_that_jumps_is_for_the_law_and_one_that_trembles_for_nobody():
    law = made()
    for k in range(200):
        assert step(law, q_ref=0.4 * SLEW.law.stop_band * (-1) ** k) == 0.0
    assert law.resting
    far = 0.05
    for _ in range(20):
        command = step(law, q_ref=far)
    assert not law.resting and command == pytest.approx(SLEW.law.kp_1_s * far, rel=0.3)
    law.reset()
    assert step(law, q_ref=far, q=far) == 0.0 and law.resting, "where it stands when it starts is no jump"


# -- all joints


def crane(flow_m3_s=1.0):
    hydraulics = msgspec.structs.replace(PROFILE.hydraulics, pump_flow_m3_s=flow_m3_s)
    return CraneLaw(msgspec.structs.replace(PROFILE, hydraulics=hydraulics), T_S)


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


def test_one_joint_at_its_limit_slows_all_by_the_same_share():
    wanted = [0.2, 0.05, -0.1, 0.1, 0.3]
    free, slow = list(run(crane(), wanted)), run(crane(), wanted, cap=0.1)
    shares = [s / f for s, f in zip(slow, free, strict=True)]
    assert max(shares) < 1.0 and shares == pytest.approx([shares[0]] * 5)


def test_the_joints_ask_for_no_more_flow_than_the_pump_gives():
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
    assert law.load_pressure_bar(Joint.LIFT, 90.0, 20.0) == pytest.approx(90.0 - 20.0 * lift.flow_minus / lift.flow_plus)
    assert math.isnan(law.load_pressure_bar(Joint.LIFT, None, 20.0)) and math.isnan(law.load_pressure_bar(Joint.LIFT, 90.0, None))


def test_a_stop_lets_the_last_commands_fade_and_a_reset_forgets_them():
    law = crane()
    before = list(run(law, [0.1] * 5))
    law.fade(0.5)
    assert law.commands == pytest.approx([0.5 * b for b in before])
    law.reset()
    assert law.commands == [0.0] * len(JOINTS)


def opened_s(left: float) -> float:
    """When the valve first opens for a joint that arrived so many stop bands away and swings by one and a half."""
    rest, band = EndPositioning(SLEW), SLEW.law.stop_band
    rest.follow()
    for k in range(600):
        error = band * (left + 1.5 * math.sin(2.0 * math.pi * k * 0.005))
        if rest.step(error, error, 0.0, 0.005):
            return k * 0.005
    return math.inf


def test_a_joint_that_arrives_far_off_is_not_waited_for_but_one_that_is_near_is():
    assert opened_s(8.0) < 0.5
    assert opened_s(1.5) > 1.0


def test_the_feed_forward_looks_ahead_by_what_spool_pump_and_oil_take():
    valve = msgspec.structs.replace(SLEW.valve, delay_s=0.08, lag_s=0.04, oil_s=0.13)
    spec = msgspec.structs.replace(SLEW, valve=valve)
    assert JointLaw(spec, ValveMap(valve), 0.005).lead_ns == pytest.approx(250_000_000, abs=1)
