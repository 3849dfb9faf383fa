"""The machine as simple bodies in the frames of `machine.geometry.link_frames`, for the 3-D panel."""

from __future__ import annotations

from math import cos, sin
from typing import Final

from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from machine.geometry.link_frames import BASE
from machine.joints import Joint
from machine.profile import Profile, joint_limits

Size = tuple[float, float, float]
CRANE: Final = Color(r=0.88, g=0.64, b=0.18, a=1.0)
STEEL: Final = Color(r=0.55, g=0.59, b=0.62, a=1.0)
BUNK: Final = Color(r=0.29, g=0.35, b=0.32, a=1.0)
GROUND: Final = Color(r=0.13, g=0.19, b=0.16, a=0.6)
GROUND_M: Final = 20.0
FOREVER: Final = Duration(sec=0, nsec=0)


def machine_scene(profile: Profile, stamp: Timestamp) -> SceneUpdate:
    """Column, boom, stick, telescope, grapple and bunk, each as an entity of its own that stays; the same each time."""
    kin, bunk = profile.kinematics, profile.bunk
    longest_m = joint_limits(profile)[Joint.EXT][1]
    bodies = [
        ("boom", _along_x(kin.a2_m, 0.0, 0.0, 0.25, CRANE)),
        ("stick", _along_x(kin.d4_m, 0.0, kin.a3_m, 0.2, CRANE)),
        ("pin", _along_x(longest_m, -longest_m, 0.0, 0.12, STEEL)),
        ("grapple", _cube((0.7, 0.18, 0.2), (0.0, 0.0, 0.0), CRANE)),
    ]
    column = CylinderPrimitive(
        pose=_pose((0.0, 0.0, 0.5 * kin.d1_m)), size=Vector3(x=0.4, y=0.4, z=max(kin.d1_m, 0.1)),
        bottom_scale=1.0, top_scale=1.0, color=CRANE,
    )  # fmt: skip
    x, y = bunk.center_m
    floor = _cube((bunk.length_m, bunk.width_m, 0.1), (x, y, bunk.floor_z_m - 0.05), BUNK, bunk.yaw_rad)
    entities = [_entity(frame, frame, stamp, cubes=[body]) for frame, body in bodies]
    entities.append(_entity("column", "column", stamp, cylinders=[column]))
    entities.append(_entity("bunk", BASE, stamp, cubes=[floor]))
    if profile.carrier is None:
        ground = _cube((GROUND_M, GROUND_M, 0.02), (0.0, 0.0, profile.workspace.ground_z_m - 0.01), GROUND)
        entities.append(_entity("ground", BASE, stamp, cubes=[ground]))
    return SceneUpdate(deletions=[], entities=entities)


def _entity(
    name: str,
    frame: str,
    stamp: Timestamp,
    cubes: list[CubePrimitive] | None = None,
    cylinders: list[CylinderPrimitive] | None = None,
) -> SceneEntity:
    return SceneEntity(
        timestamp=stamp, frame_id=frame, id=name, lifetime=FOREVER, frame_locked=True, cubes=cubes or [],
        cylinders=cylinders or [],
    )  # fmt: skip


def _along_x(length_m: float, from_m: float, z_m: float, thick_m: float, color: Color) -> CubePrimitive:
    return _cube((length_m, thick_m, thick_m), (from_m + 0.5 * length_m, 0.0, z_m), color)


def _cube(size_m: Size, center_m: Size, color: Color, yaw_rad: float = 0.0) -> CubePrimitive:
    return CubePrimitive(
        pose=_pose(center_m, yaw_rad), size=Vector3(x=size_m[0], y=size_m[1], z=size_m[2]), color=color
    )


def _pose(center_m: Size, yaw_rad: float = 0.0) -> Pose:
    turn = Quaternion(x=0.0, y=0.0, z=sin(yaw_rad / 2), w=cos(yaw_rad / 2))
    return Pose(position=Vector3(x=center_m[0], y=center_m[1], z=center_m[2]), orientation=turn)
