"""Where a crane shows its load to the camera ahead, and which of the logs in the picture is the load."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from autonomy.crane_job.rotator_estimate import (
    AHEAD_RAD,
    UNSURE_AHEAD_RAD,
    UNSURE_RAD,
    RotatorEstimate,
    load_in_view,
    load_view,
)
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.camera.frame import optical_pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m
from machine.loading.profile_file import load_profile

FORWARDER, LOADER = load_profile("aoro_fc8"), load_profile("palms_471")
ARM = Arm(FORWARDER)
CAMERA = FORWARDER.cameras["front"]


def hanging(pose: Pose, length_m: float = 2.0, diameter_m: float = 0.25) -> LogObservation:
    """A log across the jaws of a grapple at a pose."""
    yaw = grapple_yaw(FORWARDER, tuple(ARM.joints(np.array([pose]))[0].tolist())) - math.pi / 2
    (x, y), drop_m = ARM.xy(pose), lowest_tip_below_pin_m(FORWARDER.grapple.jaws) - diameter_m / 2
    return LogObservation(4, (x, y, pose.z_m - drop_m), (math.cos(yaw), math.sin(yaw), 0.0), length_m, diameter_m)


@pytest.mark.parametrize("slew_rad", [-2.6, -0.5, 0.8, 2.6])
@pytest.mark.parametrize("articulation_rad", [-0.4, 0.0, 0.4])
def test_the_whole_load_is_in_the_picture_and_across_the_view(slew_rad: float, articulation_rad: float) -> None:
    view = load_view(FORWARDER, articulation_rad)
    assert view is not None
    x, y = 5.0 * math.cos(slew_rad), 5.0 * math.sin(slew_rad)
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
    assert view is not None

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
