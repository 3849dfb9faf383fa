"""The joint laws: six feedbacks, their common structure, end positioning, all joints together, and the valve map."""

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
from controller.laws.valve_map import LINEAR_SHARE, ValveMap
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


def test_feed_forward_leads_by_delay_lag_and_oil_and_the_change_per_second_is_limited():
    valve = msgspec.structs.replace(SLEW.valve, delay_s=0.08, lag_s=0.04, oil_s=0.13)
    assert made(spec=msgspec.structs.replace(SLEW, valve=valve)).lead_ns == pytest.approx(250_000_000, abs=1)
    law = made()
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
    damped, plain = made(damping_per_bar=1e-3), made(damping_per_bar=0.0)
    for k in range(400):
        yields, goes_on = (
            step(law, v_ref=0.1, lead=0.1, v=0.1, load=50.0 + 10.0 * (k == 399)) for law in (damped, plain)
        )
    assert yields < goes_on


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


def arrived(rest=None):
    """End positioning of a joint that has just come to its goal."""
    rest = rest or EndPositioning(SLEW)
    rest.reset()
    rest.follow()
    return rest


def settle(wrong, start, seconds=20.0, rest=None):
    """(final error, time of the last opening, number of openings) of a joint that rests ``start`` off its goal."""
    rest, oil = arrived(rest), Oil(wrong)
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
    """(seconds of the first opening, what is left when it would open again) of a joint that rests so far off."""
    arrived(rest)
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
    rest = arrived()
    for k in range(2000):
        error = 0.9 * SLEW.law.stop_band * math.sin(3.0 * k * T_S)
        assert rest.step(error, error, SLEW.law.kp_1_s * error, T_S) == 0.0
    assert rest.resting


def test_swinging_load_is_not_chased():
    rest, commands = arrived(), 0
    for k in range(4000):
        error = 0.0025 * math.sin(3.5 * k * T_S) * math.exp(-0.1 * k * T_S)
        commands += rest.step(error, error, SLEW.law.kp_1_s * error, T_S) != 0.0
    assert commands < 0.05 * 4000


def test_opening_of_a_stuck_valve_is_bounded():
    rest = arrived()
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
    rest, band = arrived(), SLEW.law.stop_band
    for k in range(600):
        error = band * (left + 1.5 * math.sin(2.0 * math.pi * k * T_S))
        if rest.step(error, error, 0.0, T_S):
            return k * T_S
    return math.inf


def test_only_a_joint_near_its_goal_must_settle_first():
    assert opened_s(8.0) < 0.5
    assert opened_s(1.5) > 1.0


# -- valve map: compensation of dead-band, metering curve, hysteresis and lever

PLAY, LEVER = SPECS[0].valve, SPECS[1].valve
NO_PLAY = msgspec.structs.replace(PLAY, hysteresis_pct=0.0)
CURVED = msgspec.structs.replace(NO_PLAY, exponent=1.3, deadband_plus_pct=9.0, deadband_minus_pct=14.0)


def metered(valve, u):
    """Share of the full speed of a valve of docs/reference/machines.md section 3 for a command."""
    deadband = (valve.deadband_plus_pct if u > 0 else valve.deadband_minus_pct) / 100.0
    half = valve.hysteresis_pct / 200.0
    return math.copysign((max(0.0, abs(u) - deadband) / (1.0 - half - deadband)) ** valve.exponent, u)


class Hysteresis:
    """The spool behind its command."""

    def __init__(self, valve, at=0.0):
        self.half, self.at = valve.hysteresis_pct / 200.0, at

    def step(self, u):
        self.at = max(u - self.half, min(u + self.half, self.at))
        return self.at


@pytest.mark.parametrize("valve", [NO_PLAY, CURVED])
@given(velocity=st.floats(-0.5, 0.5))
def test_map_is_the_inverse_of_the_valve(valve, velocity):
    u = ValveMap(valve).spool_pct(velocity) / 100.0
    if abs(velocity) > LINEAR_SHARE * 0.5:
        assert metered(valve, u) * 0.5 == pytest.approx(velocity, abs=1e-9)
    else:
        edge = ValveMap(valve).spool_pct(math.copysign(1.001 * LINEAR_SHARE * 0.5, velocity)) / 100.0
        assert abs(u) <= abs(edge)


@given(
    st.lists(st.floats(0.02, 0.45).flatmap(lambda v: st.sampled_from([v, -v])), min_size=2, max_size=8),
    st.floats(-0.01, 0.01),
)
def test_hysteresis_is_compensated_after_every_reversal(goals, at):
    """In sweeps between goals the spool is correct once a sweep is long enough to reverse the lead."""
    made, play, velocity = ValveMap(PLAY), Hysteresis(PLAY, at), 0.0
    for goal in goals:
        last = metered(PLAY, play.at)
        for k in range(1, 51):
            now = velocity + (goal - velocity) * k / 50.0
            spool = play.step(made.spool_pct(now) / 100.0)
        velocity = goal
        assert abs(made.spool_pct(goal)) <= 100.0
        if abs(goal - 0.5 * last) > 0.5 * 0.03:
            assert metered(PLAY, spool) * 0.5 == pytest.approx(goal, abs=1e-9)


def test_without_compensation_hysteresis_costs_speed():
    plain, play = ValveMap(NO_PLAY), Hysteresis(PLAY)
    rising = [metered(PLAY, play.step(plain.spool_pct(0.005 * k) / 100.0)) for k in range(81)][40]
    falling = [metered(PLAY, play.step(plain.spool_pct(0.4 - 0.005 * k) / 100.0)) for k in range(81)][40]
    assert 0.5 * (falling - rising) == pytest.approx(0.5 * 0.02 / 0.87, rel=0.02)


def test_flicker_does_not_reverse_the_lead_and_zero_is_zero():
    made = ValveMap(PLAY)
    for k in range(50):
        made.spool_pct(0.005 * k)
    still = made.spool_pct(0.25)
    assert still - 1.0 < made.spool_pct(0.25 - 0.0002) < still
    assert made.spool_pct(0.0) == 0.0 == made.spool_pct(-0.0)


@pytest.mark.parametrize("valve", [LEVER, CURVED, PLAY])
def test_map_is_monotonic_and_saturates(valve):
    made = ValveMap(valve)
    values = [made.spool_pct(v / 1000) for v in range(-600, 601)]
    assert values == sorted(values) and values[0] == -100.0 and values[-1] == 100.0
    assert made.spool_pct(0.0) == 0.0


def test_two_sides_differ():
    made = ValveMap(LEVER)
    assert made.spool_pct(0.12) > -made.spool_pct(-0.12)


def test_short_lever_makes_the_joint_faster():
    made = ValveMap(LEVER)
    made.set_position(LEVER.lever_at[-1] + 1.0)
    assert made.arm == LEVER.lever[-1]
    assert made.full_plus == pytest.approx(LEVER.full_speed_plus / LEVER.lever[-1])
    short = made.spool_pct(0.1)
    made.set_position(0.5 * (LEVER.lever_at[2] + LEVER.lever_at[3]))
    assert made.arm == pytest.approx(0.5 * (LEVER.lever[2] + LEVER.lever[3]))
    assert made.spool_pct(0.1) > short
    made.set_position(math.nan)
    assert made.arm == pytest.approx(0.5 * (LEVER.lever[2] + LEVER.lever[3]))
    made.set_position(-9.0)
    assert made.arm == LEVER.lever[0]


def test_joint_without_a_lever_is_the_same_everywhere():
    made = ValveMap(NO_PLAY)
    made.set_position(1.0)
    assert (made.arm, made.full_plus) == (1.0, NO_PLAY.full_speed_plus)
