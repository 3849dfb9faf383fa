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
from machine.sensing.weighing import MIN_LEVER_ARM_M, lever_share
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
    drive(bench, Joint.EXT, v, 40)
    assert bench.mode is Mode.ACTIVE and not bench.controller.supervisor.half_speed
    bench.changed["PressA"] = {"LiftA": 200.0, "LiftB": 2.0}
    return bench


def test_by_the_pressures_outward_motion_holds_in_time():
    bench = lifting_bench(0.02)
    planned = (bench.moving(Joint.EXT, 0.02) if k % 10 == 9 else b"" for k in range(100))
    k = count_until(lambda: bench.tick([d for d in [next(planned)] if d]), lambda: bench.mode is not Mode.ACTIVE)
    assert bench.reason == Reason.OVERLOAD and bench.mode is Mode.STOP
    assert k * T <= FAULTS[Reason.OVERLOAD].bound_ms * MS
    measured_nm, limit_nm, _ = bench.controller.evidence.numbers
    assert measured_nm > limit_nm == PROFILE.stability.share * PROFILE.stability.stabilising_nm


def test_by_the_pressures_inward_motion_goes_on_at_half_speed():
    bench = lifting_bench(-0.02)
    drive(bench, Joint.EXT, -0.02, 10)
    supervisor = bench.controller.supervisor
    assert bench.mode is Mode.ACTIVE and supervisor.half_speed and bench.reason == Reason.OVERLOADED
    drive(bench, Joint.EXT, -0.02, 60)
    assert bench.mode is Mode.ACTIVE
    for bar in (120.0, 70.0, 45.0):
        bench.changed["PressA"] = {"LiftA": bar, "LiftB": 2.0}
        drive(bench, Joint.EXT, -0.01, 150)
    assert bench.mode is Mode.ACTIVE and not supervisor.half_speed and bench.reason == Reason.NONE
