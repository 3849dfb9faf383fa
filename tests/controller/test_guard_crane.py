"""The guard's rules on the crane: spools, places, motion without a command, and what the controller says."""

from __future__ import annotations

import pytest

from controller.guard.__main__ import DATABASES, profile_path
from controller.guard.envelope import read_envelope
from controller.guard.guard import MESSAGES, RANGE_MARGIN_UNITS, Guard
from controller.guard.layout import read_layouts
from controller.guard.reach import Reach
from controller.guard.verdicts import FINE, Verdict
from machine.geometry.kinematics import pin_position, solve
from machine.loading.profile_file import load_profile
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import CENTRE, DRIVING, MOVING, PROFILE, Traffic, press_reset, put, under_ground


def of_palms(**changed) -> Guard:
    """A guard of the PALMS crane whose axes all have these values."""
    envelope = read_envelope(PROFILE)
    layouts = read_layouts(DATABASES / "crane.dbc", [*MESSAGES, *(a.message for a in envelope.axes)])
    return Guard(envelope._replace(axes=tuple(axis._replace(**changed) for axis in envelope.axes)), layouts)


@pytest.mark.parametrize(("mode", "allowed"), [(2, True), (3, True), (1, False), (4, False)])
def test_the_controller_must_say_that_it_operates(mode: int, allowed: bool) -> None:
    traffic = Traffic().good()
    traffic.a.update(MOVING)
    traffic.controller["Mode"] = mode
    traffic.tick(60)
    assert (traffic.guard.verdict is Verdict.GOOD) is allowed


def test_a_neutral_command_agrees_with_any_mode() -> None:
    traffic = Traffic().good()
    traffic.controller["Mode"] = 4
    assert traffic.tick(200) is Verdict.GOOD
    traffic.a.update(MOVING)
    assert traffic.tick() is Verdict.NOT_ARMED, "a controller that has stopped needs a person's ARM"


@pytest.mark.parametrize(
    ("mode", "side", "allowed"),
    [
        (1, 1, True),
        (1, -1, False),
        (2, -1, True),
        (2, 1, False),
        (3, -1, True),
        (3, 1, False),
        (0, 1, False),
        (0, -1, False),
    ],
)
def test_the_grapple_s_spool_may_be_open_on_the_side_of_its_mode(mode: int, side: int, allowed: bool) -> None:
    traffic = Traffic().good()
    traffic.b["GrappleMode"] = mode
    traffic.tick(2)
    traffic.valve_b["SpoolGrapple"] = side * 50.0
    assert (traffic.tick() is Verdict.GOOD) is allowed


@pytest.mark.parametrize(("mode", "allowed"), [(2, True), (0, False)])
def test_a_spool_follows_its_command_only_in_the_mode_of_spools(mode: int, allowed: bool) -> None:
    traffic = Traffic().good()
    traffic.a = {"Mode": mode, "Ext": 13.0}
    traffic.tick(3)
    traffic.valve_a["SpoolExt"] = 20.0
    assert (traffic.tick() is Verdict.GOOD) is allowed


@pytest.mark.parametrize(
    ("message", "grapple", "side"), [("ValveCmdA", 0, 1), ("ValveCmdB", 1, 1), ("ValveCmdB", 2, -1)]
)
def test_a_spool_that_stays_open_when_commands_end_is_told(message: str, grapple: int, side: int) -> None:
    traffic = Traffic().good()
    traffic.a = {"Mode": 2, "Ext": 0.0 if grapple else 13.0}
    traffic.b["GrappleMode"] = grapple
    traffic.tick(3)
    where = traffic.valve_b if grapple else traffic.valve_a
    where["SpoolGrapple" if grapple else "SpoolExt"] = side * 30.0
    assert traffic.tick(3) is Verdict.GOOD
    traffic.dropped.add(message)
    assert traffic.tick(80) is Verdict.SPOOL


def test_an_old_feedback_tells_nothing_and_the_first_of_two_open_spools_is_named() -> None:
    traffic = Traffic().good()
    traffic.valve_a |= {"SpoolLift": 50.0, "SpoolExt": 50.0}
    traffic.tick()
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.SPOOL, 1)
    traffic = Traffic()
    traffic.valve_a["SpoolLift"] = 50.0
    traffic.dropped.add("ValveFbA")
    traffic.good()


def test_a_spool_counts_as_open_beyond_the_smaller_of_its_dead_bands() -> None:
    traffic = Traffic()
    traffic.guard = of_palms(deadbands_pct=(20.0, 8.0))
    traffic.good()
    traffic.valve_a["SpoolLift"] = 8.0
    assert traffic.tick() is Verdict.GOOD
    traffic.valve_a["SpoolLift"] = -9.0
    assert traffic.tick() is Verdict.SPOOL


@pytest.mark.parametrize(("share", "fine"), [(0.9, True), (-0.9, True), (2.5, False), (-2.5, False)])
def test_a_joint_may_creep_by_a_twentieth_of_its_speed(share: float, fine: bool) -> None:
    traffic = Traffic().good()
    tilt = read_envelope(PROFILE).axes[2]
    for k in range(800):
        traffic.encoder["EncTilt"] = CENTRE + round(share * 0.05 * tilt.speed_limit * 0.005 * k / abs(tilt.unit))
        traffic.tick()
        if not fine and not traffic.guard.enabled:
            break
    assert (traffic.guard.verdict is Verdict.GOOD) is fine


@pytest.mark.parametrize(("beyond", "fine"), [(0.0075, True), (0.0085, False)])
@pytest.mark.parametrize("command_pct", [13.0, 0.5, -0.5, -13.0])
def test_a_joint_may_be_driven_out_as_far_as_its_margin(beyond: float, fine: bool, command_pct: float) -> None:
    traffic = Traffic().good()
    slew = read_envelope(PROFILE).axes[0]
    at = (slew.upper + beyond) if command_pct > 0.0 else (slew.lower - beyond)
    put(traffic, EncSlew=CENTRE + round(at / slew.unit))
    traffic.a = {"Mode": 2, "Slew": slew.sign * command_pct}
    traffic.tick(2)
    assert (traffic.guard.verdict is Verdict.GOOD) is fine
    if not fine:
        assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.OUTSIDE, 0)


def test_exactly_at_its_margin_a_joint_may_be_driven_out() -> None:
    unit = read_envelope(PROFILE).axes[0].unit
    margin = RANGE_MARGIN_UNITS
    counts = next(n for n in range(30, 5000) if n * unit - (n * unit - margin) == margin)
    traffic = Traffic()
    traffic.guard = of_palms(upper=counts * unit - margin)
    traffic.good()
    put(traffic, EncSlew=CENTRE + counts)
    traffic.a = dict(MOVING)
    assert traffic.tick(3) is Verdict.GOOD


def test_a_joint_that_is_outside_does_not_hold_the_others() -> None:
    slew = read_envelope(PROFILE).axes[0]
    for at in (slew.lower - 0.2, slew.upper + 0.2):
        traffic = Traffic()
        traffic.encoder["EncSlew"] = CENTRE + round(at / slew.unit)
        traffic.good()
        traffic.a = {"Mode": 2, "Lift": 13.0}
        assert traffic.tick(5) is Verdict.GOOD


def test_without_all_four_encoders_there_is_no_place_to_judge() -> None:
    envelope = read_envelope(PROFILE)
    axes = tuple(axis._replace(message="" if axis.number == 3 else axis.message) for axis in envelope.axes)
    layouts = read_layouts(DATABASES / "crane.dbc", [*MESSAGES, *(a.message for a in axes if a.message)])
    traffic = Traffic()
    traffic.guard = Guard(envelope._replace(axes=axes), layouts)
    traffic.good()
    under_ground(traffic)
    assert traffic.tick(2) is Verdict.GOOD


def test_an_opening_that_holds_a_joint_is_no_motion() -> None:
    guard = Traffic().guard
    for opening, moves in ((30.0, False), (-30.0, False), (30.1, True), (-30.1, True)):
        guard._commands[3].opening = opening
        assert guard._crane_moves() is moves


def test_one_sample_outside_is_an_encoder_s_fault() -> None:
    traffic = Traffic().good()
    traffic.a.update(MOVING)
    traffic.tick(2)
    for _ in range(3):
        traffic.encoder["EncSlew"] = CENTRE + int(1.85 / 3.835e-4)
        assert traffic.tick() is Verdict.GOOD
        traffic.encoder["EncSlew"] = CENTRE
        assert traffic.tick() is Verdict.GOOD


@pytest.mark.parametrize("opening_pct", [29.0, 31.0])
def test_the_crane_moves_above_an_opening_that_holds_it(opening_pct: float) -> None:
    traffic = Traffic("aoro_fc8").good()
    slew = read_envelope(profile_path("aoro_fc8")).axes[0]
    traffic.drive = dict(DRIVING)
    shut = slew.deadbands_pct[1]
    wanted = shut + opening_pct * (100.0 - shut) / 100.0
    for k in range(400):
        traffic.drive["Speed"] = min(0.3, 0.002 * k)
        traffic.a = {"Mode": 2, "Slew": min(wanted, 0.3 * k)}
        traffic.tick()
    assert (traffic.guard.verdict is Verdict.BOTH) is (opening_pct > 30.0), traffic.guard.verdict


def test_a_command_may_grow_at_its_rate_for_as_long_as_it_likes() -> None:
    traffic = Traffic()
    traffic.guard = of_palms(rate_pct_s=100.0)
    traffic.good()
    for k in range(160):
        traffic.a = {"Mode": 2, "Slew": 12.0 + 0.4 * k}
        assert traffic.tick() is Verdict.GOOD


# -- motion that nobody commands, and the pilot supply (GuardPilot)

RAD = 3.835e-4
CLOSING_NS = 240 * MS
"""1.5 dead times of 80 ms and three lags of 40 ms."""


def test_a_spool_that_closes_in_time_passes_and_one_that_stays_open_does_not():
    traffic = Traffic().good()
    for pct in range(60):
        traffic.a = {"Mode": 2, "Slew": float(pct)}
        traffic.valve_a = {"SpoolSlew": float(pct)}
        assert traffic.tick() is Verdict.GOOD
    traffic.a = {"Mode": 0}
    k = count_until(traffic.tick, lambda: not traffic.guard.enabled)
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.SPOOL, 0)
    assert abs(k * T - CLOSING_NS) <= 2 * T
    traffic = Traffic().good()
    traffic.valve_a = {"SpoolSlew": 9.0}
    assert traffic.tick(100) is Verdict.GOOD, "inside its dead-band no oil flows"


def test_a_spool_open_against_its_command():
    traffic = Traffic().good()
    traffic.a, traffic.valve_a = dict(MOVING), {"SpoolSlew": 13.0}
    assert traffic.tick(100) is Verdict.GOOD
    traffic.valve_a = {"SpoolSlew": -13.0}
    assert traffic.tick(2) is Verdict.SPOOL


def slide(traffic, rad_s, ticks, name="EncLift"):
    """Move a joint that nobody commands."""
    start = traffic.encoder[name]
    for k in range(ticks):
        traffic.encoder[name] = start + round(rad_s * (k + 1) * T * 1e-9 / RAD)
        if traffic.tick() is not Verdict.GOOD:
            return k + 1
    return 0


@pytest.mark.parametrize("mode", [1, 3])
@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_a_joint_that_moves_at_any_speed_without_a_command_is_found(share, mode):
    """Far below 25 % of the speed limit too, armed or not, after at most 0.03 rad."""
    traffic = Traffic().good()
    traffic.controller["Mode"] = mode
    traffic.tick(100)
    speed = 0.15 * share
    k = slide(traffic, speed, 400)
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.MOVING, 1)
    assert k * T * 1e-9 * speed < 0.03


def test_creep_noise_and_one_sample_that_jumps_pass():
    traffic = Traffic().good()
    traffic.tick(100)
    assert slide(traffic, 0.006, 1000) == 0, "a cylinder that leaks"
    for k in range(100):
        traffic.encoder["EncSlew"] = CENTRE + (20 if k % 10 == 0 else (-3, 3, 0)[k % 3])
        traffic.encoder["EncTilt"] = CENTRE + (500 if k % 20 == 0 else 0)
        assert traffic.tick() is Verdict.GOOD


def test_a_joint_may_come_to_rest_after_its_command():
    traffic = Traffic().good()
    traffic.a = dict(MOVING)
    traffic.tick(40)
    traffic.a = {"Mode": 0}
    assert slide(traffic, 0.2, 90, "EncSlew") == 0
    traffic.encoder["EncSlew"] -= 10
    assert traffic.tick(200) is Verdict.GOOD


def supply(traffic):
    return traffic.pilot[-1]["Supply"]


def test_the_pilot_supply_is_on_with_commands_and_goes_off_after_300_ms_of_silence():
    traffic = Traffic()
    traffic.dropped |= {"ValveCmdA"}
    traffic.tick(60)
    assert supply(traffic) == 0, "nobody has commanded yet"
    traffic.dropped.clear()
    traffic.tick(60)
    assert supply(traffic) == 0xA
    n = len(traffic.pilot)
    traffic.tick(100)
    assert len(traffic.pilot) - n == 50, "every 10 ms"
    traffic.dropped.add("ValveCmdB")
    k = count_until(traffic.tick, lambda: supply(traffic) == 0)
    assert 300 * MS < k * T <= 365 * MS
    traffic.dropped.clear()
    traffic.tick(4)
    assert supply(traffic) == 0xA, "silence does not latch"


def test_a_latching_verdict_switches_the_supply_off_until_a_person_resets():
    traffic = Traffic().good()
    traffic.valve_a = {"SpoolLift": 30.0}
    traffic.tick()
    assert supply(traffic) == 0 and traffic.pilot[-1]["Verdict"] == Verdict.SPOOL, "at once"
    traffic.valve_a = {}
    traffic.tick(200)
    assert supply(traffic) == 0
    press_reset(traffic)
    assert supply(traffic) == 0xA


def test_what_does_not_latch_leaves_the_supply_on():
    traffic = Traffic().good()
    traffic.dropped.add("EstopStat")
    assert traffic.tick(20) is Verdict.ESTOP_LOST
    assert supply(traffic) == 0xA


@pytest.mark.parametrize("machine", ["palms_471", "aoro_fc8"])
def test_own_kinematics_agree_with_the_planners(machine):
    profile, reach = load_profile(machine), Reach(read_envelope(PROFILE.with_name(f"{machine}.toml")))
    for q in ((0.0, 0.5, -1.2, 0.6), (-1.4, -0.2, -0.4, 1.7), (1.1, 1.2, -2.5, 0.2)):
        assert reach.pin(*q) == pytest.approx(pin_position(profile.kinematics, (*q, 0.0)), abs=1e-6)


def test_the_pin_may_leave_a_forbidden_place_and_not_go_deeper():
    traffic = Traffic()
    traffic.encoder |= {"EncLift": CENTRE - round(0.38 / RAD), "EncTilt": CENTRE - round(0.6 / RAD)}
    traffic.good()
    traffic.a = {"Mode": 2, "Lift": 13.0}
    assert traffic.tick(20) is Verdict.GOOD
    traffic.a = {"Mode": 2, "Slew": 13.0}
    assert traffic.tick(20) is Verdict.GOOD, "no deeper"
    traffic.a = {"Mode": 2, "Ext": 13.0}
    traffic.tick()
    assert traffic.tick() is Verdict.REACH


@pytest.mark.parametrize("place", ["EncLift", "EncTilt"])
def test_one_sample_that_jumps_is_no_place(place):
    """The controller refuses the sample and goes on; so does the guard."""
    traffic = Traffic()
    traffic.good()
    traffic.a = {"Mode": 2, "Lift": -13.0, "Tilt": -13.0}
    before = traffic.encoder.get(place, CENTRE)
    traffic.encoder[place] = before - round(3.0 / RAD)
    assert traffic.tick() is Verdict.GOOD
    traffic.encoder[place] = before
    assert traffic.tick(3) is Verdict.GOOD
    traffic.encoder[place] = before - round(3.0 / RAD)
    traffic.tick()
    assert traffic.tick() in (Verdict.OUTSIDE, Verdict.REACH)


def test_the_pin_may_not_enter_a_box():
    """One centimetre beside the column: of two directions the one that enters it is refused."""
    reach, profile = Reach(read_envelope(PROFILE)), load_profile("palms_471")
    q = list(solve(profile, 0.0, 0.41, 0.5))
    assert -0.02 < reach.depth_m(q) < 0.0
    verdicts = {}
    for lift_rad_s in (-0.15, 0.15):
        x, y, z = reach.pin(q[0], q[1] + lift_rad_s * 0.1, *q[2:])
        verdicts[lift_rad_s] = reach.deeper(q, [0.0, lift_rad_s, 0.0, 0.0])
        assert verdicts[lift_rad_s] == (abs(x) < 0.4 and abs(y) < 0.4 and -1.39 < z < 1.5)
    assert sorted(verdicts.values()) == [False, True]
    assert not reach.deeper(q, [0.0] * 4)


def lowers(machine: str, x_m: float, y_m: float, z_m: float) -> bool:
    """Whether the guard stops a pin there that goes down at 0.3 m/s, by lift and telescope."""
    profile, reach = load_profile(machine), Reach(read_envelope(PROFILE.with_name(f"{machine}.toml")))
    here, there = (solve(profile, x_m, y_m, z) for z in (z_m, z_m - 0.003))
    return reach.deeper(list(here), [100.0 * (b - a) for a, b in zip(here, there, strict=True)])


@pytest.mark.parametrize(("machine", "x_m", "y_m"), [("palms_471", -1.8, 4.4), ("aoro_fc8", 4.0, 3.4)])
def test_a_grapple_may_be_lowered_to_logs_on_the_ground_and_not_into_it(machine: str, x_m: float, y_m: float) -> None:
    """Of a carrier's ground the guard knows no more than that it is not deeper than with the frame at its highest."""
    profile = load_profile(machine)
    tips, ground_m = profile.grapple.jaws.tip_below_pin_m, profile.workspace.ground_z_m
    touches_m = ground_m + min(tips) if profile.carrier is None else ground_m - profile.carrier.arm_travel_m + min(tips)
    assert not lowers(machine, x_m, y_m, touches_m + tips[0] - min(tips) - 0.05), "an open one on ground that is lower"
    assert lowers(machine, x_m, y_m, touches_m + (0.13 if profile.carrier is None else -0.13))


@pytest.mark.parametrize(("x_m", "y_m"), [(-2.9, 0.6), (-2.6, -0.6)])
def test_what_hangs_stiff_under_the_pin_does_not_enter_the_machine(x_m: float, y_m: float) -> None:
    """The front half of the carrier, which the controller keeps it out of from 0.1 m higher."""
    profile = load_profile("aoro_fc8")
    kin, box = profile.kinematics, profile.keep_out["front_half"]
    over_m = box.center_m[2] + box.half_m[2] + kin.hanger_to_fork_m + kin.fork_to_rotator_m
    assert lowers("aoro_fc8", x_m, y_m, over_m - 0.1)
    assert not lowers("aoro_fc8", x_m, y_m, over_m)


@pytest.mark.parametrize("grapple_mode", [1, 2, 3])
def test_jaws_that_work_or_hold_move_a_joint_by_more_until_a_moment_later(grapple_mode):
    """By 0.03 rad, on oil and steel; later it is a motion again."""
    traffic = Traffic().good()
    traffic.tick(100)
    traffic.b["GrappleMode"] = grapple_mode
    traffic.tick(10)
    traffic.b["GrappleMode"] = 0
    traffic.tick(100)
    assert slide(traffic, 0.1, 60) == 0
    assert traffic.tick(180) is Verdict.GOOD, "it stands where it was pressed to"
    assert slide(traffic, 0.1, 60) > 0
    assert (traffic.guard.verdict, traffic.guard.axis) == (Verdict.MOVING, 1)


@pytest.mark.parametrize(
    ("asked_pct", "verdict"), [(0.0, Verdict.GOOD), (13.0, Verdict.GOOD), (60.0, Verdict.OVERSPEED)]
)
def test_a_rotator_may_follow_a_log_while_its_valve_asks_for_nothing(asked_pct, verdict):
    """A log turns it by 0.1 rad at once: far more than a joint may be ahead of the speed that its valve gives it."""
    traffic = Traffic().good()
    traffic.b["GrappleMode"] = 3
    while traffic.b.get("Rot", 0.0) < asked_pct:
        traffic.a["Mode"], traffic.b["Rot"] = 2, min(traffic.b.get("Rot", 0.0) + 1.0, asked_pct)
        assert traffic.tick() is Verdict.GOOD
    traffic.encoder["EncRot"] += round(0.1 / RAD)
    found = [(traffic.tick(), traffic.guard.axis) for _ in range(5)]
    assert next((one for one in found if one != FINE), FINE) == (FINE if verdict is Verdict.GOOD else (verdict, 4))
