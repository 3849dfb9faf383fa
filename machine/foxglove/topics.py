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
from math import isfinite
from typing import Final, NamedTuple, Protocol

from foxglove import Schema
from foxglove.messages import (
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    JointState,
    JointStates,
    LocationFix,
    Log,
    LogLevel,
    Quaternion,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from machine.foxglove.log_map import LogMap, LogsReport, PlaceReport
from machine.foxglove.scene import machine_scene
from machine.geometry.link_frames import link_frames
from machine.joints import JOINTS
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode

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
        found = [
            Topic("/tf", FrameTransforms.get_schema()),
            Topic("/joints", JointStates.get_schema()),
            Topic("/reference", JointStates.get_schema()),
            Topic("/machine", SceneUpdate.get_schema()),
            Topic("/mode", Log.get_schema()),
        ]
        if self._log_map is not None:
            found.append(Topic("/position", LocationFix.get_schema()))
            found.append(Topic("/logs", SceneUpdate.get_schema()))
        return (*found, *(Topic(camera_topic(name), CompressedImage.get_schema()) for name in self._profile.cameras))

    def repeat(self) -> None:
        """The next report says everything again: for a viewer that came later."""
        self._said = self._scene_ns = self._logs_ns = None

    def on_state(self, report: CraneReport, time_ns: int) -> list[Message]:
        """The messages of a state report."""
        stamp, found = timestamp(time_ns), list[Message]()
        if (report.mode, report.reason) != self._said:
            self._said = (report.mode, report.reason)
            found.append(("/mode", _log(report, stamp).encode()))
        if _due(self._scene_ns, time_ns, SCENE_PERIOD_NS):
            self._scene_ns = time_ns
            found.append(("/machine", machine_scene(self._profile, stamp).encode()))
        if _due(self._motion_ns, time_ns, MOTION_PERIOD_NS):
            self._motion_ns = time_ns
            found.append(("/tf", self._transforms(report.position, stamp).encode()))
            found.append(("/joints", _joints(report.position, report.velocity, stamp).encode()))
            found.append(("/reference", _joints(report.reference, (), stamp).encode()))
        return found

    def on_position(self, report: PositionReport, time_ns: int) -> list[Message]:
        """The messages of a vehicle report; none while the position is unknown."""
        stamp, found = timestamp(time_ns), list[Message]()
        if not (isfinite(report.latitude_deg) and isfinite(report.longitude_deg)):
            return found
        if _due(self._position_ns, time_ns, POSITION_PERIOD_NS):
            self._position_ns = time_ns
            fix = LocationFix(
                timestamp=stamp, frame_id="antenna", latitude=report.latitude_deg, longitude=report.longitude_deg,
                altitude=report.altitude_m if isfinite(report.altitude_m) else 0.0,
                heading=report.heading_rad if isfinite(report.heading_rad) else None,
            )  # fmt: skip
            found.append(("/position", fix.encode()))
        if self._log_map is not None and _due(self._base_ns, time_ns, MOTION_PERIOD_NS):
            base = self._log_map.base_in_map(report, stamp)
            if base is not None:
                self._base_ns = time_ns
                found.append(("/tf", FrameTransforms(transforms=[base]).encode()))
        return found

    def on_mission(self, report: LogsReport, time_ns: int) -> list[Message]:
        """The message of a mission report: the logs on the planner's map."""
        shown = (
            tuple((log.number, log.place, log.bearing_deg, log.misses, log.given_up) for log in report.logs),
            tuple(report.targets),
        )
        if self._log_map is None or (shown == self._mapped and not _due(self._logs_ns, time_ns, SCENE_PERIOD_NS)):
            return []
        self._mapped, self._logs_ns = shown, time_ns
        return [("/logs", self._log_map.logs(report, timestamp(time_ns)).encode())]

    def on_picture(self, camera: str, jpeg: bytes, time_ns: int) -> list[Message]:
        """The message of a measured picture; none of a camera that the machine does not have."""
        if camera not in self._profile.cameras:
            return []
        image = CompressedImage(timestamp=timestamp(time_ns), frame_id=f"camera_{camera}", data=jpeg, format="jpeg")
        return [(camera_topic(camera), image.encode())]

    def _transforms(self, q: Sequence[float], stamp: Timestamp) -> FrameTransforms:
        return FrameTransforms(
            transforms=[
                FrameTransform(
                    timestamp=stamp, parent_frame_id=frame.parent, child_frame_id=frame.child,
                    translation=Vector3(x=frame.translation_m[0], y=frame.translation_m[1], z=frame.translation_m[2]),
                    rotation=Quaternion(
                        x=frame.rotation[0], y=frame.rotation[1], z=frame.rotation[2], w=frame.rotation[3]
                    ),
                )
                for frame in link_frames(self._profile, q)
            ]
        )  # fmt: skip


def camera_topic(camera: str) -> str:
    """The topic of a camera's pictures."""
    return f"/camera/{camera}"


def timestamp(time_ns: int) -> Timestamp:
    """A time in the library's form."""
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
