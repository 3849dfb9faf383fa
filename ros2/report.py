"""What the bridge publishes about the machine: joint states, transforms, diagnostics, feedback and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, sin, sqrt
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame, link_pose
from can_dbc.messages.crane import StateReport
from can_dbc.messages.rgbd import MM_PER_M
from machine.geometry.carrier import rear_from_base
from machine.geometry.grapple import grapple_yaw, pin_to_jaw_pivot_m
from machine.geometry.kinematics import pin_position
from machine.geometry.optics import BODY_FROM_OPTICAL, rpy_matrix
from machine.joints import JOINTS, Joint
from machine.profile import Profile
from machine.status.modes import Mode
from machine.status.stale_inputs import STALE_INPUT_NAMES
from ros2.execution.execution import Progress, described
from ros2.interfaces.builtin import (
    NS_PER_S,
    UUID,
    Header,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    Vector3,
    duration_of,
    time_of,
)
from ros2.interfaces.control import (
    Feedback,
    FeedbackMessage,
    FeedbackMessageWithoutIndex,
    FeedbackWithoutIndex,
)
from ros2.interfaces.diagnostic import ERROR, OK, STALE, WARN, DiagnosticArray, DiagnosticStatus, KeyValue
from ros2.interfaces.sensor import CameraInfo, Image, JointState, RegionOfInterest
from ros2.interfaces.trajectory import JointTrajectoryPoint, MultiDOFJointTrajectoryPoint

# -- ``/joint_states``: the measured joints, by the names of the profile.


def joint_state(report: StateReport, stamp_ns: int) -> JointState:
    """List the joints of a report with known positions; ``stamp_ns`` is the report's time since the epoch."""
    known = [j for j in JOINTS if isfinite(report.position[j]) and isfinite(report.velocity[j])]
    return JointState(
        Header(time_of(stamp_ns), ""),
        [j.name.lower() for j in known],
        [report.position[j] for j in known],
        [report.velocity[j] for j in known],
        [],
    )


# -- ``/tf`` and ``/tf_static``: the frames of the machine, named as in REP 105, axes as in REP 103.
#
# ``base_link`` is the crane's base frame.  ``boom_link`` and ``stick_link`` are the link frames of
# docs/reference/machines.md section 1.1, ``hanger_link`` is level at the hanger pin and turns with the slew, and
# ``grapple_link`` hangs below it, without swing, at the pivot of the jaws, with x along the opening.  A camera's
# frame is its optical one.  On a machine with a carrier ``rear_link`` carries the crane and ``front_link``.  These
# are encoder kinematics: sag and swing are not in them.

BASE, BOOM, STICK, HANGER, GRAPPLE = "base_link", "boom_link", "stick_link", "hanger_link", "grapple_link"
REAR, FRONT = "rear_link", "front_link"


def camera_frame(camera: str) -> str:
    """Name the frame of a camera's pictures."""
    return f"{camera}_optical_frame"


def static_transforms(profile: Profile, stamp_ns: int) -> TFMessage:
    """Return what does not move: the cameras on their links, and the crane on the carrier."""
    transforms = [
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
        transforms.append(_stamped(stamp_ns, REAR, BASE, base))
    return TFMessage(transforms)


def moving_transforms(profile: Profile, q: Sequence[float], articulation_rad: float, stamp_ns: int) -> TFMessage:
    """Return what moves, of joints ``q`` (`Joint` order, rad, EXT m); a transform with an unknown joint is left out."""
    transforms = []
    if profile.carrier is not None and isfinite(articulation_rad):
        transforms.append(_stamped(stamp_ns, REAR, FRONT, Pose(np.zeros(3), _about_z(articulation_rad))))
    if not all(map(isfinite, q[: Joint.ROT])):
        return TFMessage(transforms)
    kin = profile.kinematics
    boom, stick = link_pose(profile, "boom", q), link_pose(profile, "stick", q)
    slew_rad = grapple_yaw(profile, (*q[: Joint.ROT], 0.0))
    hanger = Pose(np.array(pin_position(kin, q)), _about_z(slew_rad))
    transforms += [
        _stamped(stamp_ns, BASE, BOOM, boom),
        _stamped(stamp_ns, BOOM, STICK, _relative(boom, stick)),
        _stamped(stamp_ns, STICK, HANGER, _relative(stick, hanger)),
    ]
    if isfinite(q[Joint.ROT]):
        below = Pose(np.array((0.0, 0.0, -pin_to_jaw_pivot_m(kin))), _about_z(q[Joint.ROT]))
        transforms.append(_stamped(stamp_ns, HANGER, GRAPPLE, below))
    return TFMessage(transforms)


def quaternion(rotation: np.ndarray) -> Quaternion:
    """Compute the quaternion of a rotation matrix (3, 3), scalar positive (Shepperd 1978)."""
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
    """Compute the child in its parent's frame, both given in the base frame."""
    back = parent.rotation.T
    return Pose(back @ (child.position_m - parent.position_m), back @ child.rotation)


def _stamped(stamp_ns: int, parent: str, child: str, pose: Pose) -> TransformStamped:
    x, y, z = (float(value) for value in pose.position_m)
    transform = Transform(Vector3(x, y, z), quaternion(pose.rotation))
    return TransformStamped(Header(time_of(stamp_ns), parent), child, transform)


# -- ``/diagnostics``: the machine's mode, and the reason why it stopped or cannot be armed, in the operator's words.

SILENT_NS: Final = 1_000_000_000
"""Without a report for so long the machine's state is unknown."""
_LEVELS: Final = {Mode.STOP: WARN, Mode.FAULT: ERROR, Mode.BOOT: WARN}


def diagnostics(machine: str, report: StateReport | None, refused: str, stamp_ns: int) -> DiagnosticArray:
    """Report the state of the machine by its last ``report``, None when it is silent.

    ``refused`` is the sentence about the last goal that was not executed, empty when there is none.
    """
    if report is None:
        status = DiagnosticStatus(STALE, "timberhand: machine", "the controller is silent", machine, [])
        return DiagnosticArray(Header(time_of(stamp_ns), ""), [status])
    mode = next((mode for mode in Mode if mode == report.mode), None)
    name = str(report.mode) if mode is None else mode.name
    level = WARN if mode is None else _LEVELS.get(mode, WARN if report.reason else OK)
    text = f"{name}: {described(report.reason, report.numbers)}" if report.reason else name
    stale_inputs = [input_name for bit, input_name in sorted(STALE_INPUT_NAMES.items()) if report.stale_mask >> bit & 1]
    values = {
        "mode": name,
        "reason": str(report.reason & 0xFF),
        "stale inputs": ", ".join(stale_inputs) or "none",
        "refused setpoints": str(report.refused),
        "load [kg]": _number(report.load_kg),
        "grapple opening [%]": _number(report.opening_pct),
        "missed ticks": str(report.missed_ticks),
        "last goal that was not executed": refused or "none",
    }
    pairs = [KeyValue(key, value) for key, value in values.items()]
    status = DiagnosticStatus(level, "timberhand: machine", text, machine, pairs)
    return DiagnosticArray(Header(time_of(stamp_ns), ""), [status])


def _number(value: float) -> str:
    return f"{value:.1f}" if isfinite(value) else "unknown"


# -- The feedback of a goal: where the crane shall be now, where it is, and the difference.


def feedback_message(
    goal_id: bytes, progress: Progress, with_index: bool, stamp_ns: int
) -> FeedbackMessage | FeedbackMessageWithoutIndex:
    """Make the message of a goal's progress; ``with_index`` as of control_msgs 6.3 and later."""
    head = Header(time_of(stamp_ns), "")
    names = [j.name.lower() for j in progress.joints]
    error = (_difference(progress, 0), _difference(progress, 1))
    desired, actual, off = (_point(state, progress.time_s) for state in (progress.desired, progress.actual, error))
    none = MultiDOFJointTrajectoryPoint([], [], [], duration_of(0))
    if with_index:
        feedback = Feedback(head, names, desired, actual, off, progress.point, [], none, none, none, 0)
        return FeedbackMessage(UUID(goal_id), feedback)
    plain = FeedbackWithoutIndex(head, names, desired, actual, off, [], none, none, none)
    return FeedbackMessageWithoutIndex(UUID(goal_id), plain)


def _difference(progress: Progress, derivative: int) -> tuple[float, ...]:
    pairs = zip(progress.desired[derivative], progress.actual[derivative], strict=True)
    return tuple(desired - actual for desired, actual in pairs)


def _point(state: tuple[Sequence[float], Sequence[float]], time_s: float) -> JointTrajectoryPoint:
    position, velocity = state
    return JointTrajectoryPoint(list(position), list(velocity), [], [], duration_of(round(time_s * NS_PER_S)))


# -- A camera's pictures: colour, depth (REP 118: u16 mm, 0 is unknown) and the calibration of both.

_DEPTH_MAX_MM = 65535


def colour_image(frame: RgbdFrame, stamp_ns: int) -> Image:
    """Make the message of the picture; ``stamp_ns`` is its time since the epoch."""
    height, width, _ = frame.rgb.shape
    return Image(_header(frame, stamp_ns), height, width, "rgb8", 0, 3 * width, frame.rgb.tobytes())


def depth_image(frame: RgbdFrame, stamp_ns: int) -> Image:
    """Make the message of the depth of the same pixels."""
    height, width = frame.depth_m.shape
    millimetres = np.clip(np.nan_to_num(np.rint(frame.depth_m * MM_PER_M)), 0, _DEPTH_MAX_MM).astype("<u2")
    return Image(_header(frame, stamp_ns), height, width, "16UC1", 0, 2 * width, millimetres.tobytes())


def camera_info(frame: RgbdFrame, stamp_ns: int) -> CameraInfo:
    """Describe the pinhole of both, which are rectified: no distortion is left."""
    pin = frame.intrinsics
    k = [pin.fx_px, 0.0, pin.cx_px, 0.0, pin.fy_px, pin.cy_px, 0.0, 0.0, 1.0]
    p = [pin.fx_px, 0.0, pin.cx_px, 0.0, 0.0, pin.fy_px, pin.cy_px, 0.0, 0.0, 0.0, 1.0, 0.0]
    r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    whole = RegionOfInterest(0, 0, 0, 0, False)
    return CameraInfo(
        _header(frame, stamp_ns), pin.height_px, pin.width_px, "plumb_bob", [0.0] * 5, k, r, p, 0, 0, whole
    )


def _header(frame: RgbdFrame, stamp_ns: int) -> Header:
    return Header(time_of(stamp_ns), camera_frame(frame.camera))
