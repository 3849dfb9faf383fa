"""Missions on the stand-in: their states, their safety conditions, and the reasons of their failures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autonomy.crane_job.activity import KEPT
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk, plan_place
from autonomy.grasp.planner import BunkFull
from autonomy.manager.activity_manager import MAX_OUTSIDE_M, ActivityManager
from autonomy.manager.crane_executor import MAX_STOPS
from autonomy.manager.tally import Tally
from autonomy.manager.transition_table import OURS, PAPER_B, RULES, State, Table
from autonomy.missions.model import Fence, ForwardingMission, KnownLog
from autonomy.navigation.clothoid_path import PathRefused
from autonomy.perception.log_list import LogObservation
from machine.joints import Joint
from machine.status.modes import Mode
from tests.autonomy.crane_stand_in import refusing
from tests.autonomy.forwarder_stand_in import Forwarder
from tests.autonomy.manager_missions import (
    CARRIER,
    LOGS,
    PLANE,
    PROFILE,
    at,
    begin,
    completed,
    ended,
    managed,
    outward_rad,
    place,
    states,
    whole,
)
from tests.autonomy.mapped_logs import lying
from tests.codes import numbers_in


@whole
def test_all_logs_in_reach_are_loaded_from_one_stop() -> None:
    forwarder, manager = begin()
    completed(forwarder, manager)
    assert forwarder.in_bunk == manager.tally.loaded == 2
    assert states(manager).count(State.APPROACH) == 1 and states(manager).count(State.COLLECT) == 2
    assert math.dist((forwarder.x_m, forwarder.y_m), (26.0, 0.0)) < 0.05
    assert forwarder.heights_m == pytest.approx([PROFILE.carrier.arm_transport_m] * 4, abs=0.02)


@whole
def test_a_mission_ends_on_the_spot_once_it_has_the_wanted_logs() -> None:
    forwarder, manager = begin(logs_wanted=1)
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and forwarder.in_bunk == manager.tally.loaded == 1
    assert forwarder.x_m < 24.0 and forwarder.speed_m_s == 0.0


@pytest.mark.long
def test_the_machine_stops_at_a_listed_log_before_it_is_detected() -> None:
    listed = KnownLog(place(15.0, 4.2), bearing_deg=80.0, length_m=2.4)
    forwarder, manager = begin((), known=(listed,), logs="listed")
    forwarder.run(manager, at(State.CHECK))
    (log,) = manager.world.log_map.logs
    assert log.center_m[:2] == pytest.approx([15.0, 4.2], abs=0.01) and log.length_m == 2.4
    assert math.atan2(log.axis[1], log.axis[0]) == pytest.approx(math.radians(10.0))
    assert abs(float(manager.world.base.to_optical(log.center_m)[2]) - PROFILE.workspace.ground_z_m) < 0.3
    forwarder, manager = begin((), known=(listed,))
    forwarder.run(manager, ended)
    assert State.CHECK not in states(manager), "searched for, it does not exist before it is seen"


@pytest.mark.parametrize("sigma_m", [0.3, 5.0])
def test_a_log_listed_within_metres_is_looked_for_but_neither_gripped_nor_in_the_way(sigma_m: float) -> None:
    """A harvester tells where its machine stood, not where the log fell."""
    before_wheel = KnownLog(place(4.5, 1.1), bearing_deg=90.0, length_m=2.4, sigma_m=sigma_m)
    beside = KnownLog(place(0.0, 4.2), bearing_deg=90.0, length_m=2.4, sigma_m=sigma_m)
    forwarder, manager = begin((), known=(before_wheel, beside), logs="listed")
    forwarder.run(manager, at(State.SEARCH))
    world, exact = manager.world, sigma_m < 1.0
    assert (world.log_before_wheel(4.5) is not None) == exact
    assert bool(world.graspable(only=2)) == exact
    assert world.next_stop(manager.route.base_at, -5.0, 20.0) is not None, "it is driven to and looked for"


@pytest.mark.parametrize("keep_out", [False, True])
def test_a_machine_outside_its_fence_stops(keep_out: bool) -> None:
    reach = (16.0, 40.0) if keep_out else (-10.0, 16.0)
    corners = tuple(place(x, y) for x, y in ((reach[0], -9.0), (reach[1], -9.0), (reach[1], 9.0), (reach[0], 9.0)))
    forwarder, manager = begin((), fences=(Fence(corners, keep_out),))
    forwarder.run(manager, ended)
    assert manager.failure_code == "mission.outside-fence" and manager.world.outside_fence_m > MAX_OUTSIDE_M
    forwarder.steps(manager, 60)
    assert forwarder.speed_m_s == 0.0 and 16.4 < forwarder.x_m < 17.6


@pytest.mark.parametrize(("y_m", "yaw", "hit"), [(1.1, 0.0, True), (-1.4, 1.4, True), (0.0, 0.0, False)])
def test_a_machine_stops_before_a_log_in_its_wheel_path(y_m: float, yaw: float, hit: bool) -> None:
    forwarder, manager = begin(((1, 15.0, y_m, yaw),), end_m=20.0)
    manager.tally.bunk_full = True  # no room for it on board
    forwarder.run(manager, ended)
    if not hit:  # it passes below the machine, between the wheels
        assert manager.failure_code != "mission.log-before-wheel"
        return
    assert manager.state is State.FAILED and manager.failure_code == "mission.log-before-wheel"
    forwarder.steps(manager, 60)
    assert forwarder.speed_m_s == 0.0 and forwarder.x_m + CARRIER.wheel_radius_m < 15.0


@whole
@pytest.mark.parametrize(("y_m", "yaw"), [(1.1, 0.0), (-1.3, 1.4)])
def test_a_log_in_the_wheel_path_that_the_crane_reaches_is_loaded_first(y_m: float, yaw: float) -> None:
    forwarder, manager = begin(((1, 15.0, y_m, yaw),))
    forwarder.run(manager, at(State.STOP))
    forwarder.run(manager, at(State.COLLECT))
    assert forwarder.x_m + CARRIER.wheel_radius_m < 15.0, "it stands before the log"
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and manager.tally.loaded == forwarder.in_bunk == 1
    steps = "RAISE SEARCH STOP CHECK LOWER COLLECT CHECK STOW RAISE SEARCH DONE"
    assert " ".join(state.name for state in states(manager)) == steps


@whole
def test_a_log_in_the_wheel_path_that_the_crane_cannot_lift_past_the_front_ends_the_mission() -> None:
    forwarder, manager = begin(((1, 15.0, 0.4, 1.57),))
    forwarder.run(manager, ended)
    assert manager.state is State.FAILED and manager.failure_code == "mission.log-before-wheel"
    assert State.STOP in states(manager), "it tried"
    assert forwarder.x_m + CARRIER.wheel_radius_m < 15.0


@whole
def test_paper_b_loads_a_log_by_the_states_of_its_flowchart() -> None:
    forwarder, manager = begin(((1, 15.0, 4.2, -0.9),), PAPER_B)
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and forwarder.in_bunk == 1
    steps = "RAISE SEARCH HALT LOOK APPROACH PASS STOP CHECK LOWER COLLECT STOW RAISE SEARCH DONE"
    assert " ".join(state.name for state in states(manager)) == steps


@whole
@pytest.mark.parametrize(("table", "turns"), [(PAPER_B, False), (OURS, True)])
def test_paper_b_leaves_its_rotator_as_it_stands(table: Table, turns: bool) -> None:
    """It neither measures nor controls it (3.1); ours turns it to a log across the crane."""
    forwarder, manager = begin(((1, 13.0, 2.8, 1.2),), table)
    angles_rad = set()

    def watched(manager: ActivityManager) -> bool:
        angles_rad.add(forwarder.crane.q[Joint.ROT])
        return ended(manager)

    forwarder.run(manager, watched)
    assert manager.state is State.DONE
    assert (len(angles_rad) > 1) is turns


def test_the_circle_is_only_left_on_its_far_side() -> None:
    forwarder, manager = begin((), PAPER_B)
    forwarder.run(manager, at(State.SEARCH))
    world = manager.world
    for away_m, inside, past in ((5.4, False, False), (5.2, True, False), (-5.2, True, False), (-5.4, False, True)):
        log = replace(lying(1, 0.0, 0.0), center_m=world.base.to_base(np.array([-away_m, 0.0, 0.0])))
        assert (world.is_in_circle(log), world.has_passed(log)) == (inside, past), away_m
    assert world.has_passed(None), "a log that is no longer mapped counts as passed"


def test_without_logs_the_machine_drives_to_the_end_of_the_route() -> None:
    forwarder, manager = begin(())
    forwarder.run(manager, ended)
    assert states(manager) == [State.RAISE, State.SEARCH, State.DONE]
    assert forwarder.driven_m == pytest.approx(26.0, abs=0.3)


@whole
def test_heights_of_the_mission_are_used() -> None:
    forwarder, manager = begin(LOGS[:1], transport_height_m=0.3, loading_height_m=0.05)
    forwarder.run(manager, at(State.SEARCH))
    assert forwarder.heights_m == pytest.approx([0.3] * 4, abs=0.02)
    forwarder.run(manager, at(State.COLLECT))
    assert forwarder.heights_m == pytest.approx([0.05] * 4, abs=0.02)


@whole
@pytest.mark.parametrize("state", [State.SEARCH, State.APPROACH, State.LOWER, State.COLLECT])
def test_a_stop_pauses_any_state_and_arming_resumes_it(state: State) -> None:
    forwarder, manager = begin(LOGS[:1])
    forwarder.run(manager, at(state))
    forwarder.crane.mode = Mode.STOP
    forwarder.drive = forwarder.crane.setpoint = None
    forwarder.steps(manager, 60)
    assert Mode.STOP.name in manager.paused and manager.state is state
    assert forwarder.speed_m_s == 0.0 and forwarder.drive is None and forwarder.crane.setpoint is None
    forwarder.crane.mode = Mode.ARMED
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and forwarder.in_bunk == 1


def test_in_single_step_every_transition_waits_for_the_operator() -> None:
    forwarder, manager = begin(LOGS[:1])
    manager.single_step = True
    forwarder.steps(manager, 40)
    assert manager.state is State.IDLE
    for wanted in (State.RAISE, State.SEARCH):
        manager.next_step()
        forwarder.run(manager, at(wanted), 30.0)
        forwarder.steps(manager, 20)
        assert manager.state is wanted


@whole
def test_in_single_step_no_event_is_lost_while_waiting() -> None:
    forwarder, manager = begin(LOGS[:1])
    manager.single_step = True
    while not ended(manager):
        forwarder.steps(manager, 1200)
        manager.next_step()
        forwarder.step(manager)
        assert forwarder.crane.now_ns < 1500e9, (manager.state, manager.failure)
    assert manager.state is State.DONE, manager.failure
    assert manager.tally.loaded == forwarder.in_bunk == 1


def test_abort_fails_the_mission_with_its_reason_and_stops_the_machine() -> None:
    forwarder, manager = begin(LOGS[:1])
    forwarder.run(manager, at(State.SEARCH))
    forwarder.steps(manager, 60)
    manager.abort("the supervisor wants it")
    forwarder.steps(manager, 60)
    assert manager.state is State.FAILED and manager.failure == "the supervisor wants it"
    assert forwarder.speed_m_s == 0.0
    assert manager.failure_code == "mission.aborted"
    manager.abort("again")
    assert manager.failure == "the supervisor wants it"


def test_swing_arms_that_do_not_move_time_out() -> None:
    forwarder, manager = begin(())
    while not ended(manager):
        forwarder.step(manager)
        forwarder.heights_m = [0.1] * 4
    assert (manager.failure_code, manager.failure) == ("mission.timeout", RULES[State.RAISE].timeout_reason)
    assert forwarder.crane.now_ns - 5_000_000_000 < 40e9


def test_wheels_that_do_not_turn_fail_the_mission() -> None:
    forwarder, manager = begin(())
    forwarder.run(manager, at(State.SEARCH))
    while not ended(manager):
        forwarder.speed_m_s = 0.0
        forwarder.step(manager)
        forwarder.x_m = 0.0
    assert manager.state is State.FAILED and manager.failure_code == "mission.carrier-stopped"


@whole
def test_a_log_that_slips_repeatedly_is_given_up_and_the_next_one_loaded() -> None:
    forwarder, manager = begin(((1, 15.0, 4.2, 0.0), (2, 26.0, 4.2, 0.0)), end_m=36.0)
    forwarder.crane.slippery = 9  # three grasps in each of three tries
    forwarder.run(manager, ended, 900.0)
    assert manager.state is State.DONE and forwarder.in_bunk == 1
    assert list(manager.tally.given_up) == [1]
    assert manager.tally.missed == 3


@whole
def test_at_the_end_of_the_route_the_load_is_brought_to_the_landing() -> None:
    forwarder, manager = begin(landing=(30.0, 12.0))
    completed(forwarder, manager, 900.0)
    assert manager.tally.loaded == manager.tally.unloaded == 2 and forwarder.in_bunk == manager.tally.on_board == 0
    assert [s.name for s in states(manager)][-7:] == ["HAUL", "SETTLE", "UNLOAD", "STOW", "RAISE", "SEARCH", "DONE"]
    for log in forwarder.field.values():
        assert math.dist(log.center_m[:2], (30.0, 12.0)) < 1.6
    (load,) = manager.tally.loads
    lay = sorted(PLANE.local(t.position.latitude_deg, t.position.longitude_deg)[:2] for t in load.logs)
    assert lay == [pytest.approx(log[1:3], abs=0.1) for log in LOGS], "where they had lain, not where they are"
    assert load.driven_m == pytest.approx(manager.route.driven_m) and load.logs[0].at_ns < load.at_ns
    assert all(t.volume_m3 == pytest.approx(math.pi * 0.125**2 * 2.0, rel=0.5) for t in load.logs)


@whole
@pytest.mark.parametrize("bearing_deg", [30.0, 100.0])
def test_logs_are_placed_along_the_bearing_of_their_landing(bearing_deg) -> None:
    forwarder, manager = begin(landing=(30.0, 12.0), bearing_deg=bearing_deg)
    completed(forwarder, manager, 900.0)
    assert manager.tally.unloaded == 2
    for log in forwarder.field.values():
        assert math.dist(log.center_m[:2], (30.0, 12.0)) < 1.6
        off = math.atan2(log.axis[1], log.axis[0]) - math.radians(90.0 - bearing_deg)
        assert abs(math.remainder(off, math.pi)) < math.radians(5.0)


@whole
def test_logs_from_before_the_mission_are_unloaded_too() -> None:
    forwarder, manager = begin((), landing=(30.0, 12.0))
    x, y = PROFILE.bunk.center_m
    aboard = LogObservation(7, (x, y, PROFILE.bunk.floor_z_m + 0.15), (1.0, 0.0, 0.0), 2.0, 0.25)
    forwarder.crane.logs = [aboard]
    forwarder.field[7] = lying(7, 0.0, 0.0)
    completed(forwarder, manager, 900.0)
    assert manager.tally.unloaded == 1 and manager.tally.on_board == manager.tally.loaded == forwarder.in_bunk == 0
    assert not manager.tally.loads, "logs from before the mission are not part of a load"
    assert math.dist(forwarder.field[7].center_m[:2], (30.0, 12.0)) < 1.6


@whole
def test_a_full_bunk_is_unloaded_and_the_route_resumed(monkeypatch) -> None:
    monkeypatch.setattr(Tally, "full", lambda self, _bunk, _next_m3=0.0: self.on_board >= 1)
    logs = ((1, 15.0, 4.2, 0.0), (2, 36.0, 4.2, 0.0))
    forwarder, manager = begin(logs, end_m=50.0, landing=(20.0, -20.0))
    forwarder.run(manager, lambda m: len(m.tally.loads) == 2 or ended(m), 1800.0)
    driven_m = manager.route.driven_m
    completed(forwarder, manager, 1800.0)
    assert manager.tally.unloaded == 2 and [s.name for s in states(manager)].count("HAUL") == 2
    assert sum(load.driven_m for load in manager.tally.loads) == pytest.approx(driven_m, abs=0.5)
    assert [len(load.logs) for load in manager.tally.loads] == [1, 1]


@whole
@pytest.mark.parametrize("table", [OURS, PAPER_B])
def test_a_bunk_without_room_ends_the_collecting_except_by_paper_b_which_does_not_know_it(table, monkeypatch) -> None:
    def place(arm, mission, grasp, logs, *held, knows_load):
        if knows_load and any(lies_in_bunk(PROFILE.bunk, log) for log in logs):
            raise BunkFull("grasp.bunk-full", "the bunk is full")
        return plan_place(arm, mission, grasp, logs, *held)

    monkeypatch.setattr("autonomy.crane_job.cycle.plan_place", place)
    lie = (*LOGS, (3, 40.0, 4.2, 0.0))
    if table is PAPER_B:
        lie = tuple((number, x, y, outward_rad(y)) for number, x, y, _ in lie)
    forwarder, manager = begin(lie, table, end_m=50.0)
    completed(forwarder, manager, 900.0)
    if table is PAPER_B:
        assert forwarder.in_bunk == manager.tally.loaded == len(lie) and not manager.tally.given_up
    else:
        assert forwarder.in_bunk == manager.tally.loaded == 1
        assert manager.tally.missed == 1 and list(manager.tally.given_up.values()) == ["the bunk is full"]
    assert forwarder.crane.held is None


def test_a_landing_without_room_fails_the_mission() -> None:
    forwarder, manager = begin((), landing=(12.0, 0.0))
    manager.tally.on_board = 1
    manager.route.drive_to_landing = refusing(PathRefused("path.none", "no room"))
    forwarder.run(manager, ended)
    assert manager.failure_code == "path.none"


def stop_and_arm(forwarder: Forwarder, manager: ActivityManager) -> None:
    forwarder.crane.mode, forwarder.crane.setpoint = Mode.STOP, None
    forwarder.step(manager)
    forwarder.crane.mode = Mode.ARMED


@whole
def test_a_grasp_that_is_stopped_repeatedly_is_given_up() -> None:
    forwarder, manager = begin(LOGS[:1], PAPER_B)
    while not ended(manager):
        forwarder.run(manager, lambda m: ended(m) or (m.state is State.COLLECT and not m.paused))
        forwarder.steps(manager, 30)
        if manager.state is State.COLLECT:
            stop_and_arm(forwarder, manager)
    assert manager.state is State.DONE and manager.tally.missed == 1
    (why,) = manager.tally.given_up.values()
    assert numbers_in(why) == [MAX_STOPS]


def test_a_log_that_the_jaws_do_not_release_ends_the_mission() -> None:
    """The next job would drag it along."""
    forwarder, manager = begin(LOGS[:1])
    forwarder.run(manager, at(State.COLLECT))
    assert manager.activity is not None
    manager.activity._fail(KEPT)
    forwarder.run(manager, ended)
    assert manager.state is State.FAILED and manager.failure_code == "activity.log-kept"


@whole
def test_a_log_in_the_jaws_is_laid_down_after_three_stops() -> None:
    """Its job was aborted, and the mission finished with the log in the jaws."""
    forwarder, manager = begin(LOGS[:1], OURS)
    forwarder.run(manager, lambda m: ended(m) or forwarder.crane.held is not None)
    for _ in range(MAX_STOPS):
        forwarder.steps(manager, 30)
        stop_and_arm(forwarder, manager)
    assert forwarder.crane.held is not None
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and forwarder.crane.held is None
    assert (manager.tally.missed, len(manager.tally.given_up)) == (0, 0) and manager.tally.on_board == 1


@whole
def test_a_log_in_the_bunk_counts_although_the_crane_is_stopped_while_it_rises() -> None:
    forwarder, manager = begin(LOGS[:1], OURS)
    forwarder.run(manager, lambda m: ended(m) or (m.activity is not None and m.activity.phase is Phase.RETREAT))
    for _ in range(MAX_STOPS):
        forwarder.steps(manager, 2)
        stop_and_arm(forwarder, manager)
    forwarder.run(manager, ended)
    assert forwarder.in_bunk == manager.tally.loaded == manager.tally.on_board == 1
    assert (manager.tally.missed, len(manager.tally.given_up)) == (0, 0)
    (remark,) = manager.tally.remarks
    assert numbers_in(remark.text)[-1] == MAX_STOPS


def test_paper_b_drives_on_when_the_log_is_not_detected_again() -> None:
    forwarder, manager = begin(LOGS[:1], PAPER_B)
    forwarder.run(manager, at(State.LOOK))
    forwarder.blind = {1}
    forwarder.run(manager, ended)
    assert manager.state is State.DONE and forwarder.in_bunk == 0
    assert State.COLLECT not in states(manager)


def test_the_same_inputs_give_the_same_bytes() -> None:
    def datagrams() -> list[bytes]:
        forwarder, manager = begin(LOGS[:1])
        sent: list[bytes] = []
        step = manager.step
        manager.step = lambda *a: sent.extend(step(*a)) or []
        forwarder.steps(manager, 200)
        return sent

    assert datagrams() == datagrams()


def test_a_route_that_cannot_be_driven_fails_the_mission() -> None:
    way = tuple(place(*p) for p in ((10.0, 0.0), (10.5, 0.0), (10.5, 1.0), (9.0, 1.0)))
    manager = managed(ForwardingMission("test", way), plane=PLANE)
    Forwarder(PROFILE, PLANE, [], (0.0, 0.0, 0.0)).run(manager, ended)
    assert manager.state is State.FAILED and manager.failure_code == "path.short-leg"
