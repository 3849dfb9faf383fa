"""A thin log twists in closed jaws, and no picture shows it: above the bunk it is recognized and laid down straight."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import atan2, cos, dist, hypot, inf, pi, remainder, sin

import pytest

from autonomy.crane_job.activity import HIDDEN_LOAD_NS, Activity, Phase
from autonomy.crane_job.cycle import LOOSE_TURN_S_RAD, MAX_FURTHER_TURNS
from autonomy.crane_job.grapple import THICK_LOG_M
from autonomy.crane_job.grasp_verification import is_part_of_load, with_load_recognized
from autonomy.crane_job.phase_motions import reaches_stakes, turn_motion
from autonomy.grasp.bunk_load import lies_across_stakes
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.trajectory import STEP_S
from autonomy.perception.log_list import TRIANGLE, LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.joints import Joint
from tests.autonomy.crane_stand_in import GROUND_LOG, TICK_NS, StandIn, activity
from tests.autonomy.grasp_scenes import PROFILE
from tests.codes import numbers_in

THIN = replace(GROUND_LOG, id=1, center_m=(-1.8, 4.4, -1.32), diameter_m=0.14, covariance=(1e-6,) * TRIANGLE)
THICK = replace(THIN, center_m=(-1.8, 4.4, -1.28), diameter_m=0.22)
TWIST_RAD = 0.5
FOUND = 7


class Twisting(StandIn):
    """The gripped log twists, and is hidden until the crane has stood for ``hidden_ns``; then it is another one."""

    hidden_ns: float = 300_000_000
    part_m = 1.2
    planner: Activity
    stood_ns: int | None = None
    twisted = False

    def seen(self) -> tuple[LogObservation, ...]:
        if self.held is not None and not self.twisted:
            self._psi += TWIST_RAD
            self.twisted = True
        if not self.twisted:
            return tuple(self.logs)
        if self.stood_ns is None and self.planner.phase is not Phase.CLOSE and self.planner.arrived:
            self.stood_ns = self.now_ns
        remembered = replace(THIN if self.logs[0].diameter_m < 0.2 else THICK, seen=False)
        if self.stood_ns is None or self.now_ns < self.stood_ns + self.hidden_ns:
            return (remembered,)
        log = self.logs[0]
        return (remembered, replace(log, id=FOUND, length_m=self.part_m))

    def askew_rad(self) -> float:
        """How far the log lies across the bunk."""
        (ax, ay, _) = self.logs[0].axis
        return abs(remainder(atan2(ay, ax) - PROFILE.bunk.yaw_rad, pi))


def watched(kind: type[StandIn], log: LogObservation, **told) -> tuple[StandIn, Activity]:
    """A crane that knows its job, with these attributes."""
    crane, planner = kind(PROFILE, [log]), activity()
    for name, value in {"planner": planner, **told}.items():
        setattr(crane, name, value)
    return crane, planner


def driven(log: LogObservation, kind: type[StandIn] = Twisting, **told) -> tuple[StandIn, Activity, float]:
    """The same at the end of the job, and its time."""
    crane, planner = watched(kind, log, **told)
    return crane, planner, crane.run(planner)


def test_a_twisted_log_is_recognized_above_the_bunk_and_turned() -> None:
    crane, planner, _ = driven(THIN)
    assert planner.done and planner.missed == 0, planner.failure
    assert crane.askew_rad() < 0.05
    assert crane.phases()[-6:] == ["LIFT", "CARRY", "LOWER", "OPEN", "RETREAT", "DONE"]


def test_it_is_turned_so_slowly_that_it_does_not_spin() -> None:
    crane, _, _ = driven(THIN)
    carried = [moment.q[Joint.ROT] for moment in crane.trace if moment.phase == "CARRY"]
    fastest_rad_s = max(abs(b - a) for a, b in pairwise(carried)) / (TICK_NS * 1e-9)
    assert abs(carried[-1] - carried[0]) == pytest.approx(TWIST_RAD, abs=0.05)
    assert fastest_rad_s < 2.5 / LOOSE_TURN_S_RAD


def test_a_log_that_nothing_shows_is_laid_down_as_it_was_gripped_after_a_short_wait() -> None:
    crane, planner, lasted_s = driven(THIN, hidden_ns=inf)
    assert planner.done and crane.askew_rad() == pytest.approx(TWIST_RAD, abs=0.05)
    shown, _, _ = driven(THIN, hidden_ns=0)
    assert shown.askew_rad() < 0.05
    waits = [m for m in crane.trace if m.phase == "LIFT"]
    assert crane.stood_ns is not None and len(waits) * TICK_NS > HIDDEN_LOAD_NS and lasted_s < 60.0


def test_a_thick_log_does_not_twist_in_the_jaws_and_nobody_waits_for_it() -> None:
    assert THICK.diameter_m > THICK_LOG_M > THIN.diameter_m
    (_, _, thin_s), (crane, planner, thick_s) = driven(THIN, hidden_ns=inf), driven(THICK, hidden_ns=inf)
    assert planner.done and crane.stood_ns is not None
    assert thin_s - thick_s > 0.8 * HIDDEN_LOAD_NS * 1e-9


def test_a_log_under_the_jaws_is_not_their_load() -> None:
    """Above the bunk the logs in it are just below the tips, and above the ground those beside the gripped one."""
    arm, lowest_m = Arm(PROFILE), lowest_tip_below_pin_m(PROFILE.grapple.jaws)
    pin = arm.pose_above(*PROFILE.bunk.center_m, 0.5, 2.0)
    other = replace(THIN, id=FOUND, center_m=(*PROFILE.bunk.center_m, pin.z_m - lowest_m - 0.05))
    grasp = Grasp(replace(THIN, seen=False), pin, -1.39, 0.0)
    logs = (replace(THIN, seen=False), other)
    assert with_load_recognized(arm, grasp, logs, [pin]) == (logs, THIN.id)
    higher = replace(other, center_m=(*PROFILE.bunk.center_m, pin.z_m - lowest_m + 0.05))
    seen, number = with_load_recognized(arm, grasp, (logs[0], higher), [pin])
    assert number == FOUND and seen == [replace(higher, id=THIN.id)]


def test_both_ends_of_a_load_that_the_grapple_hides_are_the_load_and_no_obstacle() -> None:
    """Seen above the bunk: the two ends as logs of their own, the middle by no picture."""
    arm, lowest_m = Arm(PROFILE), lowest_tip_below_pin_m(PROFILE.grapple.jaws)
    (x, y), turn = PROFILE.bunk.center_m, 0.3
    pin = arm.pose_above(x, y, 0.5, 2.0)
    axis, z = (cos(turn), sin(turn), 0.0), pin.z_m - lowest_m + 0.05

    def part(number: int, from_m: float, to_m: float) -> LogObservation:
        middle = 0.5 * (from_m + to_m)
        center = (x + middle * axis[0], y + middle * axis[1], z)
        return replace(THIN, id=number, center_m=center, axis=axis, length_m=to_m - from_m)

    half = 0.5 * THIN.length_m
    near, far = part(7, -half, -0.6), part(8, 0.5, half)
    beside = replace(part(9, -half, half), center_m=(x - 0.6 * axis[1], y + 0.6 * axis[0], z))
    grasp = Grasp(replace(THIN, seen=False), pin, -1.39, 0.0)
    seen, number = with_load_recognized(arm, grasp, (grasp.log, near, far, beside), [pin])
    assert number == 8 and [log.id for log in seen] == [THIN.id, 9]
    assert seen[0].length_m == THIN.length_m and dist(seen[0].center_m, (x, y, z)) < 1e-9
    assert is_part_of_load(arm, grasp.log, near, pin) and not is_part_of_load(arm, grasp.log, beside, pin)


class Forgotten(Twisting):
    """The list keeps the load under the number under which it was seen on the way, where it was seen."""

    ghost: LogObservation | None = None

    def seen(self) -> tuple[LogObservation, ...]:
        listed = super().seen()
        found = next((log for log in listed if log.id == FOUND), None)
        if found is None:
            return listed
        x, y = PROFILE.bunk.center_m
        self.ghost = replace(found, center_m=(x, y, 1.0), length_m=2.6, seen=False)
        first = self.stood_ns is not None and self.now_ns < self.stood_ns + self.hidden_ns + 200_000_000
        return listed if first else (listed[0], self.ghost, replace(found, id=FOUND + 1))


def test_where_the_load_was_seen_before_is_no_other_log_above_the_bunk() -> None:
    """Else it is an obstacle to itself, and the bunk is full."""
    crane, planner, _ = driven(THIN, Forgotten)
    assert crane.ghost is not None and planner.done and crane.askew_rad() < 0.05, planner.failure


@pytest.mark.parametrize(("skew", "among"), [(0.6, True), (0.1, False)])
def test_a_load_among_the_stakes_is_turned_above_them(skew: float, among: bool) -> None:
    """A stake may stand inside of its turn: it goes up as it came, turns, and comes down."""
    arm, bunk = Arm(PROFILE), PROFILE.bunk
    start = arm.pose_above(*bunk.center_m, 0.4, 2.0)
    axis = (cos(bunk.yaw_rad + skew), sin(bunk.yaw_rad + skew), 0.0)
    load = replace(THIN, center_m=(*bunk.center_m, -0.4), axis=axis, length_m=2.4)
    assert reaches_stakes(bunk, load) is among
    place = start._replace(rot_rad=start.rot_rad - skew)
    motion = turn_motion(arm, start, place, bunk, load, 5.0)
    poses = [arm.pose(q) for q in motion.position]
    turning = [b for a, b in pairwise(poses) if abs(b.rot_rad - a.rot_rad) > 1e-5]
    lowest_m = min(pose.z_m for pose in turning)
    assert lowest_m == pytest.approx(travel_height_m(PROFILE) if among else start.z_m, abs=0.02)
    assert poses[-1].rot_rad == pytest.approx(place.rot_rad) and poses[-1].z_m == pytest.approx(place.z_m, abs=1e-3)
    fastest = max(abs(b.rot_rad - a.rot_rad) for a, b in pairwise(poses)) / STEP_S
    assert fastest < 2.5 / 5.0


class SpinsOn(Twisting):
    """The log spins on whenever the crane begins to lower it, ``spins`` times."""

    spins, spin_rad = 0, TWIST_RAD
    lowers = False

    def seen(self) -> tuple[LogObservation, ...]:
        lowers, self.lowers = self.lowers, self.planner.phase is Phase.LOWER
        if self.lowers and not lowers and self.spins:
            self._psi += self.spin_rad
            self.spins -= 1
        return super().seen()


def spun(spins: int, spin_rad: float = TWIST_RAD) -> tuple[StandIn, Activity]:
    return driven(replace(THIN, length_m=2.6), SpinsOn, spins=spins, spin_rad=spin_rad, part_m=2.3)[:2]


@pytest.mark.parametrize("spins", [1, MAX_FURTHER_TURNS])
def test_a_log_that_has_spun_on_above_its_place_is_turned_back(spins: int) -> None:
    crane, planner = spun(spins)
    assert planner.done and crane.askew_rad() < 0.05, planner.failure
    assert crane.phases()[-2 * spins - 5 :] == ["CARRY", "LOWER"] * (spins + 1) + ["OPEN", "RETREAT", "DONE"]


def test_a_log_that_spins_for_ever_is_laid_down_and_never_called_done_across_the_stakes() -> None:
    crane, planner = spun(99, 0.8)
    assert crane.spins == 99 - MAX_FURTHER_TURNS - 1 and lies_across_stakes(PROFILE.bunk, crane.logs[0])
    assert planner.failure_code == "activity.log-misplaced"


class Remembering(Twisting):
    """Once the turn has begun, no picture shows the load for ``blind_ns``; the list remembers it as it hung before."""

    blind_ns = 1_000_000_000
    before: LogObservation | None = None
    lowered_ns: int | None = None

    def seen(self) -> tuple[LogObservation, ...]:
        listed = super().seen()
        if len(listed) < 2 or self.planner.phase is Phase.LIFT:
            return listed
        self.before = self.before or replace(listed[1], seen=False)
        if self.planner.phase is Phase.LOWER and self.lowered_ns is None:
            self.lowered_ns = self.now_ns
        shown = self.lowered_ns is not None and self.now_ns > self.lowered_ns + self.blind_ns
        return listed if shown else (listed[0], self.before)


@pytest.mark.parametrize("blind_ns", [0, 1_000_000_000, inf])
def test_what_is_remembered_from_before_the_turn_says_nothing_about_it(blind_ns: float) -> None:
    """Measured: the list still had the direction before the turn, and the log was turned twice too far."""
    crane, planner, _ = driven(THIN, Remembering, blind_ns=blind_ns)
    assert planner.done and crane.askew_rad() < 0.05, planner.failure
    assert crane.phases()[-6:] == ["LIFT", "CARRY", "LOWER", "OPEN", "RETREAT", "DONE"]


def test_only_a_log_askew_with_an_end_beyond_the_stakes_lies_across_them() -> None:
    bunk = PROFILE.bunk

    def laid(skew_rad: float, across_m: float = 0.0, length_m: float = 2.6) -> LogObservation:
        yaw, (x, y) = bunk.yaw_rad, bunk.center_m
        center = (x - across_m * sin(yaw), y + across_m * cos(yaw), bunk.floor_z_m + 0.1)
        axis = (cos(yaw + skew_rad), sin(yaw + skew_rad), 0.0)
        return replace(THIN, center_m=center, axis=axis, length_m=length_m)

    half_m = 0.5 * bunk.width_m
    assert lies_across_stakes(bunk, laid(0.6)) and lies_across_stakes(bunk, laid(pi - 0.6))
    assert lies_across_stakes(bunk, laid(-0.6)) and lies_across_stakes(bunk, laid(0.3, half_m - 0.2))
    assert not lies_across_stakes(bunk, laid(0.3)) and not lies_across_stakes(bunk, laid(0.6, length_m=1.5))
    assert not lies_across_stakes(bunk, laid(0.1, half_m)), "straight, beside a stake: it is measured a little off"
    assert not lies_across_stakes(bunk, laid(pi))


class Partial(StandIn):
    """Only an end of the log is in view until the crane has stood above it for a second."""

    stood_ns: int | None = None
    planner: Activity

    def seen(self) -> tuple[LogObservation, ...]:
        if self.stood_ns is None and self.planner.phase is Phase.ABOVE and self.planner.arrived:
            self.stood_ns = self.now_ns
        if self.stood_ns is not None and self.now_ns > self.stood_ns + 10**9:
            return tuple(self.logs)
        log = self.logs[0]
        shift_m = 0.5 * (log.length_m - 1.0)
        center = tuple(c + shift_m * a for c, a in zip(log.center_m, log.axis, strict=True))
        return (replace(log, center_m=center, length_m=1.0),)


def test_a_log_of_which_an_end_was_in_view_is_gripped_at_its_middle() -> None:
    crane, planner = watched(Partial, THICK)
    crane.until(planner, Phase.LIFT)
    x, y = Arm(PROFILE).xy(Arm(PROFILE).pose(crane.trace[-1].q))
    assert hypot(x - THICK.center_m[0], y - THICK.center_m[1]) < 0.1
    crane.run(planner)
    assert planner.done


def test_a_recognized_log_that_falls_beside_the_bunk_is_reported() -> None:
    crane, planner = watched(Twisting, THIN)
    crane.until(planner, Phase.RETREAT)
    crane.logs = [replace(crane.logs[0], center_m=(3.0, 3.0, -1.32))]
    crane.run(planner)
    assert planner.failure_code == "activity.log-misplaced" and FOUND in numbers_in(planner.failure or "")
