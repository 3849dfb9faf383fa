"""A rotator that is only counted: what hangs in the grapple sets its count right, also before the camera ahead."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import atan2, cos, degrees, isfinite, nan, pi, remainder, sin

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.rotator_estimate import (
    AHEAD_RAD,
    SCALE_BOUNDS,
    UNSURE_AHEAD_RAD,
    UNSURE_RAD,
    VIEW_SIGMA_RAD,
    RotatorEstimate,
    has_no_encoder,
    load_in_view,
    load_view,
    planning_profile,
    play_rad,
)
from autonomy.grasp.bunk_load import lies_in_bunk, plan_place, point_in_bunk
from autonomy.grasp.planner import Grasp
from autonomy.grasp.selection import plan_single_log_grasp, select_direct
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.camera.frame import optical_pose
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.autonomy.crane_stand_in import StandIn, activity

FORWARDER, LOADER = load_profile("aoro_fc8"), load_profile("palms_471")
ARM, CAMERA = Arm(FORWARDER), FORWARDER.cameras["front"]
HOME = (0.0, 1.25, -2.39, 0.10, 0.0)


class Blind(StandIn):
    """The stand-in whose controller reports no rotator and no opening."""

    def report(self) -> StateReport:
        said = super().report()
        return replace(said, position=(*said.position[: Joint.ROT], nan), opening_pct=nan)


def birch(seed: int) -> LogObservation:
    rng = random.Random(f"scene {seed}")
    (cx, cy), half = FORWARDER.workspace.pick_center_m, FORWARDER.workspace.pick_half_size_m
    x, y, yaw = cx + rng.uniform(-half, half), cy + rng.uniform(-half, half), rng.uniform(-pi, pi)
    return LogObservation(0, (x, y, FORWARDER.workspace.ground_z_m + 0.125), (cos(yaw), sin(yaw), 0.0), 2.0, 0.25)


@pytest.mark.parametrize("seed", range(10))
def test_a_log_beside_the_forwarder_goes_into_its_bunk(seed: int) -> None:
    crane = Blind(FORWARDER, [birch(seed)], q=HOME)
    planner = activity(profile=FORWARDER)
    crane.run(planner)
    assert planner.failure is None and planner.done and planner.missed == 0
    assert lies_in_bunk(FORWARDER.bunk, crane.logs[0])


def test_a_lost_encoder_still_pauses_it() -> None:
    crane = Blind(FORWARDER, [birch(0)], q=HOME)
    planner = activity(profile=FORWARDER)
    lost = replace(crane.report(), position=(nan, *crane.report().position[1:]))
    assert planner.step(crane.now_ns, lost, crane.seen()) is None
    assert planner.paused_code == "activity.position-unknown"
    assert crane.step(planner) is not None and planner.paused is None
    assert not isfinite(crane.report().position[Joint.ROT])


# -- the count
ANGLE = st.floats(-pi, pi)
ROTATORS = st.builds(RotatorEstimate, ANGLE, ANGLE, st.tuples(st.floats(*SCALE_BOUNDS), st.floats(*SCALE_BOUNDS)))


class Drifting(Blind):
    """Its rotator makes only part of every turn, and a gripped log lies across its jaws."""

    made = (0.85, 0.7)
    """Of turns to the negative and to the positive side."""
    true_rad = counted_rad = askew_rad = 0.0

    @contextmanager
    def _truly(self) -> Iterator[None]:
        counted, self.q = self.q, (*self.q[: Joint.ROT], self.true_rad)
        yield
        self.q = counted

    def _carry(self) -> None:
        turn = self.q[Joint.ROT] - self.counted_rad
        self.true_rad += self.made[turn > 0.0] * turn
        self.counted_rad = self.q[Joint.ROT]
        with self._truly():
            super()._carry()

    def _grip(self) -> None:
        with self._truly():
            (log,) = self.logs
            yaw = grapple_yaw(self.profile, self.q) - pi / 2
            self.askew_rad = remainder(atan2(log.axis[1], log.axis[0]) - yaw, pi)
            self._move(log.id, log.center_m, (cos(yaw), sin(yaw), 0.0))
            super()._grip()


def jobs(crane: StandIn, count: int, learns: bool = True, **how) -> Iterator[None]:
    """A log after the other is laid into the bunk; a step after each."""
    rests, rotator = HOME, None
    for seed in range(count):
        crane.logs = [birch(seed)]
        planner = activity(profile=FORWARDER, last_setpoint=rests, rotator=rotator, **how)
        crane.run(planner)
        assert planner.done, planner.failure
        rests, rotator = (planner.last_setpoint, planner.rotator) if learns else (crane.q, None)
        yield


def askew_deg(count: int, learns: bool) -> list[float]:
    """How far each log of a series of jobs was askew between the jaws."""
    crane = Drifting(FORWARDER, [], q=HOME)
    return [abs(degrees(crane.askew_rad)) for _ in jobs(crane, count, learns)]


@pytest.mark.long
def test_every_log_corrects_the_count() -> None:
    learned = askew_deg(7, learns=True)
    assert max(learned[2:]) < 8.0
    assert max(askew_deg(7, learns=False)) > 20.0, "without it the count drifts"


class Remembered(Drifting):
    """Its only camera looks ahead: the list remembers a load as the count says, and as it was last shown."""

    made = (0.75, 1.08)
    shown_rad, views = 0.0, 0

    def seen(self) -> tuple[LogObservation, ...]:
        if self.held is None:
            self.shown_rad = 0.0
            return super().seen()
        yaw = self.planner.last_setpoint[Joint.ROT] + grapple_yaw(self.profile, (*self.q[:4], 0.0)) - pi / 2
        axis = (cos(yaw + self.shown_rad), sin(yaw + self.shown_rad), 0.0)
        return tuple(replace(log, axis=axis) if log.id == self.held else log for log in self.logs)

    def step(self, activity: Activity) -> bytes | None:
        self.planner = activity
        data = super().step(activity)
        if activity.shows_load and (load := activity.view_load(tuple(self.logs))) is not None:
            self.views += 1
            yaw = activity.last_setpoint[Joint.ROT] + grapple_yaw(self.profile, (*self.q[:4], 0.0)) - pi / 2
            self.shown_rad = remainder(atan2(load.axis[1], load.axis[0]) - yaw, pi)
        return data


def laid_askew_deg(count: int, has_camera: bool) -> tuple[list[float], list[int]]:
    """How far each log of a series lies askew in the bunk, and how often it was shown."""
    crane, found, views = Remembered(FORWARDER, [], q=HOME), [], [0]
    for _ in jobs(crane, count, view=load_view(FORWARDER, 0.0) if has_camera else None):
        (log,) = crane.logs
        found.append(abs(degrees(remainder(atan2(log.axis[1], log.axis[0]) - FORWARDER.bunk.yaw_rad, pi))))
        views.append(crane.views)
    return found, np.diff(views).tolist()


@pytest.mark.long
def test_a_load_that_nothing_shows_is_held_before_the_camera_until_the_rotator_is_known() -> None:
    askew_deg, views = laid_askew_deg(8, has_camera=True)
    assert max(askew_deg) < 12.0 and views[0] == 1 and set(views) == {0, 1}, "shown once, and not always"
    assert max(laid_askew_deg(8, has_camera=False)[0]) > 30.0, "without it the count drifts"


@pytest.mark.long
def test_a_rotator_that_proves_slow_while_its_load_is_viewed_gets_slower_plans() -> None:
    """Its count must be faster for the same turn: at the speed that was planned before, the controller refuses it."""
    crane, spec = Remembered(FORWARDER, [birch(0)], q=HOME), FORWARDER.joints["rot"]
    crane.made = (0.65, 0.65)
    planner = activity(profile=FORWARDER, view=load_view(FORWARDER, 0.0))
    while not crane.views:
        crane.step(planner)
    pace = min(planner.rotator.paces)
    assert pace < 0.9
    assert planner.profile.joints["rot"].speed_limit == pytest.approx(pace * spec.speed_limit)
    crane.run(planner)
    assert planner.done, planner.failure


@pytest.mark.long
def test_a_load_that_no_picture_shows_is_laid_down_all_the_same_and_said() -> None:
    crane = Blind(FORWARDER, [birch(0)], q=HOME)
    planner = activity(profile=FORWARDER, view=load_view(FORWARDER, 0.0))
    crane.run(planner)
    assert planner.done and planner.load_unseen, planner.failure


SURE = RotatorEstimate(covariance=(1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4))
THIN_BIRCH = replace(
    birch(0), diameter_m=0.12, center_m=(*birch(0).center_m[:2], FORWARDER.workspace.ground_z_m + 0.06)
)


class Photographed(Blind):
    """Its camera ahead shows what it holds, turned by ``askew_rad``; nothing where ``pictures`` is False."""

    askew_rad, pictures, asked = 0.0, True, 0

    def step(self, activity: Activity) -> bytes | None:
        data = super().step(activity)
        if activity.shows_load:
            self.asked += 1
            c, s = cos(self.askew_rad), sin(self.askew_rad)
            held = [
                replace(log, axis=(c * log.axis[0] - s * log.axis[1], s * log.axis[0] + c * log.axis[1], 0.0))
                for log in self.logs
                if log.id == self.held
            ]
            activity.view_load(tuple(held) if self.pictures else ())
        return data


def shown(log: LogObservation, **told) -> tuple[Photographed, Activity]:
    """A job whose rotator is sure, at its end."""
    crane = Photographed(FORWARDER, [log], q=HOME)
    for name, value in told.items():
        setattr(crane, name, value)
    planner = activity(profile=FORWARDER, view=load_view(FORWARDER, 0.0), rotator=SURE)
    crane.run(planner)
    assert planner.done, planner.failure
    return crane, planner


@pytest.mark.parametrize(("log", "asks"), [(birch(0), False), (THIN_BIRCH, True)], ids=["weighed", "too light"])
def test_a_load_that_is_too_light_to_weigh_is_shown_although_the_rotator_is_sure(log, asks: bool) -> None:
    crane, planner = shown(log)
    assert bool(crane.asked) is planner.judged_by_picture is asks and not planner.load_missing


def test_a_rotator_with_an_encoder_needs_no_picture_but_for_a_light_load() -> None:
    joints = {
        **FORWARDER.joints,
        "rot": msgspec.structs.replace(FORWARDER.joints["rot"], encoder=LOADER.joints["rot"].encoder),
    }
    machine = msgspec.structs.replace(FORWARDER, joints=joints)
    view = load_view(machine, 0.0)
    assert view is not None and not view.is_needed(RotatorEstimate(covariance=(9.0, 0.0, 0.0, 1.0, 0.0, 1.0)), 3.0)
    crane = Photographed(machine, [THIN_BIRCH], q=HOME, feedback=False)
    crane.askew_rad = 0.4
    crane.report = lambda: replace(StandIn.report(crane), opening_pct=nan)  # type: ignore[method-assign]
    planner = activity(profile=machine, view=view)
    before = planner.rotator
    crane.run(planner)
    assert planner.done and crane.asked and planner.rotator == before and not planner.load_missing, planner.failure


def test_a_light_load_that_no_picture_shows_is_laid_down_and_missing() -> None:
    crane, planner = shown(THIN_BIRCH, pictures=False)
    assert crane.asked and planner.load_missing


def test_a_thin_log_that_lies_askew_in_the_jaws_is_not_blamed_on_the_rotator() -> None:
    """It was: the rotator was thought to stand 0.2 rad off, and the log came to lie across the stakes."""
    straight, askew = (shown(THIN_BIRCH, askew_rad=off)[1].rotator for off in (0.0, 0.4))
    assert askew.angle(askew.sent_rad) == pytest.approx(straight.angle(askew.sent_rad), abs=0.01)
    rotator, play = RotatorEstimate(covariance=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)), play_rad(0.12)
    assert [play_rad(d) for d in (0.12, 0.2, 0.3)] == pytest.approx([0.48, 0.0, 0.0])
    assert rotator.corrected(0.0, play, play).angle_rad == 0.0
    assert 0.1 < rotator.corrected(0.0, play + 0.3, play).angle_rad < 0.3
    assert VIEW_SIGMA_RAD < rotator.corrected(0.0, 0.0, play).sigma_rad < play < rotator.sigma_rad


def test_a_log_that_may_lie_askew_unseen_is_laid_so_far_from_the_stakes_that_its_ends_stay_between_them() -> None:
    bunk, across_m = FORWARDER.bunk, {}
    z = bunk.floor_z_m + 0.15
    middle = [
        replace(birch(0), id=10 + i, center_m=(bunk.center_m[0], y, z), axis=(1.0, 0.0, 0.0), diameter_m=0.3)
        for i, y in enumerate((-0.3, 0.0, 0.3))
    ]
    for askew_rad in (0.0, play_rad(THIN_BIRCH.diameter_m)):
        grasp = plan_single_log_grasp(ARM, THIN_BIRCH, 0.0)
        pose = plan_place(ARM, CraneJob(), grasp, middle, askew_rad=askew_rad)
        across_m[askew_rad] = abs(point_in_bunk(bunk, *ARM.xy(pose))[1])
    clasped_m, loose_m = across_m.values()
    assert clasped_m > 0.45, "on the floor beside the others"
    assert loose_m + 0.5 * THIN_BIRCH.length_m * sin(askew_rad) < 0.5 * bunk.width_m


def test_a_load_from_the_bunk_is_not_shown_for_its_weight_and_a_bundle_never() -> None:
    planner = activity(profile=FORWARDER, view=load_view(FORWARDER, 0.0))
    cycle = planner._cycle
    cycle.grasp = plan_single_log_grasp(ARM, THIN_BIRCH, 0.0)
    assert cycle.is_too_light
    cycle._job = CraneJob(source=FORWARDER.bunk, target=FORWARDER.bunk)
    assert not cycle.is_too_light
    crane = Photographed(FORWARDER, [birch(0)], q=HOME)

    def bundle(*told) -> Grasp:
        grasp = select_direct(*told)
        return replace(grasp, top_z_m=grasp.log.center_m[2] + 0.125)

    planner = activity(profile=FORWARDER, view=load_view(FORWARDER, 0.0), grasp_selector=bundle)
    crane.run(planner)
    assert planner.done and not crane.asked and not planner.load_unseen, planner.failure


def test_a_turn_there_and_back_does_not_end_where_it_began() -> None:
    rotator = RotatorEstimate(paces=(0.75, 1.08))
    there = rotator.turned(1.0)
    back = there.turned(0.0)
    assert (there.angle_rad, back.angle_rad) == pytest.approx((1.08, 0.33))
    assert rotator.sigma_rad < there.sigma_rad < back.sigma_rad
    assert back.turned(0.0) == back and back.corrected(0.0, 0.33).sigma_rad < there.sigma_rad


@given(ROTATORS, ANGLE)
def test_count_and_angle_are_inverse(rotator: RotatorEstimate, angle: float) -> None:
    assert rotator.angle(rotator.sent(angle)) == pytest.approx(angle)
    q = (0.1, 0.2, 0.3, 0.4, angle)
    assert rotator.to_angles(rotator.to_counts(q)) == pytest.approx(q)


@given(ROTATORS, ANGLE, ANGLE)
def test_observations_keep_the_count_within_a_quarter_turn_of_the_angle(rotator, sent, angle) -> None:
    seen = rotator.corrected(sent, angle)
    assert abs(seen.angle(sent) - sent) <= pi / 2 + 1e-9
    assert all(SCALE_BOUNDS[0] <= pace <= SCALE_BOUNDS[1] for pace in seen.paces)


def test_repeated_observations_find_the_ratio_of_angle_to_count() -> None:
    made, true, rotator, sent = (0.8, 1.1), 0.3, RotatorEstimate(), 0.0
    for goal in 4 * (1.5, -1.0, 1.2, -0.8, 1.0, -1.4):
        before, sent = sent, rotator.sent(goal)
        true += made[sent > before] * (sent - before)
        rotator = rotator.corrected(sent, true)
    assert rotator.paces == pytest.approx(made, abs=0.02)
    assert remainder(rotator.angle(sent) - true, pi) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("rounding_rad", [0.0, 4e-16, -4e-16])
@pytest.mark.parametrize(("speed", "pace"), [(-1.0, 0.8), (1.0, 1.25)])
def test_a_turn_has_one_pace_from_where_the_rotator_stands(rounding_rad: float, speed: float, pace: float) -> None:
    class Turn:
        duration_s = 1.0

        def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
            return (0.0,) * 4 + (2.0 + rounding_rad,), (0.0,) * 4 + (speed,)

    _, velocity = RotatorEstimate(1.0, 2.0, (0.8, 1.25)).motion(Turn()).at(0.0)
    assert velocity[4] == pytest.approx(speed / pace)


def test_a_rotator_without_encoder_is_planned_within_half_its_range_and_its_command_limit() -> None:
    whole, slow = FORWARDER.joints["rot"], planning_profile(FORWARDER, RotatorEstimate(paces=(0.9, 0.8))).joints["rot"]
    assert (slow.lower, slow.upper) == (whole.lower / 2, whole.upper / 2)
    assert slow.speed_limit == pytest.approx(0.8 * whole.speed_limit)
    assert planning_profile(FORWARDER, RotatorEstimate(paces=(1.3, 1.1))).joints["rot"].speed_limit == whole.speed_limit
    assert has_no_encoder(FORWARDER) and planning_profile(LOADER, RotatorEstimate(paces=(0.9, 0.8))) is LOADER


def test_a_rotator_with_encoder_is_left_as_it_is() -> None:
    crane = StandIn(LOADER, [replace(birch(0), center_m=(-1.8, 4.4, -1.29), length_m=2.6, diameter_m=0.2)])
    planner = activity(profile=LOADER)
    crane.run(planner)
    assert planner.done and planner.rotator == RotatorEstimate()


# -- a load before the camera ahead
def hanging(pose: Pose, length_m: float = 2.0, diameter_m: float = 0.25) -> LogObservation:
    """A log across the jaws of a grapple at a pose."""
    yaw = grapple_yaw(FORWARDER, tuple(ARM.joints(np.array([pose]))[0].tolist())) - pi / 2
    (x, y), drop_m = ARM.xy(pose), lowest_tip_below_pin_m(FORWARDER.grapple.jaws) - diameter_m / 2
    return LogObservation(4, (x, y, pose.z_m - drop_m), (cos(yaw), sin(yaw), 0.0), length_m, diameter_m)


@pytest.mark.parametrize("slew_rad", [-2.6, -0.5, 0.8, 2.6])
@pytest.mark.parametrize("articulation_rad", [-0.4, 0.0, 0.4])
def test_the_whole_load_is_in_the_picture_and_across_the_view(slew_rad: float, articulation_rad: float) -> None:
    view = load_view(FORWARDER, articulation_rad)
    x, y = 5.0 * cos(slew_rad), 5.0 * sin(slew_rad)
    pose = view.pose(ARM, ARM.pose_above(x, y, 1.0, 3.0), 0.25)
    load = hanging(pose)
    mount = optical_pose(FORWARDER, CAMERA, (0.0,) * 5, articulation_rad)
    for side in (-0.5, 0.5):
        px, py, depth_m = mount.to_optical(np.array(load.center_m) + side * load.length_m * np.array(load.axis))
        u, v = CAMERA.cx_px + CAMERA.fx_px * px / depth_m, CAMERA.cy_px + CAMERA.fy_px * py / depth_m
        assert depth_m > 1.5 and 0 < u < CAMERA.width_px and 0 < v < CAMERA.height_px
    assert abs(np.array(load.axis) @ mount.rotation[:, 2]) < 0.05
    ground_m = FORWARDER.workspace.ground_z_m
    assert load.center_m[2] - ground_m > 1.0, "clear of the ground"


def test_a_load_is_shown_while_the_rotator_is_unsure_and_sooner_where_the_camera_is_near() -> None:
    view = load_view(FORWARDER, 0.0)

    def rotator(sigma_rad: float) -> RotatorEstimate:
        return RotatorEstimate(covariance=(sigma_rad**2, 0.0, 0.0, 0.0, 0.0, 0.0))

    assert view.is_needed(rotator(UNSURE_RAD + 0.01), 0.0) and not view.is_needed(rotator(UNSURE_RAD - 0.01), 0.0)
    for side in (-1.0, 1.0):
        assert view.is_needed(rotator(UNSURE_AHEAD_RAD + 0.01), side * (AHEAD_RAD + 0.1))
    assert not view.is_needed(rotator(UNSURE_AHEAD_RAD - 0.01), AHEAD_RAD + 0.1)


def test_a_machine_with_an_encoder_or_without_a_camera_ahead_shows_nothing() -> None:
    assert load_view(LOADER, 0.0) is None
    assert load_view(msgspec.structs.replace(FORWARDER, cameras={}), 0.0) is None


def test_the_load_is_the_longest_log_between_the_jaws() -> None:
    pose = ARM.pose_above(-5.0, 2.0, 1.7, 3.0)
    load = hanging(pose)
    x, y, z = load.center_m
    part = replace(load, id=1, length_m=0.8)
    below = replace(load, id=2, center_m=(x, y, FORWARDER.workspace.ground_z_m + 0.1))
    beside = replace(load, id=3, center_m=(x + 2.0, y + 2.0, z))
    assert load_in_view(ARM, [part, below, load, beside], pose) is load
    assert load_in_view(ARM, [below, beside], pose) is None
