"""Logs that no camera sees are remembered; what is on board is known from weight and looks, and said if it differs."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.planner import Grasp, hangs_below, restricted_to
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.manager.load_bookkeeping import LOOKS, MIN_HITS, FallenLogs, LoadBookkeeping
from autonomy.manager.load_detector import MIN_WEIGHED, WINDOW_NS, WoodScale, gripped_by_weight
from autonomy.manager.log_map import LogMap, MappedLog
from autonomy.manager.log_memory import PERIOD_NS, Grip, LogMemory
from autonomy.manager.sorting import Sorting
from autonomy.manager.tally import LoadedLog
from autonomy.manager.transition_table import State
from autonomy.missions.model import ForwardingMission, Point
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import StandIn, over_bunk
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import PLANE, begin, ended, managed, whole
from tests.autonomy.mapped_logs import base, lying, seen
from tests.codes import numbers_in

PROFILE = load_profile("aoro_fc8")
ARM = Arm(PROFILE)
HERE = base(0.0, 0.0, math.pi)


def field_of(*places: tuple[float, float], yaw_rad: float = 0.3) -> LogMap:
    """A field with logs that were seen twice, 0.15 m over the ground under a base that is 1.5 m up."""
    field = LogMap(PROFILE.bunk)
    logs = [lying(i, x, y, yaw_rad) for i, (x, y) in enumerate(places)]
    for k in range(2):
        field.observe(seen(logs, HERE), HERE, k)
    return field


def grasp_of(logs: list[MappedLog]) -> Grasp:
    first, *others = (log.observation(HERE) for log in logs)
    return replace(plan_single_log_grasp(ARM, first, 0.0), others=tuple(others))


class Hands:
    """A job that grasps the first ``meant`` logs of a field, with a pose and a load that the test sets."""

    def __init__(self, field: LogMap, meant: int = 1) -> None:
        self.memory, self.field, self.now_ns = LogMemory(PROFILE), field, 0
        self.load_kg = math.nan
        self.grasp = grasp_of(field.logs[:meant])
        self.job: Any = SimpleNamespace(grasp=self.grasp, phase=Phase.LOOK, judged_by_picture=False, failure=None)
        self.to(self.grasp.pose)

    def to(self, pose: Pose) -> None:
        self.q = self.job.last_setpoint = tuple(ARM.joints(np.array([pose]))[0].tolist())

    def rise(self) -> None:
        """Close, lift, and go up by a metre."""
        self.step(Phase.CLOSE)
        self.step(Phase.LIFT)
        self.to(self.grasp.pose.at_height(self.grasp.pose.z_m + 1.0))

    def step(self, phase: Phase | None = None) -> tuple[LogObservation, ...]:
        """One step of the memory."""
        if phase is not None:
            self.job.phase = phase
        self.now_ns += PERIOD_NS
        report: Any = SimpleNamespace(stamp_ns=self.now_ns, position=self.q, load_kg=self.load_kg)
        logs = self.memory.log_list(self.now_ns, self.field, HERE, report, self.job)
        assert logs is not None
        return logs

    def place(self, load_kg: float) -> list[int]:
        """Lift, carry and release; the numbers of the logs that were thought to hang."""
        self.load_kg = 0.0
        self.step(Phase.CLOSE)
        self.load_kg = load_kg
        self.step(Phase.LIFT)
        self.to(self.grasp.pose.at_height(self.grasp.pose.z_m + 1.0))
        for _ in range(20):
            carried = self.step(Phase.CARRY)
        hanging = [log.id for log in carried if log.center_m[2] > self.grasp.log.center_m[2] + 0.4]
        self.to(ARM.pose_above(*PROFILE.bunk.center_m, 1.7, 2.0))
        self.step(Phase.OPEN)
        return hanging


def test_logs_on_the_ground_stay_in_the_plane_while_the_machine_moves() -> None:
    field, memory = field_of((-4.0, 3.0), (-4.0, -30.0)), LogMemory(PROFILE)
    (first,) = memory.log_list(PERIOD_NS, field, HERE, None, None) or ()
    assert memory.log_list(PERIOD_NS + 1, field, HERE, None, None) is None, "four times a second"
    there = base(2.0, 1.0, math.pi)
    (after,) = memory.log_list(2 * PERIOD_NS, field, there, None, None) or ()
    assert first.id == after.id == field.logs[0].number
    assert there.to_base(np.array(after.center_m)) == pytest.approx(HERE.to_base(np.array(first.center_m)))


def test_a_log_goes_with_the_grapple_and_stays_in_the_bunk() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    grasp = hands.grasp
    for phase in (Phase.LOOK, Phase.ABOVE, Phase.CLOSE, Phase.LIFT):
        (log,) = hands.step(phase)
        assert log.center_m == pytest.approx(grasp.log.center_m, abs=0.02)
    hands.load_kg = 80.0
    high = grasp.pose.at_height(grasp.pose.z_m + 1.0)
    hands.to(high)
    (log,) = hands.step(Phase.CARRY)
    assert log.center_m[2] == pytest.approx(grasp.log.center_m[2] + 1.0, abs=0.02) and hangs_below(ARM, log, high)
    place = ARM.pose_above(*PROFILE.bunk.center_m, 1.7, 2.0)
    hands.to(place)
    (log,) = hands.step(Phase.OPEN)
    assert lies_in_bunk(PROFILE.bunk, log)
    assert log.center_m[2] == pytest.approx(PROFILE.bunk.floor_z_m + log.diameter_m / 2), "it fell to the floor"
    hands.to(place.at_height(1.9))
    hands.step(Phase.DONE)
    hands.field.remove(grasp.log.id)
    hands.job = None
    (aboard,) = hands.step()
    assert aboard.center_m == pytest.approx(log.center_m) and hands.memory.in_bunk == 1


def test_a_log_that_the_scale_does_not_detect_stays_on_the_ground() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.load_kg = 3.0
    hands.rise()
    for _ in range(WINDOW_NS // PERIOD_NS + 2):
        (log,) = hands.step()
    assert log.center_m == pytest.approx(hands.grasp.log.center_m, abs=1e-6)
    assert hands.memory.in_bunk == 0


def test_a_load_that_only_a_picture_can_judge_hangs_whatever_the_scale_reads() -> None:
    """A log of 20 kg reads 3 kg one time in six: the jaws opened on the way, and it fell."""
    hands = Hands(field_of((-4.0, 3.0)))
    hands.job.judged_by_picture = True
    assert hands.place(load_kg=0.0) == [hands.grasp.log.id]


def test_a_load_that_no_picture_showed_is_not_remembered_in_the_bunk() -> None:
    for leaves in (False, True):
        hands = Hands(field_of((-4.0, 3.0)))
        hands.place(load_kg=90.0)
        if leaves:
            hands.memory.leave()
        hands.memory.log_list(hands.now_ns, hands.field, HERE, None, None)
        assert hands.memory.in_bunk == (not leaves)


def test_a_short_low_reading_does_not_lose_the_log() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.load_kg = 90.0
    hands.rise()
    for load_kg in (130.0, 160.0, 110.0, 90.0, 40.0, 3.0, 0.0, 0.0, 30.0, 90.0, 110.0):
        hands.load_kg = load_kg
        (log,) = hands.step()
        assert log.center_m[2] > hands.grasp.log.center_m[2] + 0.9


def test_without_a_scale_the_log_is_assumed_to_hang() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.rise()
    (log,) = hands.step()
    assert log.center_m[2] > hands.grasp.log.center_m[2] + 0.9


def test_a_load_that_a_camera_has_seen_hangs_as_it_was_seen() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.rise()
    (log,) = hands.step()
    yaw = math.atan2(log.axis[1], log.axis[0]) + 0.6
    report = SimpleNamespace(stamp_ns=hands.now_ns, position=hands.q, load_kg=math.nan)
    # Its other end first, and without its middle: only the direction counts.
    shown = replace(log, id=9, axis=(-math.cos(yaw), -math.sin(yaw), 0.0), length_m=1.0)
    hands.memory.correct(shown, report)
    (after,) = hands.step()
    assert math.remainder(math.atan2(after.axis[1], after.axis[0]) - yaw, math.pi) == pytest.approx(0.0, abs=1e-9)
    assert after.length_m == log.length_m and after.id == log.id


def side_by_side(meant: int) -> Hands:
    """Two logs, of which the grasp is meant for so many."""
    return Hands(field_of((-4.0, 3.0), (-4.0, 3.3), yaw_rad=0.0), meant)


# -- counted by weight and looks
def weighed(share: float) -> WoodScale:
    wood = WoodScale()
    for _ in range(MIN_WEIGHED):
        wood.learn(share * 100.0, 100.0)
    return wood


@pytest.mark.parametrize(
    ("read_kg", "meant", "beside", "gripped"),
    [
        (175.0, {1: 96.0, 2: 78.0}, {}, {1, 2}),
        (98.0, {1: 96.0, 2: 78.0}, {}, {1}),
        (100.0, {1: 96.0, 2: 18.0}, {}, {1, 2}),  # no scale tells a thin log from none beside a thick one
        (92.0, {1: 88.0}, {2: 90.0}, {1}),
        (185.0, {1: 88.0}, {2: 90.0}, {1, 2}),
        (120.0, {1: 88.0}, {2: 18.0}, {1}),
    ],
)
def test_the_weight_tells_which_logs_came_up(read_kg, meant, beside, gripped) -> None:
    assert gripped_by_weight(read_kg, meant, beside, weighed(1.0)) == gripped


def test_wood_that_is_lighter_than_green_is_learned_from_single_logs() -> None:
    """Two dry logs weigh what one green log does: only the logs before tell."""
    two = {1: 96.0, 2: 90.0}
    assert gripped_by_weight(112.0, two, {}, weighed(0.6)) == {1, 2}
    assert gripped_by_weight(60.0, two, {}, weighed(0.6)) != {1, 2}


def test_a_light_log_teaches_nothing_about_the_wood() -> None:
    wood = WoodScale()
    for _ in range(MIN_WEIGHED):
        wood.learn(50.0, 20.0)
    assert wood.share == 1.0


def test_a_log_that_did_not_come_up_still_lies_there() -> None:
    hands = side_by_side(meant=2)
    numbers = [log.number for log in hands.field.logs]
    assert hands.place(95.0) == numbers[:1]
    grip = hands.memory.grip
    assert grip.left == (numbers[1],) and not grip.also
    assert grip.read_kg == pytest.approx(95.0)


def test_a_load_that_rests_on_others_is_no_longer_weighed() -> None:
    """On its way down it came to weigh half, and one of two logs on board was told to lie in the forest."""
    hands = side_by_side(meant=2)
    hands.load_kg = 190.0
    hands.rise()
    for _ in range(20):
        hands.step(Phase.CARRY)
    hands.load_kg = 60.0
    for _ in range(20):
        hands.step(Phase.LOWER)
    hands.step(Phase.OPEN)
    assert hands.memory.grip is not None and not hands.memory.grip.left
    assert hands.memory.grip.read_kg == pytest.approx(190.0)


def test_a_log_beside_the_grasp_that_came_up_is_on_board() -> None:
    hands = side_by_side(meant=1)
    numbers = [log.number for log in hands.field.logs]
    hands.place(190.0)
    grip = hands.memory.grip
    assert [log.id for log in grip.also] == numbers[1:]
    hands.job.phase = Phase.DONE
    for number in numbers:
        hands.field.remove(number)
    hands.memory.log_list(hands.now_ns + PERIOD_NS, hands.field, HERE, None, None)
    assert hands.memory.in_bunk == 2


class UnsensedJaws(StandIn):
    """Neither rotator nor opening is measured; ``empty_kg``: what the scale reads of nothing."""

    empty_kg = 0.0

    def report(self) -> StateReport:
        said = super().report()
        load_kg = said.load_kg if self.held is not None else self.empty_kg
        return replace(said, position=(*said.position[: Joint.ROT], math.nan), load_kg=load_kg)


class Books:
    """Bookkeeping of a mission without landings, and looks into the bunk."""

    def __init__(self) -> None:
        self.field = LogMap(PROFILE.bunk)
        told = ForwardingMission("test", (Point(0.0, 0.0), Point(0.0, 0.001)))
        self.world: Any = SimpleNamespace(
            sorting=Sorting(told),
            in_bunk=0,
            counted_ns=0,
            grip=None,
            log_map=self.field,
            base=HERE,
            map_number=lambda listed: listed,
            plane=SimpleNamespace(geodetic=lambda x, y: (x, y, 0.0)),
            is_on_landing=lambda log: False,
        )
        self.load = LoadBookkeeping(PROFILE, told, self.world)
        self.now_ns = 0

    def book(self, *diameters_m: float, is_seen: bool = False) -> None:
        logs = [replace(lying(7 + i, -4.0, 3.0 + i, 0.0), diameter_m=d) for i, d in enumerate(diameters_m)]
        self.now_ns += PERIOD_NS
        self.load.book_loaded(
            SimpleNamespace(grasp=grasp_of(logs), judged_by_picture=is_seen, failure=None), self.now_ns
        )

    def look(self, in_bunk: int, times: int = LOOKS, driven_m: float = 5.0) -> None:
        for _ in range(times):
            self.now_ns += PERIOD_NS
            self.world.in_bunk, self.world.counted_ns = in_bunk, self.now_ns
            self.load.check_bunk(self.now_ns, driven_m)

    def said(self) -> list[str]:
        return [remark.text for remark in self.load.tally.remarks]


def test_a_log_that_is_no_longer_in_the_bunk_is_lost_and_said() -> None:
    books = Books()
    books.look(0)
    books.book(0.2)
    books.book(0.3)
    books.look(2, driven_m=40.0)
    volume_m3 = books.load.tally.board_m3
    books.look(1, times=LOOKS - 1, driven_m=43.0)
    assert books.load.tally.loaded == 2 and not books.said(), "one look may be wrong"
    books.look(1, times=1, driven_m=44.0)
    tally = books.load.tally
    assert (tally.loaded, tally.on_board, len(tally.board)) == (1, 1, 1) and 0.0 < tally.board_m3 < volume_m3
    (text,) = books.said()
    assert {40, 44} <= set(numbers_in(text))
    books.look(1)
    assert len(books.said()) == 1


def test_two_logs_in_one_grip_are_both_counted() -> None:
    books = Books()
    books.look(0)
    books.book(0.2)
    books.look(2)
    assert books.load.tally.loaded == books.load.tally.on_board == len(books.load.tally.board) == 2
    assert len(books.said()) == 1


def test_logs_from_before_the_mission_are_not_the_missions() -> None:
    books = Books()
    books.look(3)
    books.book(0.2)
    books.look(4)
    assert books.load.tally.loaded == 1 and not books.said()
    books.look(2)
    assert books.load.tally.loaded == 0, "the mission's log is lost, and one from before"


def test_a_list_from_before_the_release_says_nothing() -> None:
    books = Books()
    books.look(0)
    books.now_ns += 10 * PERIOD_NS
    books.book(0.2)
    for late_ns in range(1, LOOKS + 3):
        books.world.counted_ns = books.now_ns - late_ns
        books.load.check_bunk(books.now_ns, 1.0)
    assert books.load.tally.loaded == 1


def test_what_the_scale_says_of_a_grip_is_booked_and_said() -> None:
    books = Books()
    extra = lying(9, -4.0, 3.4, 0.0).observation(HERE)
    books.world.grip = Grip((extra,), (), 190.0)
    books.book(0.25)
    assert books.load.tally.loaded == 2 and numbers_in(books.said()[0])[:2] == [9, 7]
    books.world.grip = Grip((), (8,), 95.0)
    books.book(0.25)
    assert books.load.tally.loaded == 3 and numbers_in(books.said()[1])[:2] == [8, 7]
    books.world.grip = Grip((), (), 12.0)
    books.book(0.11)
    assert books.load.tally.loaded == 4 and numbers_in(books.said()[2])[0] == 7
    books.world.grip = Grip((), (), 12.0)
    books.book(0.11, is_seen=True)
    assert books.load.tally.loaded == 5 and len(books.said()) == 3, "a picture showed it"
    field = books.field = books.world.log_map = field_of((-4.0, 3.0), (-4.0, 30.0))
    books.world.map_number, books.world.grip = {7: 1, 8: 2}.get, Grip((), (8,), 95.0)
    books.book(0.25, 0.25)
    assert books.load.tally.loaded == 6 and [log.number for log in field.logs] == [2], "it still lies there"


def test_a_log_that_neither_scale_nor_picture_has_shown_is_not_counted_and_stays_on_the_map() -> None:
    books = Books()
    field = books.field = books.world.log_map = field_of((-4.0, 3.0))
    books.world.record_miss = lambda number: field.record_miss(number) >= 3
    (log,) = field.logs
    job: Any = SimpleNamespace(grasp=grasp_of([log]))
    for times in (1, 2, 3):
        books.load.book_unseen(job, times)
        assert (books.load.tally.loaded, books.load.tally.on_board, books.load.tally.missed) == (0, 0, times)
        assert bool(books.load.tally.given_up) is (times == 3)
    assert field.get(log.number) is not None and not field.logs, "it must be seen there again"
    assert [numbers_in(text)[0] for text in books.said()] == [log.number] * 3


@pytest.mark.parametrize(("bed_m", "is_high"), [(0.3, False), (0.9, True)])
def test_a_log_that_lies_as_high_as_the_stakes_is_said(bed_m: float, is_high: bool) -> None:
    """No camera looks into the bunk: five of 17 missions ended with a log above the stakes, and believed it held."""
    bunk, hands, books = PROFILE.bunk, Hands(field_of((-4.0, 3.0))), Books()
    (x, y), c, s = bunk.center_m, math.cos(bunk.yaw_rad), math.sin(bunk.yaw_rad)
    for k in range(-4, 5):
        center_m = (x - 0.2 * k * s, y + 0.2 * k * c, bunk.floor_z_m + bed_m * bunk.stake_height_m)
        bed = replace(hands.grasp.log, id=50 + k, center_m=center_m, axis=(c, s, 0.0))
        hands.memory._in_bunk.append(bed)
    hands.place(90.0)
    grip = hands.memory.grip
    assert grip is not None and grip.high == ((hands.grasp.log.id,) if is_high else ())
    books.world.grip = grip
    books.book(0.25)
    assert [numbers_in(text)[0] for text in books.said()] == list(grip.high)


def test_lost_logs_are_not_reported_to_the_company() -> None:
    books = Books()
    books.look(0)
    books.book(0.2)
    books.book(0.3)
    books.look(1)
    assert all(isinstance(log, LoadedLog) for log in books.load.tally.board)
    books.load.book_empty(books.now_ns, 50.0)
    (load,) = books.load.tally.loads
    assert len(load.logs) == 1


def test_a_grasp_restricted_by_weight_is_booked_without_the_rest() -> None:
    hands = side_by_side(meant=2)
    held = restricted_to(ARM, hands.grasp, hands.place(95.0))
    assert [log.id for log in held.logs] == [hands.grasp.log.id]


@whole
def test_a_log_that_falls_off_the_machine_is_counted_and_loaded_again() -> None:
    forwarder, manager = begin(((1, 15.0, 4.2, 0.0), (2, 32.0, 4.2, 0.0)), end_m=44.0)
    forwarder.run(manager, lambda m: m.tally.loaded == 1 and m.state is State.SEARCH and m.activity is None)
    crane = forwarder.crane
    (aboard,) = [log for log in crane.logs if over_bunk(PROFILE, log.center_m)]
    crane.logs.remove(aboard)
    forwarder.field[aboard.id] = replace(forwarder.field[aboard.id], center_m=np.array([30.0, -4.2, 0.15]))
    forwarder.run(manager, lambda m: bool(m.tally.remarks))
    assert manager.tally.loaded == 0
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and manager.tally.loaded == forwarder.in_bunk == 2


class Ahead(Forwarder):
    """Its only camera looks ahead: it lists logs while the machine drives, and a load that is shown to it."""

    manager: Any = None
    asked = 0

    def seen(self) -> tuple[LogObservation, ...] | None:
        if self.manager is None or self.manager.standpoint(self.crane.now_ns) is None:
            return None
        if not self.manager.shows_load:
            return super().seen()
        self.asked += 1
        return tuple(log for log in self.crane.logs if log.id == self.crane.held)


@whole
@pytest.mark.parametrize("slips", [False, True])
def test_a_thin_log_is_counted_by_its_picture_whatever_the_scale_reads(slips: bool) -> None:
    """20 kg, of which the scale reads 3 where it hangs, and 8 where nothing does."""
    thin = replace(lying(1, 15.0, 4.2, 0.0), diameter_m=0.12)
    machine = Ahead(PROFILE, PLANE, [thin], (0.0, 0.1, 0.05))
    machine.crane = UnsensedJaws(PROFILE, [], q=machine.crane.q, feedback=False, slippery=9 * slips)
    machine.crane.empty_kg, machine.crane.log_kg = 8.0, 3.0
    way = (Point(*PLANE.geodetic(10.0, 0.0)[:2]), Point(*PLANE.geodetic(26.0, 0.0)[:2]))
    machine.manager = manager = managed(ForwardingMission("test", way), plane=PLANE, uses_memory=True)
    machine.run(manager, lambda m: bool(m.tally.loaded or m.tally.missed))
    assert machine.asked and (manager.tally.loaded, manager.tally.missed) == ((0, 1) if slips else (1, 0))
    machine.run(manager, lambda m: m.state is State.STOW)
    machine.steps(manager, 10)
    assert manager.tally.loaded == machine.in_bunk == manager.log_memory.in_bunk
    assert (manager.world.log_map.get(1) is not None) is slips


# -- a log that fell off the machine
def seen_often(number: int, x_m: float, y_m: float) -> MappedLog:
    return replace(lying(number, x_m, y_m, 0.3), hits=MIN_HITS)


def driven(to_m: float = 30.0, next_number: int = 5) -> FallenLogs:
    """The crane's base went east, looking back over the bunk."""
    fallen = FallenLogs(PROFILE.bunk)
    for x_m in range(round(2 * to_m)):
        fallen.passes(base(0.5 * x_m, 0.0, math.pi), next_number)
    return fallen


@pytest.mark.parametrize(
    ("number", "y_m", "fell"),
    [(5, 1.3, True), (5, -1.5, True), (5, 0.0, True), (5, 3.0, False), (4, 1.3, False)],
    ids=["beside", "on the other side", "under it", "where logs are laid", "known before"],
)
def test_a_new_log_where_the_bunk_was_has_fallen_off(number: int, y_m: float, fell: bool) -> None:
    assert bool(driven().fallen([seen_often(number, 12.0, y_m)])) is fell


def test_it_is_told_once_and_only_when_it_is_certain() -> None:
    fallen, log = driven(), seen_often(5, 12.0, 1.3)
    assert not fallen.fallen([replace(log, hits=MIN_HITS - 1)])
    assert fallen.fallen([log]) == [log]
    assert not fallen.fallen([log])


def test_nothing_falls_where_the_machine_has_not_been_or_out_of_an_empty_bunk() -> None:
    fallen, log = driven(to_m=5.0), seen_often(5, 12.0, 1.3)
    assert not fallen.fallen([log])
    fallen = driven()
    fallen.forget()
    assert not fallen.fallen([log])


@pytest.mark.parametrize(("loaded", "landing"), [(3, 1), (1, None)])
def test_a_log_that_fell_off_is_booked_and_said(loaded: int, landing: int | None) -> None:
    """A load of which nothing is left goes nowhere: logs of other landings were never loaded again."""
    books = Books()
    load = books.load
    load.tally.book_loaded([LoadedLog(Point(0.0, 0.0), 1, 0.1)] * loaded)
    load.sorting.landing = 1
    for x_m in range(20):
        books.world.base = base(float(x_m), 0.0, math.pi)
        assert load.check_fallen(x_m) == 0
    books.field.restore(seen_often(1, 8.0, 1.4))
    assert load.check_fallen(30) == 1 and load.check_fallen(31) == 0
    tally = load.tally
    assert (tally.loaded, tally.on_board) == (loaded - 1, loaded - 1) and load.sorting.landing == landing
    (remark,) = tally.remarks
    assert remark.at_ns == 30 and 1 in numbers_in(remark.text)
