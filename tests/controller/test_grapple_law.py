"""The grapple: by time, pressure and opening; closed told from holding; tongs that stick."""

import math

import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.laws.grapple import LOADED_KG, GrappleLaw, GrappleState
from machine.status.modes import Mode
from tests.controller.bench import SETTINGS, Bench, T

SECOND = 10**9
HIGH = 160.0


def made():
    return GrappleLaw(SETTINGS.profile.grapple)


def run(law, wanted, seconds, clamp=math.nan, opening=math.nan, release=math.nan, start_ns=0):
    for k in range(round(seconds * 200)):
        law.step(wanted, clamp, opening, release, start_ns + k * T)
    return start_ns + round(seconds * 200) * T


def test_by_time_without_sensors():
    law = made()
    now = run(law, GrappleCommand.OPEN, 3.4)
    assert (law.state, law.spool_pct, law.mode) == (GrappleState.OPENING, 100.0, GrappleCommand.OPEN)
    now = run(law, GrappleCommand.OPEN, 0.2, start_ns=now)
    assert (law.state, law.spool_pct) == (GrappleState.OPEN, 0.0)
    now = run(law, GrappleCommand.CLOSE, 3.4, start_ns=now)
    assert (law.spool_pct, law.mode) == (-100.0, GrappleCommand.CLOSE)
    run(law, GrappleCommand.CLOSE, 0.2, start_ns=now)
    assert (law.state, law.spool_pct, law.mode) == (GrappleState.HOLDING, 0.0, GrappleCommand.HOLD)


def test_it_never_opens_by_itself():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 0.5, 20.0, 60.0)
    now = run(law, GrappleCommand.CLOSE, 0.2, HIGH, 30.0, start_ns=now)
    assert law.state is GrappleState.HOLDING
    for wanted in (GrappleCommand.NEUTRAL, GrappleCommand.HOLD, GrappleCommand.CLOSE):
        law.step(wanted, 0.0, 0.0, 0.0, now)
        law.release()
        assert law.mode is GrappleCommand.HOLD
    now = run(law, GrappleCommand.OPEN, 0.1, 0.0, 50.0, start_ns=now)
    run(law, GrappleCommand.OPEN, 0.1, 0.0, 98.5, start_ns=now)
    assert law.state is GrappleState.OPEN


def test_without_pressure_it_closes_for_a_while_longer():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 5.0, 10.0, 40.0)
    assert law.state is GrappleState.CLOSING
    run(law, GrappleCommand.CLOSE, 0.5, 10.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING


def test_a_kick_of_the_pressure_is_no_grip():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 0.04, HIGH, 99.0)
    run(law, GrappleCommand.CLOSE, 1.0, 30.0, 60.0, start_ns=now)
    assert law.state is GrappleState.CLOSING


@pytest.mark.parametrize(
    ("seconds", "opening", "state"),
    [(2.0, 30.0, GrappleState.HOLDING), (3.4, 1.0, GrappleState.CLOSED),
     (2.0, math.nan, GrappleState.HOLDING), (3.3, math.nan, GrappleState.CLOSED)],
)  # fmt: skip
def test_closed_on_nothing_is_told_from_holding(seconds, opening, state):
    """By the opening where it is measured, else by how long the tongs moved before the pressure rose."""
    law = made()
    now = run(law, GrappleCommand.CLOSE, seconds, 40.0, opening)
    run(law, GrappleCommand.CLOSE, 0.1, HIGH, opening, start_ns=now)
    assert law.state is state and law.mode is GrappleCommand.HOLD


def test_what_weighs_something_is_held_whatever_the_tongs_say():
    """A thin log between interleaved tongs: shut to the end of their way, and yet not empty."""
    law = made()
    now = run(law, GrappleCommand.CLOSE, 3.4, 40.0, 1.0)
    now = run(law, GrappleCommand.CLOSE, 0.1, HIGH, 1.0, start_ns=now)
    law.observe_load(0.5 * LOADED_KG, now)
    law.observe_load(0.5 * LOADED_KG, now + SECOND)
    law.observe_load(math.nan, now + 2 * SECOND)
    assert law.state is GrappleState.CLOSED and not law.loaded
    now += 3 * SECOND
    law.observe_load(2.0 * LOADED_KG, now)
    assert law.state is GrappleState.CLOSED, "a swing of the tongs"
    law.observe_load(2.0 * LOADED_KG, now + SECOND // 2)
    assert law.state is GrappleState.HOLDING and law.loaded
    law.observe_load(0.0, now + SECOND)
    assert law.state is GrappleState.HOLDING and not law.loaded, "on the ground it is held still"
    law.observe_load(2.0 * LOADED_KG, now + SECOND)
    law.step(GrappleCommand.OPEN, 0.0, 1.0, 0.0, now + SECOND)
    law.observe_load(2.0 * LOADED_KG, now + 2 * SECOND)
    assert law.state is GrappleState.OPENING and not law.loaded


def test_the_load_cell_tells_the_controller_that_the_grapple_is_loaded():
    bench = Bench().armed()
    for k in range(1100):
        bench.tick([bench.hold(grapple=GrappleCommand.CLOSE)] if k % 10 == 0 else ())
    assert not bench.controller.crane.grapple.loaded
    bench.changed["GrappleStat"] = {**bench.changed.get("GrappleStat", {}), "Load": 80.0}
    for k in range(200):
        bench.tick([bench.hold(grapple=GrappleCommand.CLOSE)] if k % 10 == 0 else ())
    assert bench.controller.crane.grapple.loaded and bench.reports[-1].load_kg == 80.0


def held(opening):
    law = made()
    now = run(law, GrappleCommand.CLOSE, 2.0, 40.0, opening)
    return law, run(law, GrappleCommand.CLOSE, 0.1, HIGH, opening, start_ns=now)


def test_tongs_that_stick_are_shaken_loose():
    law, now = held(20.0)
    now = run(law, GrappleCommand.OPEN, 0.9, 0.0, 20.5, start_ns=now)
    assert law.mode is GrappleCommand.OPEN
    now = run(law, GrappleCommand.OPEN, 0.2, 0.0, 20.5, start_ns=now)
    assert (law.state, law.mode, law.spool_pct) == (GrappleState.OPENING, GrappleCommand.CLOSE, -100.0)
    now = run(law, GrappleCommand.OPEN, 0.3, 0.0, 20.0, start_ns=now)
    assert law.mode is GrappleCommand.OPEN
    now = run(law, GrappleCommand.OPEN, 0.5, 0.0, 60.0, start_ns=now)
    run(law, GrappleCommand.OPEN, 0.1, 0.0, 99.0, start_ns=now)
    assert law.state is GrappleState.OPEN


def test_tongs_that_stick_for_good_are_given_up():
    law, now = held(20.0)
    shakes, before = 0, GrappleCommand.OPEN
    for k in range(4000):
        law.step(GrappleCommand.OPEN, 0.0, 20.0, HIGH, now + k * T)
        shakes += law.mode is GrappleCommand.CLOSE and before is not GrappleCommand.CLOSE
        before = law.mode
    assert shakes == 3 and law.spool_pct == 0.0


def test_without_a_sensor_full_pressure_at_once_says_that_they_stick():
    law, now = held(math.nan)
    run(law, GrappleCommand.OPEN, 0.2, 0.0, math.nan, HIGH, start_ns=now)
    assert law.mode is GrappleCommand.CLOSE
    law, now = held(math.nan)
    now = run(law, GrappleCommand.OPEN, 2.0, 0.0, math.nan, 30.0, start_ns=now)
    run(law, GrappleCommand.OPEN, 0.1, 0.0, math.nan, HIGH, start_ns=now)
    assert law.state is GrappleState.OPEN, "at the end of their way the pressure says that they are open"


def test_tongs_of_which_nothing_is_known_are_not_shaken():
    law = made()
    run(law, GrappleCommand.OPEN, 0.3, 0.0, math.nan, HIGH)
    assert law.mode is not GrappleCommand.CLOSE


def test_it_holds_through_a_stop_and_a_fault():
    bench = Bench().armed()
    for k in range(1100):
        bench.tick([bench.hold(grapple=GrappleCommand.CLOSE)] if k % 10 == 0 else ())
        if k == 300:
            assert bench.commands_b["Grapple"] == -100.0
    assert bench.commands_b["GrappleMode"] == GrappleCommand.HOLD
    for change in ({"ChannelA": 1}, {"ChannelA": 0, "ChannelB": 0}):
        bench.changed["EstopStat"] = change
        bench.run(60)
        assert bench.mode in (Mode.STOP, Mode.FAULT)
        assert bench.neutral and bench.commands_b["GrappleMode"] == GrappleCommand.HOLD


def test_what_settled_loosely_is_gripped_again_while_closing_is_asked_for():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 0.5, 20.0, 60.0)
    now = run(law, GrappleCommand.CLOSE, 0.2, HIGH, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING
    now = run(law, GrappleCommand.CLOSE, 0.05, 60.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "a dip of the pressure is no loose log"
    kept = run(law, GrappleCommand.HOLD, 0.5, 60.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "a planner that holds is obeyed"
    now = run(law, GrappleCommand.CLOSE, 0.2, 60.0, 40.0, start_ns=kept)
    assert (law.state, law.spool_pct) == (GrappleState.CLOSING, -100.0)
    now = run(law, GrappleCommand.CLOSE, 0.2, HIGH, 35.0, start_ns=now)
    assert (law.state, law.spool_pct) == (GrappleState.HOLDING, 0.0)
    run(law, GrappleCommand.CLOSE, 1.0, math.nan, 35.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "without pressure nothing is known to be loose"
