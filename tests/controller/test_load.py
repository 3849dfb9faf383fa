"""The load in the grapple: how heavy it is, whether it comes or goes, and whether the machine bears it."""

import dataclasses
import math

import msgspec
import pytest

from controller.crane.load import (
    CHANGE_KG,
    CHANGE_MEAN_S,
    CHANGE_REST_NS,
    CONFIRMATIONS,
    LoadChange,
    LoadEstimator,
    LoadMoment,
)
from controller.crane.motion import LOAD_PERIOD_NS
from machine.geometry.kinematics import max_reach_m
from machine.geometry.sag import GRAVITY_M_S2, distances
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Sag
from machine.sensing import MIN_LEVER_ARM_M, bearable_load_kg, empty_moment_nm, lever_share
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import HOME, MS, PROFILE, SETTINGS, Bench, T, count_until, settings_of

PERIOD_S = LOAD_PERIOD_NS * 1e-9


# -- Load moment

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


@pytest.mark.parametrize("falls_rad", [0.0, 0.1, -0.1])
def test_the_load_that_the_machine_bears_is_that_of_the_planner(falls_rad):
    q, of = (0.0, *STRAIGHT[1:]), AORO.stability
    bears_kg = bearable_load_kg(of, AORO.kinematics, q, falls_rad)
    moment = LoadMoment(AORO, of)
    assert moment.moment_nm(q, bears_kg, 0.0, falls_rad) == pytest.approx(moment.limit_nm)
    assert bearable_load_kg(msgspec.structs.replace(of, stabilising_nm=1.0), AORO.kinematics, q) == 0.0


@pytest.mark.parametrize(
    ("slew", "roll", "pitch"),
    [
        (0.0, 0.0, 0.1),  # the boom looks backward: nose up is downhill
        (math.pi / 2, 0.1, 0.0),  # base y is the machine's right: right side down
        (-math.pi / 2, -0.1, 0.0),
    ],
)
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
        (Joint.EXT, 0.2, True),
        (Joint.EXT, -0.2, False),
        (Joint.TILT, 0.2, True),
        (Joint.LIFT, 0.15, True),
        (Joint.LIFT, -0.15, False),
        (Joint.SLEW, 0.3, False),
        (Joint.ROT, 1.0, False),
    ]:
        velocity = [0.0] * 5
        velocity[j] = v
        assert moment.raised_by_motion(q, velocity) is raised, (j, v)
    assert not moment.raised_by_motion(q, STILL)


def overloaded_bench():
    """A crane whose limit is just above the moment of 100 kg at its home."""
    moment = LoadMoment(PROFILE, PROFILE.stability).moment_nm(HOME, 100.0, 0.0, 0.0)
    stability = msgspec.structs.replace(PROFILE.stability, share=1.0, stabilising_nm=moment * 1.01)
    profile = msgspec.structs.replace(PROFILE, stability=stability)
    return Bench(settings_of(profile))


def holds_after(bench):
    """Ticks until the overload holds a crane that goes on outward."""
    planned = (bench.moving(Joint.EXT, 0.02) if k % 10 == 9 else b"" for k in range(100))
    k = count_until(lambda: bench.tick([d for d in [next(planned)] if d]), lambda: bench.mode is not Mode.ACTIVE)
    assert bench.reason == Reason.OVERLOAD and bench.mode is Mode.STOP
    return k


def test_a_crane_that_moves_outward_into_overload_holds_in_time():
    bench = overloaded_bench().armed()
    bench.changed["GrappleStat"] = {"Load": 100.0}
    bench.tick([bench.hold()])
    assert bench.drive(Joint.EXT, -0.02, 40) is Mode.ACTIVE
    assert bench.drive(Joint.EXT, 0.02, 20) is Mode.ACTIVE
    bench.changed["GrappleStat"] = {"Load": 140.0}
    k = holds_after(bench)
    frame_ms = 20
    assert k * T <= (FAULTS[Reason.OVERLOAD].bound_ms + frame_ms) * MS


def test_overloaded_it_refuses_outward_and_accepts_inward():
    bench = overloaded_bench().armed()
    bench.changed["GrappleStat"] = {"Load": 140.0}
    bench.tick([bench.hold()])
    assert bench.run(30) is Mode.ACTIVE, "holding a load that is too heavy moves nothing"
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
    bench = Bench(settings_of(profile)).armed()
    bench.changed["GrappleStat"] = {"Load": 4000.0}
    bench.tick([bench.hold()])
    bench.drive(Joint.EXT, 0.02, 60)
    assert bench.mode is Mode.ACTIVE and bench.controller.crane.load_moment is None


FRAME_NS = 5 * MS
REACH = (0.0, 0.4, -1.0, 0.6, 0.0)


class Lift:
    """The pressures of a lift that holds a moment, as their frames come."""

    def __init__(self, profile=PROFILE, frame_ns=FRAME_NS):
        self.moment = LoadMoment(profile, profile.stability)
        self.moment.update(REACH, 0.0, 0.0, 0.0)
        valve = profile.joints["lift"].valve
        self._nm_per_bar = 1e5 * valve.flow_plus * lever_share(valve, REACH[Joint.LIFT])
        self._now_ns, self._frame_ns = 1_000_000_000, frame_ns

    def holds(self, share, seconds=0.0, rise=0.0):
        """For so long a share of the limit, and its rise per second; ends with the first judgement as overload."""
        limit_nm = self.moment.limit_nm
        for k in range(max(1, round(seconds * 1e9 / self._frame_ns))):
            self._now_ns += self._frame_ns
            now = share + rise * k * self._frame_ns * 1e-9
            self.moment.update_pressure(now * limit_nm / self._nm_per_bar, self._now_ns)
            if self.moment.overloaded:
                break
        return now


def test_the_pressures_tell_a_heavy_load_that_the_lift_holds():
    for share, heavy in ((1.09, False), (1.11, True)):  # the tipping line of this machine is its lift joint
        lift = Lift()
        lift.holds(share, 0.1)
        assert lift.moment.overloaded is heavy, share
    assert lift.moment.last_nm == pytest.approx(1.11 * lift.moment.limit_nm)


def test_a_load_that_appears_is_seen_before_the_machine_carries_too_much():
    lift = Lift()
    lift.holds(0.27, 0.1)
    assert lift.holds(0.27, 1.0, rise=4.2) < 0.85, "150 kNm/s, as 1500 kg press on the oil"
    assert lift.moment.overloaded and lift.moment.last_nm > lift.moment.limit_nm


@pytest.mark.parametrize("frame_ns", [FRAME_NS, 2 * FRAME_NS])
def test_ordinary_work_is_no_overload(frame_ns):
    lift = Lift(frame_ns=frame_ns)
    lift.holds(0.3, 0.1)
    assert lift.holds(0.3, 0.2, rise=1.2) > 0.5  # 40 kNm/s and 0.55 of the limit: the most of logs and calibrations
    assert not lift.moment.overloaded


@pytest.mark.parametrize("frame_ns", [1 * MS, 40 * MS])
def test_frames_too_near_or_far_apart_tell_no_rise(frame_ns):
    lift = Lift(frame_ns=frame_ns)
    for share in (0.3, 0.5, 0.7, 0.9, 1.05):
        lift.holds(share)
    assert not lift.moment.overloaded


def test_an_overload_by_the_pressures_lasts_until_the_swing_is_over():
    lift = Lift()
    lift.holds(1.2, 0.1)
    moment = lift.moment
    moment.update(REACH, 0.0, 0.0, 0.0)
    assert moment.overloaded, "an empty load cell does not end it"
    for share, seconds, overloaded in ((0.5, 0.4, True), (1.0, 0.6, True), (0.9, 0.1, False)):
        for _ in range(round(seconds / 0.005)):
            lift.holds(share)
        assert moment.overloaded is overloaded, share


def test_pressures_say_nothing_with_the_pin_at_the_column():
    lift = Lift()
    folded = (0.0, 0.5, PROFILE.joints["tilt"].lower, PROFILE.joints["ext"].lower, 0.0)
    assert distances(PROFILE.kinematics, folded)[1] - PROFILE.kinematics.a1_m < MIN_LEVER_ARM_M
    lift.moment.update(folded, 0.0, 0.0, 0.0)
    lift.holds(5.0, 0.1)
    assert not lift.moment.overloaded


def lifting_bench(v):
    """A bench that extends or retracts and lifts what is at the limit of its pressures from now on."""
    bench = Bench()
    bench.changed["PressA"] = {"LiftA": 45.0, "LiftB": 2.0}
    bench.armed().tick([bench.hold()])
    bench.drive(Joint.EXT, v, 40)
    assert bench.mode is Mode.ACTIVE and not bench.controller.supervisor.half_speed
    bench.changed["PressA"] = {"LiftA": 200.0, "LiftB": 2.0}
    return bench


def test_by_the_pressures_outward_motion_holds_in_time():
    bench = lifting_bench(0.02)
    k = holds_after(bench)
    assert k * T <= FAULTS[Reason.OVERLOAD].bound_ms * MS
    measured_nm, limit_nm, _ = bench.controller.evidence.numbers
    assert measured_nm > limit_nm == PROFILE.stability.share * PROFILE.stability.stabilising_nm


def test_by_the_pressures_inward_motion_goes_on_at_half_speed():
    bench = lifting_bench(-0.02)
    bench.drive(Joint.EXT, -0.02, 10)
    supervisor = bench.controller.supervisor
    assert bench.mode is Mode.ACTIVE and supervisor.half_speed and bench.reason == Reason.OVERLOADED
    assert bench.drive(Joint.EXT, -0.02, 60) is Mode.ACTIVE
    for bar in (120.0, 70.0, 45.0):
        bench.changed["PressA"] = {"LiftA": bar, "LiftB": 2.0}
        bench.drive(Joint.EXT, -0.01, 150)
    assert bench.mode is Mode.ACTIVE and not supervisor.half_speed and bench.reason == Reason.NONE


# -- Load by pressures: by the load cell, else by the pressures of a lift at rest or steady speed

WEIGHED = msgspec.structs.replace(SETTINGS.profile, sag=Sag(0.002, 0.0015, 0.01, 1e-6, 5200.0, 2900.0))
BACK_BAR = 4.0


def pressures(kg: float, q=HOME) -> tuple[float, float]:
    """Both sides of the lift cylinder under the empty crane and a load."""
    lift, kin = WEIGHED.joints["lift"].valve, WEIGHED.kinematics
    moment_nm = empty_moment_nm(WEIGHED.sag, kin, q) + kg * GRAVITY_M_S2 * (distances(kin, q)[1] - kin.a1_m)
    load_bar = moment_nm / (1e5 * lift.flow_plus * lever_share(lift, q[1]))
    return load_bar + BACK_BAR * lift.flow_minus / lift.flow_plus, BACK_BAR


def run(estimate: LoadEstimator, kg: float, seconds: float, velocity=lambda time_s: 0.0) -> float:
    for i in range(round(seconds / PERIOD_S)):
        found = estimate.step(HOME, velocity(i * PERIOD_S), *pressures(kg), PERIOD_S)
    return found


def test_load_at_rest_is_the_moment_beyond_the_empty_crane():
    estimate = LoadEstimator(WEIGHED)
    assert run(estimate, 0.0, PERIOD_S) == pytest.approx(0.0, abs=1e-6)
    after = run(estimate, 200.0, 0.8)
    assert 100.0 < after < 150.0, "filtered"
    assert run(estimate, 200.0, 6.0) == pytest.approx(200.0, abs=1.0)


def test_pressures_count_only_at_steady_speed():
    estimate = LoadEstimator(WEIGHED)
    run(estimate, 100.0, 1.0)
    assert run(estimate, 300.0, 0.4, lambda t: 0.4 * t) == pytest.approx(100.0, abs=15.0), "kept"
    assert run(estimate, 300.0, 8.0, lambda t: 0.16) == pytest.approx(300.0, abs=1.0)


def test_load_is_never_negative():
    assert run(LoadEstimator(WEIGHED), -40.0, 1.0) == 0.0


@pytest.mark.parametrize("gone", ["pressure", "position", "sag"])
def test_unknown_input_gives_nan_and_restarts_the_filter(gone):
    profile = msgspec.structs.replace(WEIGHED, sag=None) if gone == "sag" else WEIGHED
    estimate = LoadEstimator(profile)
    run(estimate, 250.0, 2.0)
    a, b = pressures(0.0)
    q = (HOME[0], math.nan, *HOME[2:]) if gone == "position" else HOME
    assert math.isnan(estimate.step(q, 0.0, None if gone == "pressure" else a, b, PERIOD_S))
    again = estimate.step(HOME, 0.0, a, b, PERIOD_S)
    assert math.isnan(again) if gone == "sag" else again == pytest.approx(0.0, abs=1e-6)


def test_rotator_position_is_not_needed():
    a, b = pressures(150.0)
    assert LoadEstimator(WEIGHED).step((*HOME[:4], math.nan), 0.0, a, b, PERIOD_S) == pytest.approx(150.0)


def report(profile, **grapple) -> float:
    bench = Bench(dataclasses.replace(SETTINGS, profile=profile))
    a, b = pressures(180.0)
    bench.changed["PressA"] = {"LiftA": a, "LiftB": b}
    bench.changed["GrappleStat"] = grapple
    bench.boot().run(120)
    return bench.reports[-1].load_kg


def test_load_cell_has_priority_over_pressures():
    assert report(WEIGHED, Load=77.0) == 77.0
    assert report(WEIGHED, Load=None) == pytest.approx(180.0, abs=3.0)
    assert math.isnan(report(SETTINGS.profile, Load=None))


# -- Load change: when a load comes or goes


class Scale:
    """A load that is estimated again and again."""

    def __init__(self) -> None:
        self.change = LoadChange(PERIOD_S)
        self.now_ns = 0

    def weighs(self, seconds, load_kg):
        """Whether the load changed while it was ``load_kg(t)``, the time from the start of this."""
        seen = False
        for k in range(round(seconds / PERIOD_S)):
            self.now_ns += LOAD_PERIOD_NS
            self.change.step(load_kg(k * PERIOD_S), self.now_ns)
            seen |= self.change.recent(self.now_ns)
        return seen


def settled(load_kg):
    scale = Scale()
    scale.weighs(8.0 * CHANGE_MEAN_S + CHANGE_REST_NS * 1e-9, lambda t: load_kg)
    assert not scale.change.recent(scale.now_ns)
    return scale


def test_a_load_that_hangs_is_none_and_one_that_swings_is_none():
    assert not settled(0.0).weighs(5.0, lambda t: 0.9 * CHANGE_KG)
    assert not settled(93.0).weighs(5.0, lambda t: 93.0 + 20.0 * math.sin(6.0 * t))
    assert not settled(600.0).weighs(5.0, lambda t: 600.0 + 90.0 * math.sin(6.0 * t))


@pytest.mark.parametrize(
    ("before_kg", "after_kg"),
    [
        pytest.param(0.0, lambda t: 60.0, id="a log is lifted"),
        pytest.param(93.0, lambda t: 0.0, id="a log touches the ground"),
        pytest.param(93.0, lambda t: 93.0 + 1500.0 * t, id="a log is caught"),
        pytest.param(780.0, lambda t: 780.0 - 210.0 * t, id="logs come to rest"),
    ],
)
def test_a_load_that_comes_or_goes_is_a_change_until_the_boom_has_come_to_rest(before_kg, after_kg):
    scale = settled(before_kg)
    assert scale.weighs(1.5, after_kg)
    rests_kg = max(0.0, after_kg(1.5))
    assert scale.weighs(CHANGE_REST_NS * 1e-9, lambda t: rests_kg)
    scale.weighs(8.0 * CHANGE_MEAN_S, lambda t: rests_kg)
    assert not scale.change.recent(scale.now_ns)


def test_a_load_that_nobody_knows_is_no_change():
    scale = settled(500.0)
    assert not scale.weighs(2.0, lambda t: math.nan)
