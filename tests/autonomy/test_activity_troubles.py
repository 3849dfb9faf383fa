"""What goes wrong in a cycle: stops, silence, logs that are missed or lost, and what does not move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import dist, isfinite, nan

import numpy as np
import pytest

from autonomy.crane_job.activity import Phase
from autonomy.crane_job.cycle import HIGHER_M, LOOK_ASIDE_RAD, MAX_HIGHER
from autonomy.crane_job.grasp_verification import is_between_jaws
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.grapple_heights import retreat_height_m
from autonomy.grasp.planner import NoGrasp
from autonomy.missions.crane_job import CraneJob
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from can_dbc.messages.datagrams import decode
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from machine.joints import JOINTS, Joint
from machine.profile import joint
from machine.status.modes import Mode
from tests.autonomy.crane_stand_in import CYCLE, GROUND_LOG, HOME, TICK_NS, StandIn, activity, clearances, refusing
from tests.autonomy.grasp_scenes import ARM, PROFILE


def test_nothing_is_sent_before_the_controller_is_armed() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    assert planner.step(crane.now_ns, None, ()) is None and planner.paused_code == "activity.no-report"
    for mode in (Mode.BOOT, Mode.STANDBY, Mode.STOP, Mode.FAULT):
        crane.now_ns += TICK_NS
        assert planner.step(crane.now_ns, crane.report_with(mode=mode), crane.seen()) is None
        assert planner.paused_code == "activity.controller-mode" and mode.name in (planner.paused or "")
        assert planner.phase is Phase.WAIT
    assert planner.step(crane.now_ns, crane.report_with(position=(nan, *HOME[1:])), crane.seen()) is None
    assert planner.paused_code == "activity.position-unknown"
    assert crane.step(planner) is not None and planner.phase is Phase.LOOK and planner.paused is None


@pytest.mark.parametrize("phase", [Phase[name] for name in CYCLE[:-1]])
@pytest.mark.parametrize("mode", [Mode.STOP, Mode.FAULT])
def test_a_stop_in_any_phase_pauses_and_arming_resumes_it(phase: Phase, mode: Mode) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, phase, more_s=0.2)
    interrupted = planner.phase
    crane.mode = mode
    for _ in range(400):  # longer than any limit of a phase
        assert crane.step(planner) is None
    assert planner.paused_code == "activity.controller-mode" and mode.name in (planner.paused or "")
    assert planner.phase is interrupted
    crane.mode, crane.setpoint = Mode.ARMED, None
    data = crane.step(planner)
    assert data is not None and planner.phase is interrupted and planner.paused is None
    assert not any(decode(data).knots[0].velocity), "it starts at rest, where the crane stands"
    crane.run(planner)
    assert planner.done and planner.missed == 0
    assert clearances(PROFILE, crane.trace[::2])["tip"] > 0.005


def test_a_crane_that_was_moved_aside_first_returns_above_the_log() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.DESCEND, more_s=1.0)
    crane.mode = Mode.STOP
    crane.step(planner)
    crane.mode, crane.setpoint = Mode.ARMED, None
    crane.q = (crane.q[0] - 0.3, *crane.q[1:])
    crane.step(planner)
    assert planner.phase is Phase.ABOVE
    crane.run(planner)
    assert planner.done


def test_a_silent_controller_pauses() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.ABOVE, more_s=1.0)
    answers = [planner.step(crane.now_ns + n * TICK_NS, None, crane.seen()) for n in range(20)]
    assert planner.paused_code == "activity.controller-silent"
    assert sum(a is not None for a in answers) <= 6 and answers[-1] is None


def test_a_held_log_that_is_listed_twice_is_no_obstacle() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CLOSE)
    while crane.held is None:
        crane.step(planner)
    held = crane.logs[0]
    off_m = np.array(held.center_m) + 0.2 * np.array(held.axis) + (0.0, 0.0, 0.05)
    crane.logs.append(replace(held, id=7, center_m=tuple(off_m), length_m=held.length_m - 0.4, diameter_m=0.21))
    crane.run(planner)
    assert planner.done, planner.failure


def test_only_what_lies_in_closed_jaws_is_between_them() -> None:
    x, y, z = GROUND_LOG.center_m
    pin = ARM.pose_above(x, y, z + lowest_tip_below_pin_m(PROFILE.grapple.jaws) - 0.1, 2.0)
    assert is_between_jaws(ARM, GROUND_LOG, pin)
    assert not is_between_jaws(ARM, GROUND_LOG, pin.at_height(pin.z_m + 0.15)), "it lies under them"
    assert is_between_jaws(ARM, replace(GROUND_LOG, axis=(0.0, 0.0, 1.0)), pin), "upright"
    ax, ay, _ = GROUND_LOG.axis
    aside_m = 0.6 * GROUND_LOG.diameter_m
    beside = replace(GROUND_LOG, center_m=(x - aside_m * ay, y + aside_m * ax, z))
    assert not is_between_jaws(ARM, beside, pin), "another one, beside it"
    half_m = 0.5 * GROUND_LOG.length_m
    ends = replace(GROUND_LOG, center_m=(x + (half_m + 0.2) * ax, y + (half_m + 0.2) * ay, z))
    assert not is_between_jaws(ARM, ends, pin), "it ends before them"


@pytest.mark.parametrize("slips", [1, 2, 9])
@pytest.mark.parametrize("is_late", [False, True], ids=["at once", "a late list"])
def test_a_missed_log_is_gripped_again_and_given_up_the_third_time(slips: int, is_late: bool) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG], slippery=slips), activity()
    told, arrived_ns = crane.seen, None

    def late() -> tuple[LogObservation, ...] | None:
        """No list from the lift on until half a second after its end."""
        nonlocal arrived_ns
        if planner.phase in (Phase.LIFT, Phase.CARRY) and not (arrived_ns and crane.now_ns > arrived_ns + 500_000_000):
            arrived_ns = (arrived_ns or crane.now_ns) if planner.arrived else None
            return None
        return told()

    crane.seen = late if is_late else told
    crane.run(planner)
    assert planner.idle and planner.missed == min(slips, 3) and planner.done == (slips < 3)
    assert crane.phases().count("LOOK") == min(slips + 1, 3)
    assert planner.failure_code == (None if planner.done else "activity.log-missed")
    assert crane.phases()[-7:] == CYCLE[3:] if planner.done else planner.phase is Phase.FAILED


def test_a_log_that_is_lost_during_the_motion_is_picked_again() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CARRY, more_s=2.0)
    crane.held = None
    crane.logs = [replace(GROUND_LOG, center_m=(-1.0, 4.6, GROUND_LOG.center_m[2]))]
    crane.run(planner)
    assert planner.done and planner.missed == 1


def test_a_log_that_falls_beside_the_bunk_is_reported() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.RETREAT)
    crane.logs = [replace(crane.logs[0], center_m=(3.0, 3.0, -1.29))]
    crane.run(planner)
    assert planner.failure_code == "activity.log-misplaced" and "(3.00, 3.00, -1.29)" in (planner.failure or "")


@pytest.mark.parametrize(("listed", "code"), [(None, "activity.look-timeout"), ((), "grasp.no-log-outside-bunk")])
def test_no_log_ends_the_job_after_a_look_from_both_sides(listed: tuple[()] | None, code: str) -> None:
    crane, planner = StandIn(PROFILE, []), activity()
    crane.seen = lambda: listed
    crane.run(planner)
    assert planner.failure_code == code
    slews = [moment.q[Joint.SLEW] for moment in crane.trace]
    assert min(slews) == pytest.approx(HOME[Joint.SLEW] - LOOK_ASIDE_RAD, abs=0.01)
    assert max(slews) == pytest.approx(HOME[Joint.SLEW] + LOOK_ASIDE_RAD, abs=0.01)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_log_behind_the_boom_is_found_from_the_side(side: float) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.seen = lambda: tuple(crane.logs) if side * (crane.q[Joint.SLEW] - HOME[Joint.SLEW]) > 0.2 else ()
    crane.until(planner, Phase.ABOVE)
    assert planner.grasp is not None and planner.grasp.log.id == GROUND_LOG.id


def test_a_crane_at_its_end_stop_looks_from_the_other_side() -> None:
    slew = PROFILE.joints["slew"]
    crane, planner = StandIn(PROFILE, [], q=(slew.upper - 0.05, *HOME[1:])), activity()
    crane.run(planner)
    slews = [moment.q[Joint.SLEW] for moment in crane.trace]
    assert planner.failure_code == "grasp.no-log-outside-bunk"
    assert min(slews) == pytest.approx(slew.upper - 0.05 - LOOK_ASIDE_RAD, abs=0.01) and max(slews) <= slew.upper


@pytest.mark.parametrize(
    ("job", "log", "code"),
    [
        (CraneJob(log_id=4), GROUND_LOG, "grasp.job-log-not-in-view"),
        (CraneJob(), replace(GROUND_LOG, center_m=(-7.0, 7.0, -1.29)), "grasp.log-out-of-reach"),
        (CraneJob(place_m=(-9.0, 0.0)), GROUND_LOG, "grasp.place-out-of-reach"),
    ],
)
def test_what_cannot_be_done_ends_the_job_with_one_sentence(job: CraneJob, log: LogObservation, code: str) -> None:
    crane, planner = StandIn(PROFILE, [log]), activity(job)
    crane.run(planner)
    assert planner.failure_code == code and planner.failure and "\n" not in planner.failure


@pytest.mark.parametrize(
    ("phase", "direct", "freeze", "code"),
    [
        (Phase.ABOVE, True, "slew", "activity.above-timeout"),
        (Phase.ABOVE, False, "slew", "activity.above-timeout"),
        (Phase.DESCEND, False, "lift", "activity.descend-timeout"),
        (Phase.LIFT, True, "lift", "activity.lift-timeout"),
        (Phase.LIFT, False, "lift", "activity.lift-timeout"),
        (Phase.CARRY, True, "slew", "activity.carry-timeout"),
        (Phase.CARRY, False, "slew", "activity.carry-timeout"),
        (Phase.RETREAT, True, "lift", "activity.retreat-timeout"),
    ],
)
def test_a_joint_that_does_not_move_ends_the_phase_by_its_name(phase, direct, freeze, code) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity(direct=direct)
    crane.until(planner, phase)
    j = Joint[freeze.upper()]
    stuck = crane.q[j]
    sent = []
    while not planner.idle and len(sent) < 1200:
        position = tuple(stuck if k == j else q for k, q in zip(JOINTS, crane.q, strict=True))
        sent.append(crane.misreport(planner, position=position))
    assert planner.phase is Phase.FAILED
    assert planner.failure_code == code and freeze in planner.failure
    assert sent[-1].final and not any(sent[-1].knots[0].velocity)
    speed = joint(PROFILE, j).speed_limit
    assert max(abs(m.knots[0].position[j] - stuck) for m in sent) < 1.5 * speed, "the reference waits for the joint"


@pytest.mark.parametrize(
    ("phase", "opening", "code"),
    [
        (Phase.ABOVE, 40.0, "activity.above-timeout"),
        (Phase.CLOSE, 100.0, "activity.close-timeout"),
        (Phase.OPEN, 45.0, "activity.open-timeout"),
    ],
)
def test_a_grapple_that_does_not_move_ends_its_phase(phase: Phase, opening: float, code: str) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, phase)
    for _ in range(1200):
        crane.misreport(planner, opening_pct=opening, grapple_state=0)
    assert planner.failure_code == code


def test_an_abort_stops_smoothly_and_ends_with_a_hold() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CARRY, more_s=5.0)
    before = crane.trace[-1].q[Joint.SLEW]
    planner.abort("ended by SIGTERM")
    seconds = crane.run(planner)
    assert planner.failure_code == "activity.aborted" and planner.idle and seconds < 1.5
    assert crane.setpoint is not None and crane.setpoint.final
    assert crane.setpoint.grapple is GrappleCommand.HOLD, "a carried log is kept"
    slew = np.array([m.q[Joint.SLEW] for m in crane.trace])
    acceleration = np.diff(slew, 2) / (TICK_NS * 1e-9) ** 2
    assert 0.02 < abs(slew[-1] - before) < 0.3
    assert np.max(np.abs(acceleration)) < 1.5 * joint(PROFILE, Joint.SLEW).acceleration_limit
    assert crane.step(planner) is None
    planner.abort("again")
    assert planner.failure_code == "activity.aborted"


@pytest.mark.parametrize(("times", "done"), [(1, True), (10_000, False)])
def test_jaws_in_whose_way_something_lies_open_higher_and_not_for_ever(times, done, monkeypatch) -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.OPEN)
    low_m, left = planner._cycle.place.z_m, [times]

    def in_the_way(_: object) -> bool:
        left[0] -= 1
        return left[0] >= 0

    monkeypatch.setattr(planner._grapple, "must_open_higher", in_the_way)
    monkeypatch.setattr(planner._grapple, "has_released", lambda *_: left[0] <= 0)
    crane.run(planner)
    assert planner.done is done
    assert planner._cycle.place.z_m - low_m == pytest.approx(HIGHER_M * min(times, MAX_HIGHER))
    assert done or planner.failure_code == "activity.open-timeout"


@pytest.mark.parametrize("low", [True, False])
def test_a_load_that_rests_above_its_place_is_released_there(low: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in the bunk may lie higher than a camera that only looks ahead lets it know."""
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.CARRY)
    while planner.phase is Phase.CARRY and planner._cycle.is_close_above_place(planner._position()) is not low:
        crane.step(planner)
    assert planner.phase is Phase.CARRY
    above_m = planner._cycle._arm.pose(planner._position()).z_m - planner._cycle.place.z_m
    monkeypatch.setattr(type(planner._grapple), "load_rests", True)
    for _ in range(40):
        crane.step(planner)
        if planner.phase is Phase.OPEN:
            break
    stands_m = planner._cycle._arm.pose(planner._position()).z_m - planner._cycle.place.z_m
    assert (planner.phase is Phase.OPEN and 0.1 < stands_m < above_m) is low


# -- over the bunk before the machine drives, and back where there is no path
BUNK = PROFILE.bunk


def stow(crane: StandIn) -> None:
    planner = activity(stow_only=True)
    while not planner.idle:
        data = crane.step(planner)
        assert data is None or decode(data).grapple is GrappleCommand.HOLD
    assert planner.done and planner.grasp is None, planner.failure


def over_the_bunk(q: tuple[float, ...]) -> bool:
    pin = ARM.pose(q)
    x, y = ARM.xy(pin)
    near = abs(x - BUNK.center_m[0]) < BUNK.width_m and abs(y - BUNK.center_m[1]) < BUNK.width_m
    return near and pin.z_m > retreat_height_m(PROFILE) - 0.02


def test_from_beside_a_log_it_goes_over_the_bunk_and_keeps_its_jaws_as_they_are() -> None:
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.until(planner, Phase.DESCEND)
    planner.abort("that will do")
    crane.run(planner)
    assert not over_the_bunk(crane.q)
    stow(crane)
    assert over_the_bunk(crane.q)


def test_where_it_already_rests_there_nothing_moves() -> None:
    crane = StandIn(PROFILE, [])
    over = ARM.pose_above(*BUNK.center_m, retreat_height_m(PROFILE) + 0.2, retreat_height_m(PROFILE) + 0.2)
    crane.q = tuple(ARM.joints(np.array([over]))[0].tolist())
    before = crane.q
    stow(crane)
    assert crane.q == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize(
    ("what", "trouble", "code", "direct"),
    [
        ("carry_motion", Unreachable("no way is clear"), "activity.unreachable", True),
        ("carry_motion", NoGrasp("grasp.bunk-full", "the bunk is full"), "grasp.bunk-full", True),
        ("plan_place", NoGrasp("grasp.bunk-full", "no room"), "grasp.bunk-full", False),
    ],
    ids=["no way", "a full bunk", "a full bunk, once it is lifted"],
)
def test_a_log_without_a_path_on_is_released_where_it_lay(what, trouble, code, direct, monkeypatch) -> None:
    monkeypatch.setattr(f"autonomy.crane_job.cycle.{what}", refusing(trouble))
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity(direct=direct)
    crane.run(planner)
    assert planner.failure == str(trouble) and planner.failure_code == code and planner.idle
    assert crane.phases()[-3:] == ["LOWER", "OPEN", "FAILED"] and ("LIFT" in crane.phases() or direct)
    (log,) = crane.logs
    assert crane.held is None and log.center_m == pytest.approx(GROUND_LOG.center_m, abs=0.1)


# -- a camera that remembers what it cannot show
_SHUT = 4


@dataclass
class Hooking(StandIn):
    """Jaws without a sensor that a neighbour keeps from opening: they take the log along, unless they open higher."""

    free_m: float = 0.1
    first_m: float = nan

    def _drop(self) -> None:
        height_m = self.pin()[2]
        self.first_m = self.first_m if isfinite(self.first_m) else height_m
        if height_m > self.first_m + self.free_m and self.setpoint.knots[0].velocity[Joint.LIFT] == 0.0:
            super()._drop()


@pytest.mark.parametrize(
    ("free_m", "opens", "code"),
    [(-1.0, 1, None), (0.1, 2, None), (0.25, 3, None), (5.0, 1 + MAX_HIGHER, "activity.log-kept")],
)
def test_a_log_that_the_opened_jaws_take_along_is_released_higher(free_m: float, opens: int, code: str | None) -> None:
    """It was dragged out of the bunk by the next job, and counted as loaded."""
    crane = Hooking(PROFILE, [GROUND_LOG], feedback=False, log_kg=90.0, free_m=free_m)
    planner = activity(fetches_next=lambda log: True)
    crane.run(planner)
    assert planner.failure_code == code and planner.done == (code is None)
    assert crane.phases().count("OPEN") == opens
    assert (crane.held is None) == (code is None) and lies_in_bunk(PROFILE.bunk, crane.logs[0])


@pytest.mark.parametrize(
    ("feedback", "free_m", "code"),
    [(False, -1.0, None), (False, 5.0, "activity.log-kept"), (True, -1.0, "activity.open-timeout")],
)
def test_jaws_that_something_keeps_from_opening_rise_where_only_the_load_cell_tells(
    feedback: bool, free_m: float, code: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its log lay in the bunk, and the job ended as a missed grasp."""
    crane = Hooking(PROFILE, [GROUND_LOG], feedback=feedback, log_kg=90.0, free_m=free_m)
    planner = activity(fetches_next=lambda log: True)
    crane.until(planner, Phase.OPEN)
    monkeypatch.setattr(planner._grapple, "has_released", lambda *_: False)
    crane.run(planner)
    assert (planner.failure_code, planner.done) == (code, code is None) and not planner.has_released


@dataclass
class Remembering(StandIn):
    """A crane whose camera looks while it rests, shows only what lies near the pin, not what hangs under it, and
    remembers the rest."""

    def __post_init__(self) -> None:
        self.last = {log.id: log for log in self.logs}
        self.was = self.q

    def seen(self) -> tuple[LogObservation, ...] | None:
        """The logs, remembered where they cannot be seen."""
        rests, self.was = self.q == self.was, self.q
        if not rests:
            return None
        told = []
        for log in self.logs:
            near = dist(self.pin()[:2], log.center_m[:2]) < 1.0 and log.id != self.held
            if near:
                self.last[log.id] = log
            told.append(replace(self.last[log.id], seen=near))
        return tuple(told)

    def report(self) -> StateReport:
        """The report of a controller with an opening sensor: closed empty, or holding."""
        told = super().report()
        return replace(told, grapple_state=_SHUT) if self.gripped and self.held is None else told


@pytest.mark.parametrize("slips", [0, 1, 9])
def test_not_the_remembered_log_but_the_jaws_tell_whether_it_was_lifted(slips: int) -> None:
    crane, planner = Remembering(PROFILE, [GROUND_LOG], slippery=slips), activity()
    crane.run(planner)
    assert planner.missed == min(slips, 3) and planner.done is (slips < 3)
    assert planner.failure_code == ("activity.log-missed" if slips > 3 else None)
