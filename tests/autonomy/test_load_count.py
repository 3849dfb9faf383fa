"""What is on board is known from weight and looks, and a difference from what was done is booked and said."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import restricted_to
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.manager.load_bookkeeping import LOOKS, LoadBookkeeping
from autonomy.manager.load_detector import MIN_WEIGHED, WoodScale, gripped_by_weight
from autonomy.manager.log_map import LogMap
from autonomy.manager.log_memory import PERIOD_NS, Grip, LogMemory
from autonomy.manager.sorting import Sorting
from autonomy.manager.tally import LoadedLog
from autonomy.manager.transition_table import State
from autonomy.missions.model import ForwardingMission, Point
from autonomy.motion.arm_kinematics import Arm
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import over_bunk
from tests.autonomy.manager_missions import begin, ended, whole
from tests.autonomy.mapped_logs import base, lying, seen
from tests.codes import numbers_in

PROFILE = load_profile("aoro_fc8")
ARM = Arm(PROFILE)
HERE = base(0.0, 0.0, math.pi)


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
def test_the_weight_tells_which_logs_came_up(
    read_kg: float, meant: dict[int, float], beside: dict[int, float], gripped: set[int]
) -> None:
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


class Hands:
    """A grasp of the logs of a field at ``places``, the first ``meant`` of them, lifted with a given reading."""

    def __init__(self, meant: int, *places: tuple[float, float]) -> None:
        field = LogMap(PROFILE.bunk)
        logs = [replace(lying(i, x, y, 0.0), diameter_m=0.25) for i, (x, y) in enumerate(places)]
        for k in range(2):
            field.observe(seen(logs, HERE), HERE, k)
        self.memory, self.field, self.now_ns = LogMemory(PROFILE), field, 0
        first, *others = (log.observation(HERE) for log in field.logs[:meant])
        self.grasp = replace(plan_single_log_grasp(ARM, first, 0.0), others=tuple(others))
        self.job: Any = SimpleNamespace(grasp=self.grasp, phase=Phase.LOOK, last_setpoint=(0.0,) * 5)

    def step(self, phase: Phase, pose: Any, load_kg: float, seconds: float = 0.25) -> list[int]:
        self.job.phase = phase
        q = tuple(ARM.joints(np.array([pose]))[0].tolist())
        self.job.last_setpoint = q
        for _ in range(round(seconds / 0.25)):
            self.now_ns += PERIOD_NS
            report: Any = SimpleNamespace(stamp_ns=self.now_ns, position=q, load_kg=load_kg)
            logs = self.memory.log_list(self.now_ns, self.field, HERE, report, self.job)
        assert logs is not None
        return [log.id for log in logs if log.center_m[2] > self.grasp.log.center_m[2] + 0.4]

    def place(self, load_kg: float) -> list[int]:
        """Lift, carry and release; the numbers of the logs that were thought to hang."""
        low = self.grasp.pose
        self.step(Phase.CLOSE, low, 0.0)
        self.step(Phase.LIFT, low, load_kg)
        hanging = self.step(Phase.CARRY, low.at_height(low.z_m + 1.0), load_kg, 5.0)
        x, y = PROFILE.bunk.center_m
        self.step(Phase.OPEN, ARM.pose_above(x, y, 1.7, 2.0), load_kg)
        return hanging


def test_a_log_that_did_not_come_up_still_lies_there() -> None:
    hands = Hands(2, (-4.0, 3.0), (-4.0, 3.3))
    numbers = [log.number for log in hands.field.logs]
    assert hands.place(95.0) == numbers[:1]
    grip = hands.memory.grip
    assert grip is not None and grip.left == (numbers[1],) and not grip.also
    assert grip.read_kg == pytest.approx(95.0)


def test_a_log_beside_the_grasp_that_came_up_is_on_board() -> None:
    hands = Hands(1, (-4.0, 3.0), (-4.0, 3.3))
    numbers = [log.number for log in hands.field.logs]
    hands.place(190.0)
    grip = hands.memory.grip
    assert grip is not None and [log.id for log in grip.also] == numbers[1:]
    hands.job.phase = Phase.DONE
    for number in numbers:
        hands.field.remove(number)
    hands.memory.log_list(hands.now_ns + PERIOD_NS, hands.field, HERE, None, None)
    assert hands.memory.in_bunk == 2


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
        )
        self.load = LoadBookkeeping(PROFILE, told, self.world)
        self.now_ns = 0

    def book(self, *diameters_m: float) -> None:
        logs = [replace(lying(7 + i, -4.0, 3.0 + i, 0.0), diameter_m=d) for i, d in enumerate(diameters_m)]
        first, *others = (log.observation(HERE) for log in logs)
        grasp = replace(plan_single_log_grasp(ARM, first, 0.0), others=tuple(others))
        self.now_ns += PERIOD_NS
        self.load.book_loaded(SimpleNamespace(grasp=grasp, lifted_kg=90.0), self.now_ns)  # type: ignore[arg-type]

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
    hands = Hands(2, (-4.0, 3.0), (-4.0, 3.3))
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
