"""What the machine tells ROS 2: joints, transforms, diagnostics, feedback and pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from autonomy.perception.camera.frame import RgbdFrame, optical_pose
from can_dbc.messages.crane import StateReport
from machine.geometry.grapple import grapple_yaw
from machine.geometry.kinematics import chain_points
from machine.geometry.optics import Intrinsics, rpy_matrix
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason
from machine.status.stale_inputs import STALE_INPUT_NAMES
from ros2.execution.execution import Progress
from ros2.interfaces.builtin import Quaternion, TransformStamped
from ros2.interfaces.diagnostic import ERROR, OK, STALE, WARN
from ros2.report import (
    camera_frame,
    camera_info,
    colour_image,
    depth_image,
    diagnostics,
    feedback_message,
    joint_state,
    moving_transforms,
    quaternion,
    static_transforms,
)
from tests.codes import numbers_in
from tests.ros2.goals import report

Q = (-0.4, 0.6, -1.3, 0.5, 0.7)
STAMP_NS = 1_795_690_741_202_842_462


def matrix(q: Quaternion) -> np.ndarray:
    """The rotation matrix of a quaternion (Hamilton, scalar last)."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def in_base(transforms: list[TransformStamped], frame: str, base: str = "base_link") -> np.ndarray:
    """The pose of a frame in the base frame (4, 4), along the tree."""
    pose = np.eye(4)
    while frame != base:
        edge = next(t for t in transforms if t.child_frame_id == frame)
        move, step = edge.transform.translation, np.eye(4)
        step[:3, :3], step[:3, 3] = matrix(edge.transform.rotation), (move.x, move.y, move.z)
        pose, frame = step @ pose, edge.header.frame_id
    return pose


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_the_frames_are_where_the_kinematics_have_them(name: str) -> None:
    profile = load_profile(name)
    moving, static = moving_transforms(profile, Q, 0.2, STAMP_NS), static_transforms(profile, STAMP_NS)
    transforms = [*moving.transforms, *static.transforms]
    points = chain_points(profile.kinematics, Q)
    expected = (points.boom_pin, points.stick_pin, points.hanger_pin, points.grapple)
    for frame, point in zip(("boom_link", "stick_link", "hanger_link", "grapple_link"), expected, strict=True):
        assert in_base(transforms, frame)[:3, 3] == pytest.approx(point, abs=1e-9)
    yaw = grapple_yaw(profile, Q)
    assert in_base(transforms, "grapple_link")[:3, 0] == pytest.approx((math.cos(yaw), math.sin(yaw), 0.0), abs=1e-9)
    children = [t.child_frame_id for t in transforms]
    assert len(set(children)) == len(children)


@pytest.mark.parametrize(("name", "camera"), [("palms_471", "stick"), ("palms_471", "d435")])
def test_a_cameras_frame_is_where_perception_has_it(name: str, camera: str) -> None:
    profile = load_profile(name)
    moving, static = moving_transforms(profile, Q, 0.0, STAMP_NS), static_transforms(profile, STAMP_NS)
    pose = in_base([*moving.transforms, *static.transforms], camera_frame(camera))
    expected = optical_pose(profile, profile.cameras[camera], Q)
    assert pose[:3, 3] == pytest.approx(expected.position_m, abs=1e-9)
    assert pose[:3, :3] == pytest.approx(expected.rotation, abs=1e-9)


def test_unknown_joints_have_no_transform() -> None:
    profile = load_profile("palms_471")
    unknown = (*Q[:4], math.nan)
    frames = [t.child_frame_id for t in moving_transforms(profile, unknown, math.nan, 0).transforms]
    assert frames == ["boom_link", "stick_link", "hanger_link"]
    assert moving_transforms(profile, (math.nan, *Q[1:]), math.nan, 0).transforms == []


@pytest.mark.parametrize("rpy", [(0.1, 0.2, 0.3), (3.1, 0.1, 0.2), (0.1, 3.0, 0.1), (0.2, 0.1, 3.14), (0.0, 0.0, 0.0)])
def test_quaternions(rpy: tuple[float, float, float]) -> None:
    made = quaternion(rpy_matrix(rpy))
    assert matrix(made) == pytest.approx(rpy_matrix(rpy), abs=1e-12) and made.w >= 0.0


def test_joint_states_have_known_joints_only() -> None:
    position = (0.1, 0.2, 0.3, 0.4, math.nan)
    made = joint_state(report(position=position, velocity=(1.0, 2.0, 3.0, 4.0, 5.0)), STAMP_NS)
    assert made.name == ["slew", "lift", "tilt", "ext"] and made.position == [0.1, 0.2, 0.3, 0.4]
    assert made.velocity == [1.0, 2.0, 3.0, 4.0] and made.effort == []
    assert made.header.stamp.sec * 10**9 + made.header.stamp.nanosec == STAMP_NS


@pytest.mark.parametrize(
    ("state", "level", "words"),
    [
        (report(Mode.ARMED), OK, "ARMED"),
        (report(Mode.STOP, reason=Reason.LEASE_LOST), WARN, "[LEASE_LOST]"),
        (report(Mode.FAULT, reason=Reason.NODE_ABSENT), ERROR, "[NODE_ABSENT]"),
        (report(Mode.STOP, reason=250), WARN, "unknown reason 250"),
        (None, STALE, ""),
    ],
)
def test_diagnostics_tell_mode_and_reason(state: StateReport | None, level: int, words: str) -> None:
    (status,) = diagnostics("palms_471", state, "", STAMP_NS).status
    assert (status.level, status.hardware_id) == (level, "palms_471") and words in status.message


def test_diagnostics_tell_stale_inputs_and_the_last_refused_goal() -> None:
    (status,) = diagnostics("palms_471", report(stale_mask=3, load_kg=math.nan), "too fast", STAMP_NS).status
    values = {pair.key: pair.value for pair in status.values}
    assert values["stale inputs"] == f"{STALE_INPUT_NAMES[0]}, {STALE_INPUT_NAMES[1]}"
    assert not numbers_in(values["load [kg]"])
    assert values["last goal that was not executed"] == "too fast"


@pytest.mark.parametrize("with_index", [True, False])
def test_feedback_is_in_the_order_of_the_goal(with_index: bool) -> None:
    progress = Progress(1.5, 2, (Joint.LIFT, Joint.SLEW), ((0.5, 0.1), (0.0, 0.2)), ((0.4, 0.3), (0.1, 0.0)))
    made: Any = feedback_message(bytes(16), progress, with_index, STAMP_NS).feedback
    assert made.joint_names == ["lift", "slew"] and made.desired.positions == [0.5, 0.1]
    assert made.error.positions == pytest.approx([0.1, -0.2]) and made.error.velocities == pytest.approx([-0.1, 0.2])
    assert made.actual.time_from_start.nanosec == 500_000_000
    assert getattr(made, "index", None) == (2 if with_index else None)


def test_pictures_are_the_bytes_of_the_frame() -> None:
    rgb = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    depth = np.array([[1.0, 2.5, math.nan], [0.001, 70.0, 3.0]], np.float32)
    frame = RgbdFrame("d435", 0, rgb, depth, Intrinsics(3, 2, 10.0, 11.0, 1.0, 0.5))
    colour, deep, info = (make(frame, STAMP_NS) for make in (colour_image, depth_image, camera_info))
    assert colour.data == rgb.tobytes() and (colour.height, colour.width, colour.step) == (2, 3, 9)
    assert np.frombuffer(bytes(deep.data), "<u2").tolist() == [1000, 2500, 0, 1, 65535, 3000] and deep.step == 6
    assert colour.header.frame_id == deep.header.frame_id == info.header.frame_id == "d435_optical_frame"
    assert info.k == [10.0, 0.0, 1.0, 0.0, 11.0, 0.5, 0.0, 0.0, 1.0] and info.p[3] == 0.0
