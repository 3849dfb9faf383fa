"""Whatever sequence of accepted setpoints a planner sends, the reference and the joints keep their speed limits."""

import math
from itertools import pairwise

import msgspec
import pytest

from controller.config import Settings
from controller.crane.reference_governor import GROWTH_FACTOR
from controller.laws.command_bound import KNOWN_S, LEAST_SHARE, MOST_SHARE, UNKNOWN_SHARE, CommandBound
from machine.loading.profile_file import profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, PROFILE, SPECS, Bench, T
from tests.controller.setpoint_attacks import ATTACKS, Attacker

DT = T * 1e-9
WINDOW_TICKS = round(0.5 / DT)
SECONDS = 3.0
CASES = [
    *((kind, joints, 5) for kind in ATTACKS for joints in ((0,), (0, 1, 2, 3))),
    *(("rest ahead", (j,), every_ms) for j, every_ms in ((1, 5), (2, 10), (3, 20), (4, 40), (0, 40))),
    *(("lag, then go", (j,), 20) for j in (1, 2, 3, 4)),
]


def limited_pump(share):
    """The pump gives too little: the trajectory's time runs behind the planner's."""
    flow_m3_s = share * PROFILE.hydraulics.pump_flow_m3_s
    profile = msgspec.structs.replace(
        PROFILE, hydraulics=msgspec.structs.replace(PROFILE.hydraulics, pump_flow_m3_s=flow_m3_s)
    )
    return Bench(Settings(profile, profile_hash(profile), profile.rate_hz))


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


def answering(gain, seconds=2.0, command=0.36):
    """A bound of a joint that answers a command after 0.1 s."""
    made, line = CommandBound(LIMIT, 0.1, DT), [0.0] * round(0.1 / DT)
    for _ in range(round(seconds / DT)):
        line.append(command)
        made.add(command, gain * line.pop(0), DT)
    return made


def test_before_a_joint_has_answered_a_little_less_than_its_limit_is_commanded():
    for seconds in (0.0, KNOWN_S):
        assert answering(1.2, seconds).limit(1.0) == UNKNOWN_SHARE * LIMIT


@pytest.mark.parametrize(
    ("gain", "share"),
    [(1.0, 1.0), (1.1, 1 / 1.1), (1.5, LEAST_SHARE), (0.97, MOST_SHARE), (0.5, MOST_SHARE), (-1.0, MOST_SHARE)],
)  # fmt: skip
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_command_is_bounded_where_the_joint_reaches_its_limit(gain, share, side):
    made = answering(gain, command=side * 0.36)
    assert made.limit(side) == pytest.approx(share * LIMIT, rel=0.01)
    assert made.limit(-side) == UNKNOWN_SHARE * LIMIT
    made.reset()
    assert made.limit(side) == pytest.approx(share * LIMIT, rel=0.01), "a valve stays what it is"


def test_slow_and_unsteady_commands_tell_nothing():
    assert answering(2.0, command=0.4 * LIMIT).limit(1.0) == UNKNOWN_SHARE * LIMIT
    made = CommandBound(LIMIT, 0.1, DT)
    for k in range(600):
        made.add(LIMIT * (0.8 + 0.1 * math.sin(0.1 * k)), 2.0 * LIMIT, DT)
    assert made.limit(1.0) == UNKNOWN_SHARE * LIMIT
