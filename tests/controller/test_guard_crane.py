"""The guard's rules on the crane: spools, places and what the controller says, at each limit and just beyond it."""

from __future__ import annotations

import pytest

from controller.guard.__main__ import DATABASES, profile_path
from controller.guard.envelope import read_envelope
from controller.guard.guard import MESSAGES, RANGE_MARGIN_UNITS, Guard
from controller.guard.layout import read_layouts
from controller.guard.verdicts import Verdict
from tests.controller.guard_traffic import (
    CENTRE,
    DRIVING,
    MOVING,
    PROFILE,
    Traffic,
    put,
    under_ground,
)


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
