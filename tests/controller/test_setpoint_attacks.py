"""Whatever sequence of accepted setpoints a planner sends, the reference and the joints keep their speed limits."""

import math
from itertools import pairwise

import pytest

from can_dbc.messages.crane import SpoolKnot, SpoolTest
from can_dbc.messages.datagrams import encode
from controller.crane.motion import BORNE_TOLERANCE_M
from controller.crane.reference_governor import GROWTH_FACTOR
from controller.laws.response import LEAST_SHARE, MOST_SHARE, UNKNOWN_GAIN, CommandBound
from machine.geometry.grapple import lowest_pin_m
from machine.geometry.kinematics import pin_position
from machine.joints import Joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, PROFILE, SPECS, Bench, T, settings_of, with_pump
from tests.controller.drive_bench import DriveBench
from tests.controller.setpoint_attacks import ATTACKS, Attacker

DT = T * 1e-9
WINDOW_TICKS = round(0.5 / DT)
SECONDS = 3.0
LOW = (0.0, 0.35, -1.4, 0.6, 0.0)
STILL = (0.0,) * 5
CASES = [
    *((kind, joints, 5) for kind in ATTACKS for joints in ((0,), (0, 1, 2, 3))),
    *(("rest ahead", (j,), every_ms) for j, every_ms in ((1, 5), (2, 10), (3, 20), (4, 40), (0, 40))),
    *(("lag, then go", (j,), 20) for j in (1, 2, 3, 4)),
]


def limited_pump(share):
    """The pump gives too little: the trajectory's time runs behind the planner's."""
    return Bench(settings_of(with_pump(share * PROFILE.hydraulics.pump_flow_m3_s)))


def attack(bench, kind, joints, every_ms, each_tick=1, seconds=SECONDS):
    """Attack an armed bench; returns references, positions and whether a setpoint was in force, one each tick."""
    attacker, rows = Attacker(PROFILE, joints), []
    crane, begun_ns = bench.controller.crane, bench.now_ns
    while bench.now_ns < begun_ns + seconds * 1e9 and bench.mode in (Mode.ARMED, Mode.ACTIVE):
        since_ns = bench.now_ns - begun_ns
        sent = []
        if since_ns % (every_ms * MS) < T:
            reference = list(bench.controller.reference_position)
            for k in range(each_tick):
                knots = attacker.knots(kind, reference, list(crane.governor.velocity), since_ns * 1e-9)
                sent.append(bench.setpoint(knots, stamp_ns=bench.now_ns - each_tick + 1 + k))
        bench.tick(sent)
        rows.append((list(bench.controller.reference_position), list(bench.q), crane.leased))
    return rows


def judge(rows):
    """Each tick's reference is within speed and growth, each window of 500 ms within 1.05 of the speed limit."""
    travelled = [0.0] * 5
    for j, spec in enumerate(SPECS):
        speed = 0.0
        for (before, _, was), (after, _, leased) in pairwise(rows):
            step = (after[j] - before[j]) / DT
            if not (was and leased):
                speed = 0.0
                continue
            assert abs(step) <= spec.speed_limit * (1.0 + 1e-9)
            grows = step * math.copysign(1.0, speed) - abs(speed) if step * speed >= 0.0 else abs(step)
            assert grows <= GROWTH_FACTOR * spec.acceleration_limit * DT + 1e-9
            speed = step
        for (_, before, _), (_, after, _) in zip(rows, rows[WINDOW_TICKS:], strict=False):
            travelled[j] = max(travelled[j], abs(after[j] - before[j]))
        assert travelled[j] <= 1.05 * spec.speed_limit * WINDOW_TICKS * DT, j
    return travelled


@pytest.mark.parametrize(("kind", "joints", "every_ms"), CASES)
def test_accepted_setpoints_drive_no_joint_beyond_its_speed_limit(kind, joints, every_ms):
    rows = attack(Bench().armed(), kind, joints, every_ms)
    travelled = judge(rows)
    assert sum(leased for *_, leased in rows) > 0.3 / DT, "the attack is accepted"
    assert any(travelled[j] > 0.02 * SPECS[j].speed_limit for j in joints), "and moves the crane"


def test_many_setpoints_in_a_tick_move_the_reference_no_further_than_one():
    rows = attack(Bench().armed(), "rest ahead", (0,), 5, each_tick=8)
    judge(rows)
    assert sum(leased for *_, leased in rows) > 1.0 / DT


def test_a_plan_that_jumps_away_from_a_late_reference_is_refused():
    """While the trajectory's time is behind, a setpoint continues the plan: it is compared with that, and with what
    the reference can still come to."""
    bench = limited_pump(0.4).armed()
    attack(bench, "field", (0, 1, 2, 3), 50, seconds=2.5)
    governor = bench.controller.crane.governor
    assert governor.behind_ns > 0 and bench.mode is Mode.ACTIVE
    attacker, furthest_s = Attacker(PROFILE, (0, 1, 2, 3)), 0.0
    for _ in range(40):
        planned, velocity = governor.planned(bench.now_ns)
        bench.tick([bench.setpoint(attacker.knots("field", list(planned), list(velocity), 0.0))])
        if bench.mode is not Mode.ACTIVE:
            break
        off = abs(governor.planned(bench.now_ns)[0][0] - governor.position[0])
        furthest_s = max(furthest_s, off / SPECS[0].speed_limit - 1.05 * governor.behind_ns * 1e-9)
    assert (bench.controller.gate.refusal, bench.controller.gate.detail) == (Reason.REFERENCE_JUMP, 0)
    assert furthest_s <= 0.1


def test_a_reference_off_its_trajectory_is_not_at_rest():
    bench = Bench().armed()
    bench.tick([bench.hold()])
    goal = list(bench.controller.reference_position)
    goal[0] += 0.09 * SPECS[0].speed_limit
    bench.tick([bench.setpoint([(0, goal, [0.0] * 5)], final=True)])
    governor = bench.controller.crane.governor
    assert not governor.at_rest(bench.now_ns) and bench.controller.crane.is_moving(bench.now_ns)
    for k in range(60):
        bench.tick([bench.setpoint([(0, goal, [0.0] * 5)], final=True)] if k % 10 == 0 else ())
    assert governor.at_rest(bench.now_ns) and governor.position == goal


# -- the command's bound

LIMIT = 0.4
REACTION_S = 0.1
WINDOW_S = 0.5


def fastest(gain, asked, stands_s=0.0, seconds=4.0):
    """The largest way of a joint within `WINDOW_S`, as a share of its limit's.

    It answers a command after `REACTION_S` with ``gain`` times it, and not at all for ``stands_s``.
    """
    bound, line, place = CommandBound(LIMIT, REACTION_S, DT), [0.0] * round(REACTION_S / DT), [0.0]
    for k in range(round(seconds / DT)):
        command = min(asked, bound.limit(asked)) if asked > 0.0 else max(asked, -bound.limit(asked))
        line.append(command)
        answer = gain * line.pop(0)
        place.append(place[-1] + (answer * DT if k * DT >= stands_s else 0.0))
        bound.add(command, place[-1], DT)
    n = round(WINDOW_S / DT)
    return max(abs(b - a) for a, b in zip(place, place[n:], strict=False)) / (WINDOW_S * LIMIT)


def drive(bound, asked, gain, seconds, late_s=0.0):
    """The speeds of a joint that answers what the bound lets through with ``gain`` times it, ``late_s`` too late."""
    line, place, speeds = [0.0] * round((REACTION_S + late_s) / DT), 0.0, []
    for _ in range(round(seconds / DT)):
        command = min(asked, bound.limit(asked))
        line.append(command)
        speeds.append(gain * line.pop(0))
        place += speeds[-1] * DT
        bound.add(command, place, DT)
    return speeds


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("stands_s", [0.0, 2.0], ids=["moves", "was held"])
def test_a_joint_comes_to_its_limit_whatever_is_asked(side, stands_s):
    share = fastest(1.0, side * 10.0 * LIMIT, stands_s)
    assert 0.99 < share <= 1.03


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_valve_that_gives_more_is_found_out_after_its_reaction(side):
    assert fastest(1.25, side * 10.0 * LIMIT) <= 1.0 + 0.3 * (REACTION_S + 0.05) / WINDOW_S


def test_a_weak_valve_gets_more_and_what_moves_within_its_limit_all_that_it_asks():
    assert fastest(0.92, 10.0 * LIMIT) > 0.99
    assert fastest(1.0, 0.99 * LIMIT) == pytest.approx(0.99)
    assert fastest(1.2, 0.8 * LIMIT) == pytest.approx(0.96)


def test_what_a_joint_gives_is_learned_for_each_direction_and_kept():
    bound = CommandBound(LIMIT, REACTION_S, DT)
    assert bound.limit(1.0) == bound.limit(-1.0) == pytest.approx(LIMIT / UNKNOWN_GAIN), "before it has moved"
    for gain, expected in ((1.3, 1.0 / 1.3), (1.0, 1.0), (0.8, MOST_SHARE)):
        drive(bound, 0.8 * LIMIT, gain, 4.0)
        bound.reset()
        assert bound.limit(1.0) == pytest.approx(expected * LIMIT, rel=0.01), gain
        assert bound.limit(-1.0) == pytest.approx(LIMIT / UNKNOWN_GAIN), "it has not gone that way"


@pytest.mark.parametrize(("share", "gain"), [(0.45, 1.3), (0.8, 0.5), (0.8, 0.0)], ids=["slow", "weak", "held"])
def test_a_slow_and_a_held_joint_teach_nothing(share, gain):
    bound = CommandBound(LIMIT, REACTION_S, DT)
    drive(bound, share * LIMIT, gain, 4.0)
    bound.reset()
    assert bound.limit(1.0) == pytest.approx(LIMIT / UNKNOWN_GAIN)


def test_a_joint_that_answers_later_than_known_does_not_go_to_and_fro():
    """An individual's lift went at 0.8 to 1.25 times its limit, until the guard stopped it."""
    bound = CommandBound(LIMIT, REACTION_S, DT)
    speeds = drive(bound, 10.0 * LIMIT, 1.2, 5.0, late_s=0.15)[-round(1.5 / DT) :]
    assert min(speeds) > 0.95 * LIMIT and max(speeds) < 1.03 * LIMIT


def test_a_pushed_joint_keeps_the_least_and_the_other_direction_is_free():
    bound = CommandBound(LIMIT, REACTION_S, DT)
    for k in range(100):
        bound.add(0.0, 3.0 * LIMIT * k * DT, DT)  # a load pushes it
    assert bound.limit(1.0) == LEAST_SHARE * LIMIT and bound.limit(-1.0) == pytest.approx(LIMIT / UNKNOWN_GAIN)
    bound.reset()
    bound.add(0.0, 7.0, DT)
    assert bound.limit(1.0) == pytest.approx(LIMIT / UNKNOWN_GAIN), "wherever it stands"


# -- One knot at rest, again and again, each a little farther: its velocity is 0, and yet it leads somewhere.


def creep(bench, j, step, ticks, every=1, sent=lambda k: ()):
    """The reference of a joint is led on by a step in every so many ticks, until the machine stops."""
    for k in range(ticks):
        reference = [x if x == x else 0.0 for x in bench.controller.reference_position]
        reference[j] = step(k, reference[j])
        bench.tick([*sent(k), *([bench.setpoint([(0, reference, STILL)])] if k % every == 0 else ())])
        if bench.mode is not Mode.ACTIVE:
            break


def test_small_steps_do_not_lead_into_the_ground():
    low_m, kin = lowest_pin_m(PROFILE), PROFILE.kinematics
    bench = Bench(home=LOW).armed()
    bench.tick([bench.hold()])
    creep(bench, Joint.LIFT, lambda _, q: max(q - 0.007, -0.38), 500, every=10)
    assert bench.controller.gate.refusal is Reason.BELOW_GROUND and pin_position(kin, bench.q)[2] > low_m - 0.02


def test_a_spool_test_ends_over_the_ground():
    low_m, kin = lowest_pin_m(PROFILE), PROFILE.kinematics
    bench = Bench(home=LOW).armed()
    bench.tick([bench.hold()])
    for k in range(1500):
        bench.setpoint_sequence += 1
        knots = tuple(SpoolKnot(i * 20 * MS, -20.0 if k or i > 8 else -12.0 - i) for i in range(16))
        test = SpoolTest(bench.setpoint_sequence, bench.settings.profile_hash, bench.now_ns, 200 * MS, 1, knots)
        bench.tick([encode(test)] if k % 10 == 0 else ())
        if bench.mode is Mode.STOP:
            break
    assert bench.reason is Reason.TEST_RANGE and low_m < pin_position(kin, bench.q)[2] < low_m + 0.05


def test_small_steps_do_not_turn_the_crane_of_a_machine_that_drives():
    bench = DriveBench().under_way(400)
    begun_rad = bench.q[0]

    def drives(k):
        return [bench.to(50.0, 0.0)] if k % 10 == 0 else ()

    creep(bench, Joint.SLEW, lambda k, q: q + min(1e-4 * (k + 1), 1.5e-3), 400, sent=drives)
    assert bench.controller.gate.refusal is Reason.CARRIER_MOVES and abs(bench.q[0] - begun_rad) < 0.02


def test_small_steps_do_not_reach_outward_with_too_much_load():
    bench = Bench().armed()
    bench.changed["GrappleStat"] = {"Load": 2000.0}
    for _ in range(30):
        bench.tick([bench.hold()])
    assert bench.reason is Reason.OVERLOADED
    begun_m = bench.q[3]
    creep(bench, Joint.EXT, lambda _, q: min(q + 0.0012, 1.7), 800)
    assert bench.q[3] - begun_m < BORNE_TOLERANCE_M + 0.02
