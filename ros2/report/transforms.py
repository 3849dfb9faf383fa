"""``/tf`` and ``/tf_static``: the frames of the machine, named as in REP 105, axes as in REP 103.

``base_link`` is the crane's base frame.  ``boom_link`` and ``stick_link`` are the link frames of
docs/reference/machines.md section 1.1, ``hanger_link`` is level at the hanger pin and turns with the slew, and
``grapple_link`` hangs below it, without swing, at the pivot of the jaws, with x along the opening.  A camera's frame is
its optical one.  On a machine with a carrier ``rear_link`` carries the crane and ``front_link``.  These are encoder
kinematics: sag and swing are not in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, sin, sqrt

import numpy as np

from autonomy.perception.camera.frame import Pose
from autonomy.perception.camera.mount import link_pose
from machine.geometry.carrier import rear_from_base
from machine.geometry.grapple import grapple_yaw, pin_to_jaw_pivot_m
from machine.geometry.kinematics import pin_position
from machine.geometry.optics import BODY_FROM_OPTICAL, rpy_matrix
from machine.joints import Joint
from machine.profile import Profile
from ros2.interfaces.builtin import Header, Quaternion, TFMessage, Transform, TransformStamped, Vector3, time_of

BASE, BOOM, STICK, HANGER, GRAPPLE = "base_link", "boom_link", "stick_link", "hanger_link", "grapple_link"
REAR, FRONT = "rear_link", "front_link"


def camera_frame(camera: str) -> str:
    """The frame of a camera's pictures."""
    return f"{camera}_optical_frame"


def static_transforms(profile: Profile, stamp_ns: int) -> TFMessage:
    """What does not move: the cameras on their links, and the crane on the carrier."""
    found = [
        _stamped(
            stamp_ns,
            f"{camera.link}_link",
            camera_frame(name),
            Pose(np.asarray(camera.position_m, float), rpy_matrix(camera.rpy_rad) @ BODY_FROM_OPTICAL),
        )
        for name, camera in profile.cameras.items()
    ]
    if profile.carrier is not None:
        carrier = profile.carrier
        base = Pose(np.array(rear_from_base(carrier, (0.0, 0.0, 0.0))), _about_z(carrier.crane_yaw_rad))
        found.append(_stamped(stamp_ns, REAR, BASE, base))
    return TFMessage(found)


def moving_transforms(profile: Profile, q: Sequence[float], articulation_rad: float, stamp_ns: int) -> TFMessage:
    """What moves, of joints ``q`` (`Joint` order, rad, EXT m); a transform with an unknown joint is left out."""
    found = []
    if profile.carrier is not None and isfinite(articulation_rad):
        found.append(_stamped(stamp_ns, REAR, FRONT, Pose(np.zeros(3), _about_z(articulation_rad))))
    if not all(map(isfinite, q[: Joint.ROT])):
        return TFMessage(found)
    kin = profile.kinematics
    boom, stick = link_pose(profile, "boom", q), link_pose(profile, "stick", q)
    slew_rad = grapple_yaw(profile, (*q[: Joint.ROT], 0.0))
    hanger = Pose(np.array(pin_position(kin, q)), _about_z(slew_rad))
    found += [
        _stamped(stamp_ns, BASE, BOOM, boom),
        _stamped(stamp_ns, BOOM, STICK, _relative(boom, stick)),
        _stamped(stamp_ns, STICK, HANGER, _relative(stick, hanger)),
    ]
    if isfinite(q[Joint.ROT]):
        below = Pose(np.array((0.0, 0.0, -pin_to_jaw_pivot_m(kin))), _about_z(q[Joint.ROT]))
        found.append(_stamped(stamp_ns, HANGER, GRAPPLE, below))
    return TFMessage(found)


def quaternion(rotation: np.ndarray) -> Quaternion:
    """The quaternion of a rotation matrix (3, 3), scalar positive (Shepperd 1978)."""
    m = rotation
    squares = np.array(
        [
            1.0 + m[0, 0] - m[1, 1] - m[2, 2],
            1.0 - m[0, 0] + m[1, 1] - m[2, 2],
            1.0 - m[0, 0] - m[1, 1] + m[2, 2],
            1.0 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    greatest = int(np.argmax(squares))
    half = 0.5 * sqrt(squares[greatest])
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    rows = ((0.0, xy, xz, wx), (xy, 0.0, yz, wy), (xz, yz, 0.0, wz), (wx, wy, wz, 0.0))
    parts = [value / (4.0 * half) for value in rows[greatest]]
    parts[greatest] = half
    sign = -1.0 if parts[3] < 0.0 else 1.0
    return Quaternion(*(sign * float(part) for part in parts))


def _about_z(angle_rad: float) -> np.ndarray:
    c, s = cos(angle_rad), sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _relative(parent: Pose, child: Pose) -> Pose:
    """The child in its parent's frame, both given in the base frame."""
    back = parent.rotation.T
    return Pose(back @ (child.position_m - parent.position_m), back @ child.rotation)


def _stamped(stamp_ns: int, parent: str, child: str, pose: Pose) -> TransformStamped:
    x, y, z = (float(value) for value in pose.position_m)
    transform = Transform(Vector3(x, y, z), quaternion(pose.rotation))
    return TransformStamped(Header(time_of(stamp_ns), parent), child, transform)
