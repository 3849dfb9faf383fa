"""The grapple law: time, pressure and opening; closed and holding; jammed jaws."""

import math

import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.laws.grapple import LOADED_KG, GrappleLaw, GrappleState
from machine.status.modes import Mode
from tests.controller.bench import SETTINGS, Bench, T

SECOND = 10**9
HIGH = 160.0
OPEN, CLOSE, HOLD = GrappleCommand.OPEN, GrappleCommand.CLOSE, GrappleCommand.HOLD


class Jaws:
    """The law with its clock; `run` gives the state after some time of a command and what is measured meanwhile."""

    def __init__(self):
        self.law, self.now_ns = GrappleLaw(SETTINGS.profile.grapple), 0

    def run(self, wanted, seconds, clamp=math.nan, opening=math.nan, release=math.nan):
        for _ in range(round(seconds * 200)):
            self.law.step(wanted, clamp, opening, release, self.now_ns)
            self.now_ns += T
        return self.law.state


def test_time_decides_without_sensors():
    jaws = Jaws()
    assert jaws.run(OPEN, 3.4) is GrappleState.OPENING and (jaws.law.spool_pct, jaws.law.mode) == (100.0, OPEN)
    assert jaws.run(OPEN, 0.2) is GrappleState.OPEN and jaws.law.spool_pct == 0.0
    jaws.run(CLOSE, 3.4)
    assert (jaws.law.spool_pct, jaws.law.mode) == (-100.0, CLOSE)
    assert jaws.run(CLOSE, 0.2) is GrappleState.HOLDING and (jaws.law.spool_pct, jaws.law.mode) == (0.0, HOLD)


def test_grapple_never_opens_by_itself():
    jaws = Jaws()
    jaws.run(CLOSE, 0.5, 20.0, 60.0)
    assert jaws.run(CLOSE, 0.2, HIGH, 30.0) is GrappleState.HOLDING
    for wanted in (GrappleCommand.NEUTRAL, HOLD, CLOSE):
        jaws.law.step(wanted, 0.0, 0.0, 0.0, jaws.now_ns)
        jaws.law.release()
        assert jaws.law.mode is HOLD
    jaws.run(OPEN, 0.1, 0.0, 50.0)
    assert jaws.run(OPEN, 0.1, 0.0, 98.5) is GrappleState.OPEN


def test_closing_takes_longer_while_the_pressure_is_low():
    jaws = Jaws()
    assert jaws.run(CLOSE, 5.0, 10.0, 40.0) is GrappleState.CLOSING
    assert jaws.run(CLOSE, 0.5, 10.0, 40.0) is GrappleState.HOLDING


def test_pressure_kick_is_no_grip():
    jaws = Jaws()
    jaws.run(CLOSE, 0.04, HIGH, 99.0)
    assert jaws.run(CLOSE, 1.0, 30.0, 60.0) is GrappleState.CLOSING


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
    jaws = Jaws()
    jaws.run(CLOSE, seconds, 40.0, opening)
    assert jaws.run(CLOSE, 0.1, HIGH, opening) is state and jaws.law.mode is HOLD


def test_measured_load_means_holding():
    """A thin log between interleaved jaws: fully closed, and yet not empty."""
    jaws = Jaws()
    jaws.run(CLOSE, 3.4, 40.0, 1.0)
    jaws.run(CLOSE, 0.1, HIGH, 1.0)
    now = jaws.now_ns
    for k, kg in enumerate((0.5 * LOADED_KG, 0.5 * LOADED_KG, math.nan)):
        jaws.law.observe_load(kg, now + k * SECOND)
    assert jaws.law.state is GrappleState.CLOSED and not jaws.law.loaded
    now += 3 * SECOND
    jaws.law.observe_load(2.0 * LOADED_KG, now)
    assert jaws.law.state is GrappleState.CLOSED, "a swing of the empty grapple"
    jaws.law.observe_load(2.0 * LOADED_KG, now + SECOND // 2)
    assert jaws.law.state is GrappleState.HOLDING and jaws.law.loaded
    jaws.law.observe_load(0.0, now + SECOND)
    assert jaws.law.state is GrappleState.HOLDING and not jaws.law.loaded, "a log on the ground is still held"
    jaws.law.observe_load(2.0 * LOADED_KG, now + SECOND)
    jaws.law.step(OPEN, 0.0, 1.0, 0.0, now + SECOND)
    jaws.law.observe_load(2.0 * LOADED_KG, now + 2 * SECOND)
    assert jaws.law.state is GrappleState.OPENING and not jaws.law.loaded


def test_load_cell_sets_loaded():
    bench = Bench().armed()
    bench.keep(1100, grapple=CLOSE)
    assert not bench.controller.crane.grapple.loaded
    bench.changed["GrappleStat"] = {"Load": 80.0}
    bench.keep(200, grapple=CLOSE)
    assert bench.controller.crane.grapple.loaded and bench.reports[-1].load_kg == 80.0


def held(opening):
    jaws = Jaws()
    jaws.run(CLOSE, 2.0, 40.0, opening)
    jaws.run(CLOSE, 0.1, HIGH, opening)
    return jaws


def test_jammed_jaws_are_shaken_loose():
    jaws = held(20.0)
    jaws.run(OPEN, 0.9, 0.0, 20.5)
    assert jaws.law.mode is OPEN
    assert jaws.run(OPEN, 0.2, 0.0, 20.5) is GrappleState.OPENING and (jaws.law.mode, jaws.law.spool_pct) == (
        CLOSE,
        -100.0,
    )
    jaws.run(OPEN, 0.3, 0.0, 20.0)
    assert jaws.law.mode is OPEN
    jaws.run(OPEN, 0.5, 0.0, 60.0)
    assert jaws.run(OPEN, 0.1, 0.0, 99.0) is GrappleState.OPEN


def test_shaking_ends_after_its_limit():
    jaws = held(20.0)
    shakes, before = 0, OPEN
    for _ in range(4000):
        jaws.run(OPEN, 1 / 200, 0.0, 20.0, HIGH)
        shakes += jaws.law.mode is CLOSE and before is not CLOSE
        before = jaws.law.mode
    assert shakes == 3 and jaws.law.spool_pct == 0.0


def test_full_pressure_at_once_means_jammed_without_a_sensor():
    jaws = held(math.nan)
    jaws.run(OPEN, 0.2, 0.0, math.nan, HIGH)
    assert jaws.law.mode is CLOSE
    jaws = held(math.nan)
    jaws.run(OPEN, 2.0, 0.0, math.nan, 30.0)
    assert jaws.run(OPEN, 0.1, 0.0, math.nan, HIGH) is GrappleState.OPEN, "pressure at the end of the stroke means open"


def test_jaws_of_unknown_state_are_not_shaken():
    jaws = Jaws()
    jaws.run(OPEN, 0.3, 0.0, math.nan, HIGH)
    assert jaws.law.mode is not CLOSE


def test_grapple_holds_through_stop_and_fault():
    bench = Bench().armed()
    bench.keep(300, grapple=CLOSE)
    assert bench.commands_b["Grapple"] == -100.0
    bench.keep(800, grapple=CLOSE)
    assert bench.commands_b["GrappleMode"] == HOLD
    for change in ({"ChannelA": 1}, {"ChannelA": 0, "ChannelB": 0}):
        bench.changed["EstopStat"] = change
        bench.run(60)
        assert bench.mode in (Mode.STOP, Mode.FAULT)
        assert bench.neutral and bench.commands_b["GrappleMode"] == HOLD


def test_loose_bundle_is_gripped_again_while_close_is_requested():
    jaws = Jaws()
    jaws.run(CLOSE, 0.5, 20.0, 60.0)
    assert jaws.run(CLOSE, 0.2, HIGH, 40.0) is GrappleState.HOLDING
    assert jaws.run(CLOSE, 0.05, 60.0, 40.0) is GrappleState.HOLDING, "a pressure dip is no loose log"
    assert jaws.run(HOLD, 0.5, 60.0, 40.0) is GrappleState.HOLDING, "HOLD does not close again"
    assert jaws.run(CLOSE, 0.2, 60.0, 40.0) is GrappleState.CLOSING and jaws.law.spool_pct == -100.0
    assert jaws.run(CLOSE, 0.2, HIGH, 35.0) is GrappleState.HOLDING and jaws.law.spool_pct == 0.0
    no_sensor = jaws.run(CLOSE, 1.0, math.nan, 35.0)
    assert no_sensor is GrappleState.HOLDING, "without a pressure sensor nothing counts as loose"


def test_jaws_press_while_they_move_and_a_while_longer():
    jaws = Jaws()
    assert not jaws.law.presses(0)
    jaws.run(CLOSE, 0.3)
    jaws.law.release()
    assert jaws.law.presses(jaws.now_ns + 1_100_000_000) and not jaws.law.presses(jaws.now_ns + 1_300_000_000)
