"""The grapple law: time, pressure and opening; closed and holding; jammed jaws."""

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


def test_time_decides_without_sensors():
    law = made()
    now = run(law, GrappleCommand.OPEN, 3.4)
    assert (law.state, law.spool_pct, law.mode) == (GrappleState.OPENING, 100.0, GrappleCommand.OPEN)
    now = run(law, GrappleCommand.OPEN, 0.2, start_ns=now)
    assert (law.state, law.spool_pct) == (GrappleState.OPEN, 0.0)
    now = run(law, GrappleCommand.CLOSE, 3.4, start_ns=now)
    assert (law.spool_pct, law.mode) == (-100.0, GrappleCommand.CLOSE)
    run(law, GrappleCommand.CLOSE, 0.2, start_ns=now)
    assert (law.state, law.spool_pct, law.mode) == (GrappleState.HOLDING, 0.0, GrappleCommand.HOLD)


def test_grapple_never_opens_by_itself():
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


def test_closing_takes_longer_while_the_pressure_is_low():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 5.0, 10.0, 40.0)
    assert law.state is GrappleState.CLOSING
    run(law, GrappleCommand.CLOSE, 0.5, 10.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING


def test_pressure_kick_is_no_grip():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 0.04, HIGH, 99.0)
    run(law, GrappleCommand.CLOSE, 1.0, 30.0, 60.0, start_ns=now)
    assert law.state is GrappleState.CLOSING


@pytest.mark.parametrize(
    ("seconds", "opening", "state"),
    [
        (2.0, 30.0, GrappleState.HOLDING),
        (3.4, 1.0, GrappleState.CLOSED),
        (2.0, math.nan, GrappleState.HOLDING),
        (3.3, math.nan, GrappleState.CLOSED),
    ],
)
def test_closed_and_holding_are_distinguished(seconds, opening, state):
    """By the opening where it is measured, else by the time until the pressure rose."""
    law = made()
    now = run(law, GrappleCommand.CLOSE, seconds, 40.0, opening)
    run(law, GrappleCommand.CLOSE, 0.1, HIGH, opening, start_ns=now)
    assert law.state is state and law.mode is GrappleCommand.HOLD


def test_measured_load_means_holding():
    """A thin log between interleaved jaws: fully closed, and yet not empty."""
    law = made()
    now = run(law, GrappleCommand.CLOSE, 3.4, 40.0, 1.0)
    now = run(law, GrappleCommand.CLOSE, 0.1, HIGH, 1.0, start_ns=now)
    law.observe_load(0.5 * LOADED_KG, now)
    law.observe_load(0.5 * LOADED_KG, now + SECOND)
    law.observe_load(math.nan, now + 2 * SECOND)
    assert law.state is GrappleState.CLOSED and not law.loaded
    now += 3 * SECOND
    law.observe_load(2.0 * LOADED_KG, now)
    assert law.state is GrappleState.CLOSED, "a swing of the empty grapple"
    law.observe_load(2.0 * LOADED_KG, now + SECOND // 2)
    assert law.state is GrappleState.HOLDING and law.loaded
    law.observe_load(0.0, now + SECOND)
    assert law.state is GrappleState.HOLDING and not law.loaded, "a log on the ground is still held"
    law.observe_load(2.0 * LOADED_KG, now + SECOND)
    law.step(GrappleCommand.OPEN, 0.0, 1.0, 0.0, now + SECOND)
    law.observe_load(2.0 * LOADED_KG, now + 2 * SECOND)
    assert law.state is GrappleState.OPENING and not law.loaded


def test_load_cell_sets_loaded():
    bench = Bench().armed()
    bench.keep(1100, grapple=GrappleCommand.CLOSE)
    assert not bench.controller.crane.grapple.loaded
    bench.changed["GrappleStat"] = {"Load": 80.0}
    bench.keep(200, grapple=GrappleCommand.CLOSE)
    assert bench.controller.crane.grapple.loaded and bench.reports[-1].load_kg == 80.0


def held(opening):
    law = made()
    now = run(law, GrappleCommand.CLOSE, 2.0, 40.0, opening)
    return law, run(law, GrappleCommand.CLOSE, 0.1, HIGH, opening, start_ns=now)


def test_jammed_jaws_are_shaken_loose():
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


def test_shaking_ends_after_its_limit():
    law, now = held(20.0)
    shakes, before = 0, GrappleCommand.OPEN
    for k in range(4000):
        law.step(GrappleCommand.OPEN, 0.0, 20.0, HIGH, now + k * T)
        shakes += law.mode is GrappleCommand.CLOSE and before is not GrappleCommand.CLOSE
        before = law.mode
    assert shakes == 3 and law.spool_pct == 0.0


def test_full_pressure_at_once_means_jammed_without_a_sensor():
    law, now = held(math.nan)
    run(law, GrappleCommand.OPEN, 0.2, 0.0, math.nan, HIGH, start_ns=now)
    assert law.mode is GrappleCommand.CLOSE
    law, now = held(math.nan)
    now = run(law, GrappleCommand.OPEN, 2.0, 0.0, math.nan, 30.0, start_ns=now)
    run(law, GrappleCommand.OPEN, 0.1, 0.0, math.nan, HIGH, start_ns=now)
    assert law.state is GrappleState.OPEN, "pressure at the end of the stroke means open"


def test_jaws_of_unknown_state_are_not_shaken():
    law = made()
    run(law, GrappleCommand.OPEN, 0.3, 0.0, math.nan, HIGH)
    assert law.mode is not GrappleCommand.CLOSE


def test_grapple_holds_through_stop_and_fault():
    bench = Bench().armed()
    bench.keep(300, grapple=GrappleCommand.CLOSE)
    assert bench.commands_b["Grapple"] == -100.0
    bench.keep(800, grapple=GrappleCommand.CLOSE)
    assert bench.commands_b["GrappleMode"] == GrappleCommand.HOLD
    for change in ({"ChannelA": 1}, {"ChannelA": 0, "ChannelB": 0}):
        bench.changed["EstopStat"] = change
        bench.run(60)
        assert bench.mode in (Mode.STOP, Mode.FAULT)
        assert bench.neutral and bench.commands_b["GrappleMode"] == GrappleCommand.HOLD


def test_loose_bundle_is_gripped_again_while_close_is_requested():
    law = made()
    now = run(law, GrappleCommand.CLOSE, 0.5, 20.0, 60.0)
    now = run(law, GrappleCommand.CLOSE, 0.2, HIGH, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING
    now = run(law, GrappleCommand.CLOSE, 0.05, 60.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "a pressure dip is no loose log"
    kept = run(law, GrappleCommand.HOLD, 0.5, 60.0, 40.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "HOLD does not close again"
    now = run(law, GrappleCommand.CLOSE, 0.2, 60.0, 40.0, start_ns=kept)
    assert (law.state, law.spool_pct) == (GrappleState.CLOSING, -100.0)
    now = run(law, GrappleCommand.CLOSE, 0.2, HIGH, 35.0, start_ns=now)
    assert (law.state, law.spool_pct) == (GrappleState.HOLDING, 0.0)
    run(law, GrappleCommand.CLOSE, 1.0, math.nan, 35.0, start_ns=now)
    assert law.state is GrappleState.HOLDING, "without a pressure sensor nothing counts as loose"


def test_jaws_press_while_they_move_and_a_while_longer():
    law = made()
    assert not law.presses(0)
    now = run(law, GrappleCommand.CLOSE, 0.3)
    law.release()
    assert law.presses(now + 1_100_000_000) and not law.presses(now + 1_300_000_000)
