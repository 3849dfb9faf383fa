"""Load, reach and slope against what the machine bears: outward and up is refused, down and inward is not."""

import math

import msgspec
import pytest

from controller.config import Settings
from controller.crane.load_moment import CONFIRMATIONS, LoadMoment
from machine.geometry.kinematics import max_reach_m
from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Stability
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import HOME, MS, PROFILE, Bench, T, count_until

AORO = load_profile("aoro_fc8")
STRAIGHT = (0.0, 0.0, -0.1, 2.4, 0.0)
STILL = [0.0] * 5


def judge(profile, q, load_kg, roll=0.0, pitch=0.0, times=CONFIRMATIONS):
    moment = LoadMoment(profile, profile.stability)
    for _ in range(times):
        moment.update(q, load_kg, roll, pitch)
    return moment.overloaded


def test_moment_is_that_of_three_weights_about_the_edge():
    of, q = AORO.stability, (0.4, 0.3, -1.0, 1.0, 0.0)
    head_m, pin_m, _ = distances(AORO.kinematics, q)
    wanted = GRAVITY_M_S2 * ((of.pin_kg + 200.0) * (pin_m - of.edge_m) + of.head_kg * (head_m - of.edge_m))
    found = LoadMoment(AORO, of).moment_nm(q, 200.0, 0.0, 0.0)
    assert found == pytest.approx(wanted, rel=1e-12)
    assert LoadMoment(AORO, of).moment_nm(q, math.nan, 0.0, 0.0) < found, "an unknown load counts as none"
    assert math.isnan(LoadMoment(AORO, of).moment_nm((0.0, math.nan, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0))


@pytest.mark.parametrize(("slew", "roll", "pitch"), [
    (0.0, 0.0, 0.1),  # the boom looks backward: nose up is downhill
    (math.pi / 2, 0.1, 0.0),  # base y is the machine's right: right side down
    (-math.pi / 2, -0.1, 0.0),
])  # fmt: skip
def test_ground_that_falls_under_the_boom_adds_to_the_moment(slew, roll, pitch):
    q, of = (slew, *STRAIGHT[1:]), AORO.stability
    moment = LoadMoment(AORO, of)
    level = moment.moment_nm(q, 0.0, 0.0, 0.0)
    assert moment.moment_nm(q, 0.0, roll, pitch) == pytest.approx(level + 0.1 * of.slope_nm_rad)
    assert moment.moment_nm(q, 0.0, -roll, -pitch) == pytest.approx(level - 0.1 * of.slope_nm_rad)
    assert moment.moment_nm(q, 0.0, math.nan, pitch) == level, "without a sensor the ground counts as level"


@pytest.mark.parametrize(("profile", "bears_kg", "not_kg"), [(PROFILE, 250.0, 400.0), (AORO, 400.0, 700.0)])
def test_the_shipped_machines_bear_what_they_lift_at_full_reach_and_no_more(profile, bears_kg, not_kg):
    straight = (0.0, 0.0, profile.joints["tilt"].upper, profile.joints["ext"].upper, 0.0)
    assert distances(profile.kinematics, straight)[1] > 0.95 * max_reach_m(profile)
    assert not judge(profile, straight, bears_kg)
    assert judge(profile, straight, not_kg)
    assert not judge(profile, straight, not_kg, times=CONFIRMATIONS - 1), "one peak is no overload"


def test_overload_ends_below_the_limit_and_does_not_flicker():
    moment = LoadMoment(AORO, AORO.stability)
    limit_nm = AORO.stability.share * AORO.stability.stabilising_nm
    _, pin_m, _ = distances(AORO.kinematics, STRAIGHT)
    empty = moment.moment_nm(STRAIGHT, 0.0, 0.0, 0.0)
    limit_kg = (limit_nm - empty) / GRAVITY_M_S2 / (pin_m - AORO.stability.edge_m)
    seen = []
    for kg in (1.01, 1.01, 0.995, 1.005, 0.8, 1.01):
        moment.update(STRAIGHT, kg * limit_kg, 0.0, 0.0)
        seen.append(moment.overloaded)
    assert seen == [False, True, True, True, False, False]


def test_outward_and_up_raise_the_moment_and_inward_or_down_do_not():
    moment, q = LoadMoment(PROFILE, PROFILE.stability), list(HOME)
    for j, v, raised in [
        (Joint.EXT, 0.2, True), (Joint.EXT, -0.2, False), (Joint.TILT, 0.2, True),
        (Joint.LIFT, 0.15, True), (Joint.LIFT, -0.15, False), (Joint.SLEW, 0.3, False), (Joint.ROT, 1.0, False),
    ]:  # fmt: skip
        velocity = [0.0] * 5
        velocity[j] = v
        assert moment.raised_by_motion(q, velocity) is raised, (j, v)
    assert not moment.raised_by_motion(q, STILL)


def overloaded_bench():
    """A crane whose limit is just above the moment of 100 kg at its home."""
    moment = LoadMoment(PROFILE, PROFILE.stability).moment_nm(HOME, 100.0, 0.0, 0.0)
    stability = msgspec.structs.replace(PROFILE.stability, share=1.0, stabilising_nm=moment * 1.01)
    profile = msgspec.structs.replace(PROFILE, stability=stability)
    return Bench(Settings(profile, profile_hash(profile), profile.rate_hz))


def drive(bench, j, v, ticks):
    for k in range(ticks):
        bench.tick([bench.moving(j, v)] if k % 10 == 0 and bench.mode in (Mode.ARMED, Mode.ACTIVE) else ())


def test_a_crane_that_moves_outward_into_overload_holds_in_time():
    bench = overloaded_bench().armed()
    bench.changed["GrappleStat"] = {"Load": 100.0}
    bench.tick([bench.hold()])
    drive(bench, Joint.EXT, -0.02, 40)
    assert bench.mode is Mode.ACTIVE
    drive(bench, Joint.EXT, 0.02, 20)
    assert bench.mode is Mode.ACTIVE
    bench.changed["GrappleStat"] = {"Load": 140.0}
    planned = (bench.moving(Joint.EXT, 0.02) if k % 10 == 9 else b"" for k in range(100))
    k = count_until(lambda: bench.tick([d for d in [next(planned)] if d]), lambda: bench.mode is not Mode.ACTIVE)
    assert bench.reason == Reason.OVERLOAD and bench.mode is Mode.STOP
    frame_ms = 20
    assert k * T <= (FAULTS[Reason.OVERLOAD].bound_ms + frame_ms) * MS


def test_overloaded_it_refuses_outward_and_accepts_inward():
    bench = overloaded_bench().armed()
    bench.changed["GrappleStat"] = {"Load": 140.0}
    bench.tick([bench.hold()])
    bench.run(30)
    assert bench.mode is Mode.ACTIVE, "holding a load that is too heavy moves nothing"
    start = list(bench.controller.reference_position)

    def to(j, by):
        end = list(start)
        end[j] += by
        before = bench.controller.gate.refused
        bench.tick([bench.setpoint([(0, start, STILL), (1500, end, STILL)])])
        return bench.controller.gate.refusal if bench.controller.gate.refused > before else Reason.NONE

    assert to(Joint.EXT, 0.1) is Reason.RAISES_MOMENT
    assert to(Joint.LIFT, 0.05) is Reason.RAISES_MOMENT
    assert to(Joint.EXT, -0.1) is Reason.NONE
    assert bench.mode is Mode.ACTIVE


def test_a_profile_without_the_section_judges_nothing():
    profile = msgspec.structs.replace(PROFILE, stability=None)
    bench = Bench(Settings(profile, profile_hash(profile), profile.rate_hz)).armed()
    bench.changed["GrappleStat"] = {"Load": 4000.0}
    bench.tick([bench.hold()])
    drive(bench, Joint.EXT, 0.02, 60)
    assert bench.mode is Mode.ACTIVE and bench.controller.crane.load_moment is None
    assert Stability is type(PROFILE.stability)
