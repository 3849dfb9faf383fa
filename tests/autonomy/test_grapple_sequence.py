"""The grapple: when jaws may open further, what their report says, and recovery when they hold the wrong thing."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from types import SimpleNamespace

import numpy as np
import pytest

from autonomy.crane_job.grapple import GrappleSequence, is_between_stakes
from autonomy.crane_job.grasp_verification import MAX_RESTARTS, GraspRecovery
from autonomy.crane_job.phases import Phase
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import load_profile
from machine.profile import Bunk
from tests.autonomy.grasp_scenes import MEASURED

AORO = load_profile("aoro_fc8")
ARM = Arm(AORO)
PILE = Bunk((0.4, -2.9), 0.0, 3.0, 2.6, -1.4, 1.5)


def grasp(*diameters_m: float, extracts: bool = False, measured: bool = True) -> Grasp:
    covariance = MEASURED if measured else None
    first, *others = (
        LogObservation(i, (0.0, 4.0, -1.2), (1.0, 0.0, 0.0), 2.6, diameter_m, covariance)
        for i, diameter_m in enumerate(diameters_m or (0.28,), 1)
    )
    return Grasp(first, Pose(0.0, 4.0, -0.4, 0.3, 0.1), -1.3, 0.0, tuple(others), extracts=extracts)


def sequence_at(opening_pct: float, state: int = 5, load_kg: float = nan) -> GrappleSequence:
    """Tongs by what is reported of them."""
    report = SimpleNamespace(opening_pct=opening_pct, grapple_state=state, load_kg=load_kg)
    return GrappleSequence(load_profile("palms_471"), SimpleNamespace(report=report))


def weighs(sequence: GrappleSequence, load_kg: float, command: GrappleCommand) -> None:
    """A step in which the load cell shows this."""
    sequence._inbox.report.load_kg = load_kg
    sequence.apply(command, 0.05)


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
    ("opening_pct", "diameters_m", "wide"),
    [
        (67.0, [0.13], True),  # the sides of the heap that the log lies on
        (50.0, [0.13], False),
        (67.0, [0.3, 0.28], False),
        (71.0, [0.3, 0.28], True),
        (nan, [0.13], False),  # no sensor
    ],
)
def test_jaws_stall_wide_by_what_they_should_hold(opening_pct: float, diameters_m: list[float], wide: bool) -> None:
    assert sequence_at(opening_pct).is_stalled_wide(grasp(*diameters_m)) is wide


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
def test_jaws_tell_that_they_have_missed(opening_pct, state, diameter_m, drawn, missed) -> None:
    assert sequence_at(opening_pct, state).has_missed(grasp(diameter_m, extracts=drawn)) is missed


@pytest.mark.parametrize(("load_kg", "missed"), [(57.0, False), (4.0, True), (nan, True)])
def test_what_the_load_cell_weighs_in_fully_closed_jaws_was_not_missed(load_kg: float, missed: bool) -> None:
    """A log of 19 cm was measured as 21 cm, which leaves a gap: these jaws are full."""
    tongs = sequence_at(0.0, 4, load_kg)
    for _ in range(20):
        tongs.apply(GrappleCommand.CLOSE, 0.05)
    assert tongs.has_missed(grasp(0.21)) is missed


@pytest.mark.parametrize(("loads_kg", "nothing"), [((0.0, 16.0, 13.0, 14.0), False), ((6.0, 0.0, 0.0, 3.0), True)])
def test_the_mean_of_noisy_readings_tells_a_thin_log_from_nothing(loads_kg: tuple[float, ...], nothing: bool) -> None:
    """Measured: a log of 12 cm reads 0 to 16 kg while it swings, empty jaws 0 to 6 kg."""
    tongs = sequence_at(0.0, 4, nan)
    for k in range(60):
        weighs(tongs, loads_kg[k // 3 % len(loads_kg)], GrappleCommand.HOLD)
        assert k < 40 or tongs.lifts_nothing is nothing, k
        assert k < 40 or nothing or not tongs.holds_nothing, "a single reading of nothing is no reason to let go"


@pytest.mark.parametrize(
    ("loads_kg", "diameter_m", "lost"),
    [
        ([0.0, 5.0, 11.0] * 8, 0.25, True),
        ([0.0, 5.0, 30.0] * 8, 0.25, False),  # it swings
        ([0.0] * 15, 0.25, False),  # not for long enough
        ([0.0, 5.0, 11.0] * 8, 0.15, False),  # a thin one weighs little
        ([nan] * 24, 0.25, False),  # no load cell
        ([0.0, 5.0, 7.0] * 8 + [2.0] * 24, 0.25, False),  # estimated while the crane stood, and then kept
    ],
)
def test_a_thick_load_that_weighs_nothing_for_a_second_was_lost(loads_kg, diameter_m, lost) -> None:
    """Also where the jaws have not closed fully: they pressed on a log, slid off, and still close."""
    sequence = sequence_at(40.0, 3)
    for load_kg in loads_kg:
        weighs(sequence, load_kg, GrappleCommand.CLOSE)
    assert sequence.has_lost(grasp(diameter_m)) is lost


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
    sequence, held = sequence_at(nan), grasp(0.25)
    for load_kg, command in zip(loads_kg, ["HOLD", *["OPEN"] * 4], strict=False):
        weighs(sequence, load_kg, GrappleCommand[command])
    assert sequence.is_obstructed is pushed
    if pushed:
        sequence.release(0.05)
        assert sequence.command is GrappleCommand.CLOSE and sequence.is_obstructed
        assert not sequence.has_released(held, 10.0)
        sequence._inbox.report.load_kg = 90.0
        for _ in range(10):
            sequence.release(0.05)
        assert sequence.command is GrappleCommand.NEUTRAL
        assert not sequence.has_released(held, 10.0), "the crane still swings"
        for _ in range(10):
            sequence.release(0.05)
        assert sequence.has_released(held, 0.3)
    sequence.apply(GrappleCommand.CLOSE, 0.05)
    assert not sequence.is_obstructed


@pytest.mark.parametrize(
    ("opening_pct", "laden_kg", "rests_kg", "again"),
    [
        (nan, 131.0, 120.0, 2),
        (nan, 131.0, 20.0, 0),  # it fell out
        (nan, 50.0, 45.0, 0),  # too light to tell
        (30.0, 131.0, 120.0, 0),  # a sensor tells how far they have opened
    ],
)
def test_jaws_in_which_the_log_fell_as_they_opened_open_again(opening_pct, laden_kg, rests_kg, again) -> None:
    """It read 28 and then 404 kg, taken for a push: they stopped, and the mission failed with the log in them."""
    sequence, held = sequence_at(opening_pct), grasp(0.25)
    sequence.laden_kg = laden_kg
    for load_kg in (laden_kg, 28.0, 404.0, 30.0):
        weighs(sequence, load_kg, GrappleCommand.OPEN)
    assert sequence.is_obstructed
    opened = 0
    for _ in range(4):
        for _ in range(40):
            weighs(sequence, rests_kg, sequence.command)
            before = sequence.is_obstructed
            sequence.release(0.05)
            opened += before and sequence.command is GrappleCommand.OPEN
            if before and not sequence.is_obstructed:
                assert not sequence.has_released(held, 10.0), "the jaws have only begun to open"
        for load_kg in (28.0, 404.0, 30.0):
            weighs(sequence, load_kg, GrappleCommand.OPEN)
    assert opened == again


@pytest.mark.parametrize(
    ("opening_pct", "others", "higher"), [(30.0, 0, True), (95.0, 0, False), (30.0, 1, False), (nan, 0, False)]
)
def test_jaws_that_pushed_and_still_enclose_the_log_must_open_higher(opening_pct, others, higher) -> None:
    """Risen, they would lift the log again, and drop it when they open above the stakes."""
    sequence, held = sequence_at(opening_pct), grasp(*[0.25] * (1 + others))
    for load_kg in (80.0, 10.0, 400.0):
        weighs(sequence, load_kg, GrappleCommand.OPEN)
    assert sequence.is_obstructed and not sequence.must_open_higher(held), "they still push"
    sequence._inbox.report.load_kg = 90.0
    for _ in range(20):
        sequence.release(0.05)
    assert sequence.must_open_higher(held) is higher
    assert sequence.has_released(held, 10.0) is not higher


@pytest.mark.parametrize(
    ("laden_kg", "read_kg", "rests"), [(120.0, 30.0, True), (120.0, 60.0, False), (30.0, 0.0, False)]
)
def test_a_load_that_weighs_little_on_the_way_down_rests(laden_kg: float, read_kg: float, rests: bool) -> None:
    sequence = sequence_at(20.0, load_kg=read_kg)
    sequence.laden_kg = laden_kg
    sequence.apply(GrappleCommand.HOLD, 0.05)
    assert not sequence.load_rests, "a single reading"
    for _ in range(3):
        sequence.apply(GrappleCommand.HOLD, 0.05)
    assert sequence.load_rests is rests


@pytest.mark.parametrize(
    ("opening_pct", "laden_kg", "read_kg", "asked", "kept"),
    [
        (nan, 200.0, 80.0, True, True),
        (nan, 200.0, 60.0, True, False),
        (nan, 70.0, 28.0, True, False),  # an empty crane may read as much
        (nan, 50.0, 50.0, False, True),  # too light to ask
        (60.0, 200.0, 80.0, False, True),  # a sensor tells
    ],
)
def test_the_load_tells_whether_risen_jaws_have_kept_a_log(opening_pct, laden_kg, read_kg, asked, kept) -> None:
    sequence = sequence_at(opening_pct, load_kg=read_kg)
    sequence.laden_kg = laden_kg
    sequence.apply(GrappleCommand.NEUTRAL, 0.05)
    assert (sequence.may_keep_load, sequence.has_kept_load) == (asked, kept)


# -- recovery
class Told(SimpleNamespace):
    """A grapple whose state the test sets."""

    is_still, empty, wide, missed, holds_nothing = True, False, False, False, False

    def is_stalled_wide(self, grasp: Grasp) -> bool:
        return self.wide

    def has_missed(self, grasp: Grasp) -> bool:
        return self.missed


@pytest.mark.parametrize(
    ("tongs", "measured", "phase"),
    [
        (Told(), True, Phase.LIFT),
        (Told(wide=True), True, Phase.LIFT),
        (Told(wide=True, is_still=False), True, None),
        (Told(missed=True, is_still=False), True, None),
        (Told(wide=True), False, Phase.LIFT),
        (Told(missed=True, empty=True), False, Phase.LIFT),
    ],
    ids=["held", "wide", "wide, moving", "missed, moving", "wide on a known log", "missed a known log"],
)
def test_still_jaws_lift_what_they_clasp_and_known_logs_as_they_are(tongs, measured: bool, phase: Phase | None) -> None:
    held = grasp(measured=measured)
    assert GraspRecovery().after_closing(held, tongs) == (phase, held)


def test_a_miss_restarts_from_above_a_few_times() -> None:
    regrip = GraspRecovery()
    phases = [regrip.after_closing(grasp(), Told(missed=True, empty=True))[0] for _ in range(MAX_RESTARTS + 1)]
    assert phases == [Phase.ABOVE] * MAX_RESTARTS + [Phase.LIFT]


def test_a_pinched_log_in_a_row_is_dragged_once_before_a_restart() -> None:
    regrip = GraspRecovery()
    phase, now = regrip.after_closing(grasp(extracts=True), Told(missed=True))
    assert phase is Phase.CLOSE and now.dragging
    phase, now = regrip.after_closing(now, Told(missed=True))
    assert phase is Phase.ABOVE and not now.dragging
    phase, _ = regrip.after_closing(grasp(extracts=True), Told(missed=True, empty=True))
    assert phase is Phase.ABOVE, "nothing to drag"


def test_jaws_that_rise_empty_restart_as_often_as_jaws_that_closed_on_nothing() -> None:
    regrip, empty = GraspRecovery(), Told(empty=True, holds_nothing=True)
    assert regrip.after_rising(grasp(), Told()) is None
    assert regrip.after_rising(grasp(), Told(holds_nothing=True, is_still=False)) is None, "they may close on it yet"
    assert regrip.after_rising(grasp(measured=False), empty) is None
    restarts = [regrip.after_rising(grasp(), empty) is not None for _ in range(MAX_RESTARTS + 1)]
    assert restarts == [True] * MAX_RESTARTS + [False]


def row(*across_m: float) -> Grasp:
    first, *others = (replace(grasp().log, id=i, center_m=(0.0, 4.0 + y, -1.2)) for i, y in enumerate(across_m, 1))
    return replace(grasp(), log=first, others=tuple(others))


def test_after_a_failed_row_its_inner_logs_are_excluded() -> None:
    regrip, wide, empty = GraspRecovery(), row(0.3, -0.3, 0.0), Told(empty=True, holds_nothing=True)
    regrip.after_closing(wide, Told(wide=True))
    assert regrip.after_rising(wide, empty) is not None and regrip.excluded_logs == (3,)
    drawn = replace(row(0.3), extracts=True)
    regrip.after_closing(drawn, Told(missed=True, empty=True))
    assert regrip.excluded_logs == (3, 1)
    regrip.after_closing(row(0.3), Told(wide=True))
    assert regrip.after_rising(row(0.3), empty) is None, "twice, and no more"


@pytest.mark.parametrize(("across_m", "wide"), [((0.0, 0.3), True), ((0.3, -0.3, 0.0), False)])
def test_no_inner_logs_are_excluded_of_two_or_where_the_jaws_had_closed(across_m, wide) -> None:
    regrip = GraspRecovery()
    regrip.after_closing(row(*across_m), Told(wide=wide))
    regrip.after_rising(row(*across_m), Told(holds_nothing=True))
    assert regrip.restart_count == 1 and regrip.excluded_logs == ()
