"""The grapple: when opening jaws may open further, and what their report says."""

from __future__ import annotations

from math import nan
from types import SimpleNamespace

import numpy as np
import pytest

from autonomy.crane_job.grapple import GrappleSequence, is_between_stakes
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.grasp import Grasp
from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import load_profile
from machine.profile import Bunk

AORO = load_profile("aoro_fc8")
ARM = Arm(AORO)
PILE = Bunk((0.4, -2.9), 0.0, 3.0, 2.6, -1.4, 1.5)


@pytest.mark.parametrize("bunk", [AORO.bunk, PILE])
def test_jaws_are_between_the_stakes_until_the_open_tips_are_above_them(bunk: Bunk) -> None:
    top = bunk.floor_z_m + bunk.stake_height_m + tip_below_pin_m(AORO.grapple.jaws, 0.0)
    high = travel_height_m(AORO)
    for above_m, among in ((-0.3, True), (-0.05, True), (0.05, False), (0.3, False)):
        q = ARM.joints(np.array([ARM.pose_above(*bunk.center_m, top + above_m, high)]))[0].tolist()
        assert is_between_stakes(ARM, bunk, tuple(q)) is among


def test_beside_the_bunk_jaws_may_open_at_any_height() -> None:
    q = ARM.joints(np.array([ARM.pose_above(*PILE.center_m, 0.0, travel_height_m(AORO))]))[0].tolist()
    assert is_between_stakes(ARM, PILE, tuple(q)) and not is_between_stakes(ARM, AORO.bunk, tuple(q))


@pytest.mark.parametrize(
    ("opening_pct", "diameters_m", "climbs", "wide"),
    [
        (67.0, [0.13], 0, True),  # the sides of the heap that the log lies on
        (50.0, [0.13], 0, False),
        (67.0, [0.3, 0.28], 0, False),
        (71.0, [0.3, 0.28], 0, True),
        (69.0, [0.3, 0.28], 0, False),
        (69.0, [0.3, 0.28], 1, True),  # higher up a heap there is less
        (nan, [0.13], 3, False),  # no sensor
    ],
)
def test_jaws_stall_wide_by_what_they_should_hold(
    opening_pct: float, diameters_m: list[float], climbs: int, wide: bool
) -> None:
    logs = [LogObservation(i, (0.0, 4.0, -1.0), (1.0, 0.0, 0.0), 2.6, d) for i, d in enumerate(diameters_m)]
    grasp = Grasp(logs[0], Pose(0.0, 4.0, 0.0, 0.0, 0.0), -1.2, 0.0, tuple(logs[1:]))
    assert sequence_at(opening_pct).is_stalled_wide(grasp, climbs) is wide


@pytest.mark.parametrize(
    ("opening_pct", "state", "diameter_m", "drawn", "missed"),
    [
        (0.0, 4, 0.3, False, True),  # shut on nothing
        (0.0, 4, 0.15, False, False),  # a thin log may be in them
        (56.0, 5, 0.28, True, True),  # its upper half is pinched
        (20.0, 5, 0.28, True, False),
        (56.0, 5, 0.28, False, False),
        (nan, 0, 0.28, True, False),
    ],
)
def test_jaws_tell_that_they_have_missed(
    opening_pct: float, state: int, diameter_m: float, drawn: bool, missed: bool
) -> None:
    log = LogObservation(0, (0.0, 4.0, -1.0), (1.0, 0.0, 0.0), 2.6, diameter_m)
    grasp = Grasp(log, Pose(0.0, 4.0, 0.0, 0.0, 0.0), -1.2, 0.0, extracts=drawn)
    assert sequence_at(opening_pct, state).has_missed(grasp) is missed


@pytest.mark.parametrize(
    ("state", "load_kg", "nothing"), [(4, 2.0, True), (4, 15.0, False), (5, 2.0, False), (4, nan, False)]
)
def test_closed_jaws_that_weigh_nothing_hold_nothing(state: int, load_kg: float, nothing: bool) -> None:
    assert sequence_at(0.0, state, load_kg).holds_nothing is nothing


@pytest.mark.parametrize(
    ("loads_kg", "pushed"),
    [
        ((80.0, 60.0, 10.0, 120.0, 357.0), True),  # a tip comes to bear on what lies beside
        ((80.0, 60.0, 10.0, 120.0, 40.0), False),  # what was let go swings on
        ((300.0, 310.0, 300.0), False),  # it still holds the bundle
        ((300.0, 10.0, 400.0, 20.0), False),  # a bundle's rebound
        ((nan, nan, nan), False),
    ],
)
def test_opening_jaws_that_bear_a_load_push(loads_kg: tuple[float, ...], pushed: bool) -> None:
    sequence = sequence_at(nan)
    log = LogObservation(0, (0.0, 4.0, -1.0), (1.0, 0.0, 0.0), 2.6, 0.25)
    grasp = Grasp(log, Pose(0.0, 4.0, 0.0, 0.0, 0.0), -1.2, 0.0)
    for load_kg, command in zip(loads_kg, ["HOLD", *["OPEN"] * 4], strict=False):
        sequence._inbox.report.load_kg = load_kg
        sequence.apply(GrappleCommand[command], 0.05)
    assert sequence.is_obstructed is pushed
    if pushed:
        sequence.release(0.05)
        assert (
            sequence.command is GrappleCommand.CLOSE
            and sequence.is_obstructed
            and not sequence.has_released(grasp, 10.0)
        )
        sequence._inbox.report.load_kg = 90.0
        for _ in range(10):
            sequence.release(0.05)
        assert sequence.command is GrappleCommand.NEUTRAL and not sequence.has_released(grasp, 10.0), (
            "the crane still swings"
        )
        for _ in range(10):
            sequence.release(0.05)
        assert sequence.has_released(grasp, 0.3)
    sequence.apply(GrappleCommand.CLOSE, 0.05)
    assert not sequence.is_obstructed


def sequence_at(opening_pct: float, state: int = 5, load_kg: float = nan) -> GrappleSequence:
    """Tongs by what is reported of them."""
    report = SimpleNamespace(opening_pct=opening_pct, grapple_state=state, load_kg=load_kg)
    return GrappleSequence(load_profile("palms_471"), SimpleNamespace(report=report))
