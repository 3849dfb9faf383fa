"""What Foxglove and Lichtblick show of a machine, from the controller's reports: the same topics live and recorded.

==================  ==========================  ==============================================================
topic               schema                      contents
==================  ==========================  ==============================================================
``/tf``             foxglove.FrameTransforms    the frames of the crane's links, 20 times a second
``/joints``         foxglove.JointStates        positions and velocities by their encoders, 20 times a second
``/reference``      foxglove.JointStates        their references
``/machine``        foxglove.SceneUpdate        the machine's bodies in those frames, every two seconds
``/mode``           foxglove.Log                each change of mode and reason, with its sentence
``/position``       foxglove.LocationFix        where a machine that drives is, five times a second
``/logs``           foxglove.SceneUpdate        the planner's map of the logs of a machine that drives, in the frame
                                                ``map``, where ``/tf`` has ``base``: each change, and every two seconds
``/camera/NAME``    foxglove.CompressedImage    each measured picture of a camera, with its logs outlined
==================  ==========================  ==============================================================

Times are those under which the messages are logged: UTC in a live run, monotonic in lockstep [ns].  Pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, pi, radians, sin, sqrt
from typing import Final, NamedTuple, Protocol

from foxglove import Schema
from foxglove.messages import (
    Color,
    CompressedImage,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    JointState,
    JointStates,
    KeyValuePair,
    LocationFix,
    Log,
    LogLevel,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from machine.geometry.carrier import axis_from_antenna, pivot_height_m, rear_from_base
from machine.geometry.link_frames import BASE, link_frames
from machine.geometry.map_projection import MapProjection
from machine.joints import JOINTS, Joint
from machine.profile import Carrier, Profile, joint_limits
from machine.status.explanation import describe
from machine.status.modes import Mode

# -- The machine as simple bodies in the frames of `machine.geometry.link_frames`, for the 3-D panel.


Size = tuple[float, float, float]
CRANE: Final = Color(r=0.88, g=0.64, b=0.18, a=1.0)
STEEL: Final = Color(r=0.55, g=0.59, b=0.62, a=1.0)
BUNK: Final = Color(r=0.29, g=0.35, b=0.32, a=1.0)
GROUND: Final = Color(r=0.13, g=0.19, b=0.16, a=0.6)
GROUND_M: Final = 20.0
FOREVER: Final = Duration(sec=0, nsec=0)


def machine_scene(profile: Profile, stamp: Timestamp) -> SceneUpdate:
    """Draw column, boom, stick, telescope, grapple and bunk, each as an entity that stays; the same each time."""
    kin, bunk = profile.kinematics, profile.bunk
    longest_m = joint_limits(profile)[Joint.EXT][1]
    bodies = [
        ("boom", _along_x(kin.a2_m, 0.0, 0.0, 0.25, CRANE)),
        ("stick", _along_x(kin.d4_m, 0.0, kin.a3_m, 0.2, CRANE)),
        ("pin", _along_x(longest_m, -longest_m, 0.0, 0.12, STEEL)),
        ("grapple", _cube((0.7, 0.18, 0.2), (0.0, 0.0, 0.0), CRANE)),
    ]
    column = CylinderPrimitive(
        pose=_pose((0.0, 0.0, 0.5 * kin.d1_m)),
        size=Vector3(x=0.4, y=0.4, z=max(kin.d1_m, 0.1)),
        bottom_scale=1.0,
        top_scale=1.0,
        color=CRANE,
    )
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
        timestamp=stamp,
        frame_id=frame,
        id=name,
        lifetime=FOREVER,
        frame_locked=True,
        cubes=cubes or [],
        cylinders=cylinders or [],
    )


def _along_x(length_m: float, from_m: float, z_m: float, thick_m: float, color: Color) -> CubePrimitive:
    return _cube((length_m, thick_m, thick_m), (from_m + 0.5 * length_m, 0.0, z_m), color)


def _cube(size_m: Size, center_m: Size, color: Color, yaw_rad: float = 0.0) -> CubePrimitive:
    return CubePrimitive(
        pose=_pose(center_m, yaw_rad), size=Vector3(x=size_m[0], y=size_m[1], z=size_m[2]), color=color
    )


def _pose(center_m: Size, yaw_rad: float = 0.0) -> Pose:
    turn = Quaternion(x=0.0, y=0.0, z=sin(yaw_rad / 2), w=cos(yaw_rad / 2))
    return Pose(position=Vector3(x=center_m[0], y=center_m[1], z=center_m[2]), orientation=turn)


# -- The planner's map of the logs, and where the machine stands on it, in the frame ``map``.
#
# ``map`` is level, x to the east and y to the north of the first place that is told, z = 0 on the ground.  The
# machine is drawn level on it, and a log as a cylinder that lies on it: a mission report has neither heights nor
# slopes.


MAP: Final = "map"
LOG: Final = Color(r=0.54, g=0.35, b=0.21, a=1.0)
TARGET: Final = Color(r=1.0, g=0.62, b=0.77, a=1.0)
GIVEN_UP: Final = Color(r=0.55, g=0.55, b=0.55, a=0.5)
_LYING: Final = sqrt(0.5)


class MappedLog(Protocol):
    """`can_dbc.messages.mission.KnownLog`."""

    @property
    def number(self) -> int: ...
    @property
    def place(self) -> tuple[float, float]: ...
    @property
    def bearing_deg(self) -> float: ...
    @property
    def length_m(self) -> float: ...
    @property
    def diameter_m(self) -> float: ...
    @property
    def misses(self) -> int: ...
    @property
    def given_up(self) -> bool: ...


class LogsReport(Protocol):
    """`can_dbc.messages.mission.MissionReport`."""

    @property
    def logs(self) -> Sequence[MappedLog]: ...
    @property
    def targets(self) -> Sequence[int]: ...


class PlaceReport(Protocol):
    """`can_dbc.messages.vehicle.VehicleReport`."""

    @property
    def latitude_deg(self) -> float: ...
    @property
    def longitude_deg(self) -> float: ...
    @property
    def heading_rad(self) -> float: ...
    @property
    def articulation_rad(self) -> float: ...
    @property
    def heights_m(self) -> Sequence[float]: ...


class LogMap:
    """Draws one machine's map."""

    def __init__(self, carrier: Carrier) -> None:
        self._carrier = carrier
        self._ground = MapProjection()

    def base_in_map(self, report: PlaceReport, stamp: Timestamp) -> FrameTransform | None:
        """Compute the crane's base frame in ``map``; None while position, heading or articulation is unknown."""
        known = (report.latitude_deg, report.longitude_deg, report.heading_rad, report.articulation_rad)
        if not all(map(isfinite, known)):
            return None
        antenna_m = self._ground.metres(report.latitude_deg, report.longitude_deg)
        east, north = axis_from_antenna(self._carrier, antenna_m, report.heading_rad)
        heights = [height for height in report.heights_m if isfinite(height)] or [self._carrier.arm_transport_m]
        yaw = 0.5 * pi - report.heading_rad - report.articulation_rad
        x, y, z = rear_from_base(self._carrier, (0.0, 0.0, 0.0))
        turned = yaw + self._carrier.crane_yaw_rad
        return FrameTransform(
            timestamp=stamp,
            parent_frame_id=MAP,
            child_frame_id=BASE,
            translation=Vector3(
                x=east + cos(yaw) * x - sin(yaw) * y,
                y=north + sin(yaw) * x + cos(yaw) * y,
                z=pivot_height_m(self._carrier, sum(heights) / len(heights)) + z,
            ),
            rotation=Quaternion(x=0.0, y=0.0, z=sin(turned / 2), w=cos(turned / 2)),
        )

    def logs(self, report: LogsReport, stamp: Timestamp) -> SceneUpdate:
        """Draw all logs of the map in place of those before: each an entity, targets and those given up by colour."""
        return SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletionType.All, id="")],
            entities=[self._entity(log, log.number in report.targets, stamp) for log in report.logs],
        )

    def _entity(self, log: MappedLog, is_target: bool, stamp: Timestamp) -> SceneEntity:
        x, y = self._ground.metres(*log.place)
        yaw = radians(90.0 - log.bearing_deg)
        # A cylinder stands; it is laid along x (a quarter turn about y) and then turned about z.
        laid = Quaternion(
            x=-_LYING * sin(yaw / 2), y=_LYING * cos(yaw / 2), z=_LYING * sin(yaw / 2), w=_LYING * cos(yaw / 2)
        )
        body = CylinderPrimitive(
            pose=Pose(position=Vector3(x=x, y=y, z=0.5 * log.diameter_m), orientation=laid),
            size=Vector3(x=log.diameter_m, y=log.diameter_m, z=log.length_m),
            bottom_scale=1.0,
            top_scale=1.0,
            color=TARGET if is_target else GIVEN_UP if log.given_up else LOG,
        )
        return SceneEntity(
            timestamp=stamp,
            frame_id=MAP,
            id=f"log {log.number}",
            lifetime=Duration(sec=0, nsec=0),
            frame_locked=True,
            metadata=[KeyValuePair(key="missed grasps", value=str(log.misses))],
            cylinders=[body],
        )


# -- What Foxglove and Lichtblick show of a machine, from the controller's reports


ENCODING: Final = "protobuf"
MOTION_PERIOD_NS: Final = 50_000_000
SCENE_PERIOD_NS: Final = 2_000_000_000
POSITION_PERIOD_NS: Final = 200_000_000
_NAMES: Final = tuple(j.name.lower() for j in JOINTS)
_LEVELS: Final = {Mode.STOP: LogLevel.Warning, Mode.FAULT: LogLevel.Error}
Message = tuple[str, bytes]
"""Topic and bytes."""


class CraneReport(Protocol):
    """`can_dbc.messages.crane.StateReport`."""

    @property
    def position(self) -> Sequence[float]: ...
    @property
    def velocity(self) -> Sequence[float]: ...
    @property
    def reference(self) -> Sequence[float]: ...
    @property
    def mode(self) -> int: ...
    @property
    def reason(self) -> int: ...
    @property
    def numbers(self) -> Sequence[float]: ...


class PositionReport(PlaceReport, Protocol):
    """`can_dbc.messages.vehicle.VehicleReport`."""

    @property
    def altitude_m(self) -> float: ...


class Topic(NamedTuple):
    """A topic and the schema of its messages."""

    name: str
    schema: Schema


class MachineTopics:
    """Makes the messages of one machine; reports come in their order."""

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._said: tuple[int, int] | None = None
        self._motion_ns: int | None = None
        self._scene_ns: int | None = None
        self._position_ns: int | None = None
        self._base_ns: int | None = None
        self._logs_ns: int | None = None
        self._log_map = None if profile.carrier is None else LogMap(profile.carrier)
        self._mapped: object = None

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of this machine."""
        machine_topics = [
            Topic("/tf", FrameTransforms.get_schema()),
            Topic("/joints", JointStates.get_schema()),
            Topic("/reference", JointStates.get_schema()),
            Topic("/machine", SceneUpdate.get_schema()),
            Topic("/mode", Log.get_schema()),
        ]
        if self._log_map is not None:
            machine_topics.append(Topic("/position", LocationFix.get_schema()))
            machine_topics.append(Topic("/logs", SceneUpdate.get_schema()))
        return (
            *machine_topics,
            *(Topic(camera_topic(name), CompressedImage.get_schema()) for name in self._profile.cameras),
        )

    def repeat(self) -> None:
        """Make the next report say everything again: for a viewer that came later."""
        self._said = self._scene_ns = self._logs_ns = None

    def on_state(self, report: CraneReport, time_ns: int) -> list[Message]:
        """Draw the messages of a state report."""
        stamp, messages = timestamp(time_ns), list[Message]()
        if (report.mode, report.reason) != self._said:
            self._said = (report.mode, report.reason)
            messages.append(("/mode", _log(report, stamp).encode()))
        if _due(self._scene_ns, time_ns, SCENE_PERIOD_NS):
            self._scene_ns = time_ns
            messages.append(("/machine", machine_scene(self._profile, stamp).encode()))
        if _due(self._motion_ns, time_ns, MOTION_PERIOD_NS):
            self._motion_ns = time_ns
            messages.append(("/tf", self._transforms(report.position, stamp).encode()))
            messages.append(("/joints", _joints(report.position, report.velocity, stamp).encode()))
            messages.append(("/reference", _joints(report.reference, (), stamp).encode()))
        return messages

    def on_position(self, report: PositionReport, time_ns: int) -> list[Message]:
        """Draw the messages of a vehicle report; none while the position is unknown."""
        stamp, messages = timestamp(time_ns), list[Message]()
        if not (isfinite(report.latitude_deg) and isfinite(report.longitude_deg)):
            return messages
        if _due(self._position_ns, time_ns, POSITION_PERIOD_NS):
            self._position_ns = time_ns
            fix = LocationFix(
                timestamp=stamp,
                frame_id="antenna",
                latitude=report.latitude_deg,
                longitude=report.longitude_deg,
                altitude=report.altitude_m if isfinite(report.altitude_m) else 0.0,
                heading=report.heading_rad if isfinite(report.heading_rad) else None,
            )
            messages.append(("/position", fix.encode()))
        if self._log_map is not None and _due(self._base_ns, time_ns, MOTION_PERIOD_NS):
            base = self._log_map.base_in_map(report, stamp)
            if base is not None:
                self._base_ns = time_ns
                messages.append(("/tf", FrameTransforms(transforms=[base]).encode()))
        return messages

    def on_mission(self, report: LogsReport, time_ns: int) -> list[Message]:
        """Draw the message of a mission report: the logs on the planner's map."""
        shown = (
            tuple((log.number, log.place, log.bearing_deg, log.misses, log.given_up) for log in report.logs),
            tuple(report.targets),
        )
        if self._log_map is None or (shown == self._mapped and not _due(self._logs_ns, time_ns, SCENE_PERIOD_NS)):
            return []
        self._mapped, self._logs_ns = shown, time_ns
        return [("/logs", self._log_map.logs(report, timestamp(time_ns)).encode())]

    def on_picture(self, camera: str, jpeg: bytes, time_ns: int) -> list[Message]:
        """Draw the message of a measured picture; none of a camera that the machine does not have."""
        if camera not in self._profile.cameras:
            return []
        image = CompressedImage(timestamp=timestamp(time_ns), frame_id=f"camera_{camera}", data=jpeg, format="jpeg")
        return [(camera_topic(camera), image.encode())]

    def _transforms(self, q: Sequence[float], stamp: Timestamp) -> FrameTransforms:
        return FrameTransforms(
            transforms=[
                FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=frame.parent,
                    child_frame_id=frame.child,
                    translation=Vector3(x=frame.translation_m[0], y=frame.translation_m[1], z=frame.translation_m[2]),
                    rotation=Quaternion(
                        x=frame.rotation[0], y=frame.rotation[1], z=frame.rotation[2], w=frame.rotation[3]
                    ),
                )
                for frame in link_frames(self._profile, q)
            ]
        )


def camera_topic(camera: str) -> str:
    """Return the topic of a camera's pictures."""
    return f"/camera/{camera}"


def timestamp(time_ns: int) -> Timestamp:
    """Convert a time to the library's form."""
    return Timestamp(sec=time_ns // 1_000_000_000, nsec=time_ns % 1_000_000_000)


def _due(last_ns: int | None, time_ns: int, period_ns: int) -> bool:
    return last_ns is None or not 0 <= time_ns - last_ns < period_ns


def _joints(position: Sequence[float], velocity: Sequence[float], stamp: Timestamp) -> JointStates:
    speeds = (*velocity, *(float("nan"),) * (len(position) - len(velocity)))
    return JointStates(
        timestamp=stamp,
        joints=[
            JointState(name=name, position=q, velocity=v if isfinite(v) else None)
            for name, q, v in zip(_NAMES, position, speeds, strict=True)
            if isfinite(q)
        ],
    )


def _log(report: CraneReport, stamp: Timestamp) -> Log:
    known = report.mode in set(Mode)
    mode = Mode(report.mode).name if known else f"MODE {report.mode}"
    try:
        sentence = describe(report.reason, numbers=report.numbers)
    except ValueError:
        sentence = f"Unknown reason {report.reason & 0xFF}."
    level = _LEVELS.get(Mode(report.mode), LogLevel.Info) if known else LogLevel.Unknown
    return Log(timestamp=stamp, level=level, message=f"{mode}: {sentence}", name="controller")
