"""The pose of a camera in the crane's base frame, from joint positions.

Links that carry cameras: ``base``, ``boom`` and ``stick`` of the crane, ``rear`` and ``front`` of the carrier.  Link
frames are the machine's: of boom and stick y is along the reach, x to the right, z up, the origin at the joint
(docs/reference/machines.md section 1.1); the carrier's are those of ``machine.geometry.carrier``.
The kinematics are rigid: the sag of the arm and the deflection of the tyres are not modelled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import Pose
from machine.geometry.carrier import base_from_rear, rear_from_front
from machine.geometry.kinematics import chain_points
from machine.geometry.optics import BODY_FROM_OPTICAL, rpy_matrix
from machine.joints import Joint
from machine.profile import Camera, Profile
from runtime.errors import InputRefused

UNIT_VECTORS: Final = np.eye(3)


def optical_pose(profile: Profile, camera: Camera, q: Sequence[float], articulation_rad: float = 0.0) -> Pose:
    """The optical frame in the crane's base frame; ``q`` are joint positions in ``Joint`` order [rad, m].

    Raises:
        InputRefused: the camera's link is none of those above.
    """
    link = link_pose(profile, camera.link, q, articulation_rad)
    turn = link.rotation @ rpy_matrix(camera.rpy_rad) @ BODY_FROM_OPTICAL
    return Pose(link.to_base(np.asarray(camera.position_m, float)), turn)


def link_pose(profile: Profile, name: str, q: Sequence[float], articulation_rad: float = 0.0) -> Pose:
    """The frame of a link that may carry a camera, in the crane's base frame.

    Raises:
        InputRefused: the link is none of those above.
    """
    kin, carrier = profile.kinematics, profile.carrier
    if name == "base":
        return Pose(np.zeros(3), np.eye(3))
    if name in ("rear", "front") and carrier is not None:
        bend = articulation_rad if name == "front" else 0.0
        origin, *ends = (
            np.array(base_from_rear(carrier, rear_from_front(bend, tuple(p)))) for p in (np.zeros(3), *UNIT_VECTORS)
        )
        return Pose(origin, np.stack([e - origin for e in ends], axis=1))
    points = chain_points(kin, q)
    slew = rpy_matrix((0.0, 0.0, q[Joint.SLEW] + kin.theta1_offset_rad - math.pi / 2))
    match name:
        case "boom":
            return Pose(np.array(points.boom_pin), slew @ rpy_matrix((q[Joint.LIFT], 0.0, 0.0)))
        case "stick":
            turn = slew @ rpy_matrix((q[Joint.LIFT] + q[Joint.TILT], 0.0, 0.0))
            return Pose(np.array(points.stick_pin), turn)
    raise InputRefused(
        "camera-mount.unknown-link",
        f"the pose of link {name!r} is unknown; mount the camera on base, boom or stick"
        + (", rear or front" if carrier is not None else ""),
    )
