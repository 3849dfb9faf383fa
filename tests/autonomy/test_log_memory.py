"""Logs that no camera sees: where they are remembered to be, on the ground, in the grapple and in the bunk."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.grasp.planner import hangs_below
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.manager.load_detector import WINDOW_NS
from autonomy.manager.log_map import LogMap
from autonomy.manager.log_memory import PERIOD_NS, LogMemory
from autonomy.motion.arm_kinematics import Arm
from machine.loading.profile_file import load_profile
from tests.autonomy.mapped_logs import base, lying, seen

PROFILE = load_profile("aoro_fc8")
ARM = Arm(PROFILE)
HERE = base(0.0, 0.0, math.pi)


def field_of(*places: tuple[float, float]) -> LogMap:
    """A field with logs that were seen twice, 0.15 m over the ground under a base that is 1.5 m up."""
    field = LogMap(PROFILE.bunk)
    logs = [lying(i, x, y, 0.3) for i, (x, y) in enumerate(places)]
    for k in range(2):
        field.observe(seen(logs, HERE), HERE, k)
    return field


class Hands:
    """A job with a crane pose set by the test; `step` makes one step of the memory."""

    def __init__(self, field: LogMap) -> None:
        self.memory, self.field, self.now_ns = LogMemory(PROFILE), field, 0
        self.job: Any = None
        self.load_kg, self.q = math.nan, (0.0,) * 5

    def begin(self) -> None:
        log = self.field.logs[0].observation(HERE)
        grasp = plan_single_log_grasp(ARM, log, 0.0)
        self.job = SimpleNamespace(grasp=grasp, phase=Phase.LOOK, last_setpoint=(0.0,) * 5)
        self.to(grasp.pose)

    def to(self, pose: Any) -> None:
        self.q = tuple(ARM.joints(np.array([pose]))[0].tolist())
        self.job.last_setpoint = self.q

    def step(self, phase: Phase | None = None) -> tuple:
        if phase is not None:
            self.job.phase = phase
        self.now_ns += PERIOD_NS
        report = SimpleNamespace(stamp_ns=self.now_ns, position=self.q, load_kg=self.load_kg)
        logs = self.memory.log_list(self.now_ns, self.field, HERE, report, self.job)
        assert logs is not None
        return logs


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
    hands.begin()
    grasp = hands.job.grasp
    for phase in (Phase.LOOK, Phase.ABOVE, Phase.CLOSE, Phase.LIFT):
        (log,) = hands.step(phase)
        assert log.center_m == pytest.approx(grasp.log.center_m, abs=0.02)
    hands.load_kg = 80.0
    high = grasp.pose.at_height(grasp.pose.z_m + 1.0)
    hands.to(high)
    (log,) = hands.step(Phase.CARRY)
    assert log.center_m[2] == pytest.approx(grasp.log.center_m[2] + 1.0, abs=0.02) and hangs_below(ARM, log, high)
    x, y = PROFILE.bunk.center_m
    place = ARM.pose_above(x, y, 1.7, 2.0)
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
    hands.begin()
    grasp, hands.load_kg = hands.job.grasp, 3.0
    for phase in (Phase.CLOSE, Phase.LIFT):
        hands.step(phase)
    hands.to(grasp.pose.at_height(grasp.pose.z_m + 1.0))
    for _ in range(WINDOW_NS // PERIOD_NS + 2):
        (log,) = hands.step()
    assert log.center_m == pytest.approx(grasp.log.center_m, abs=1e-6)
    assert hands.memory.in_bunk == 0


def test_a_short_low_reading_does_not_lose_the_log() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.begin()
    grasp, hands.load_kg = hands.job.grasp, 90.0
    for phase in (Phase.CLOSE, Phase.LIFT):
        hands.step(phase)
    hands.to(grasp.pose.at_height(grasp.pose.z_m + 1.0))
    for load_kg in (130.0, 160.0, 110.0, 90.0, 40.0, 3.0, 0.0, 0.0, 30.0, 90.0, 110.0):
        hands.load_kg = load_kg
        (log,) = hands.step()
        assert log.center_m[2] > grasp.log.center_m[2] + 0.9


def test_without_a_scale_the_log_is_assumed_to_hang() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.begin()
    for phase in (Phase.CLOSE, Phase.LIFT):
        hands.step(phase)
    hands.to(hands.job.grasp.pose.at_height(hands.job.grasp.pose.z_m + 1.0))
    (log,) = hands.step()
    assert log.center_m[2] > hands.job.grasp.log.center_m[2] + 0.9


def test_a_load_that_a_camera_has_seen_hangs_as_it_was_seen() -> None:
    hands = Hands(field_of((-4.0, 3.0)))
    hands.begin()
    for phase in (Phase.CLOSE, Phase.LIFT):
        hands.step(phase)
    hands.to(hands.job.grasp.pose.at_height(hands.job.grasp.pose.z_m + 1.0))
    (log,) = hands.step()
    yaw = math.atan2(log.axis[1], log.axis[0]) + 0.6
    report = SimpleNamespace(stamp_ns=hands.now_ns, position=hands.q, load_kg=math.nan)
    # Its other end first, and without its middle: only the direction counts.
    shown = replace(log, id=9, axis=(-math.cos(yaw), -math.sin(yaw), 0.0), length_m=1.0)
    hands.memory.correct(shown, report)
    (after,) = hands.step()
    assert math.remainder(math.atan2(after.axis[1], after.axis[0]) - yaw, math.pi) == pytest.approx(0.0, abs=1e-9)
    assert after.length_m == log.length_m and after.id == log.id
