"""The planner's map of the logs, and where the machine stands on it, in the frame ``map``.

``map`` is level, x to the east and y to the north of the first place that is told, z = 0 on the ground.  The machine is
drawn level on it, and a log as a cylinder that lies on it: a mission report has neither heights nor slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, pi, radians, sin, sqrt
from typing import Final, Protocol

from foxglove.messages import (
    Color,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    KeyValuePair,
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
from machine.geometry.link_frames import BASE
from machine.geometry.map_projection import MapProjection
from machine.profile import Carrier

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
        """The crane's base frame in ``map``; None while position, heading or articulation is unknown."""
        known = (report.latitude_deg, report.longitude_deg, report.heading_rad, report.articulation_rad)
        if not all(map(isfinite, known)):
            return None
        here = self._ground.metres(report.latitude_deg, report.longitude_deg)
        east, north = axis_from_antenna(self._carrier, here, report.heading_rad)
        heights = [height for height in report.heights_m if isfinite(height)] or [self._carrier.arm_transport_m]
        yaw = 0.5 * pi - report.heading_rad - report.articulation_rad
        x, y, z = rear_from_base(self._carrier, (0.0, 0.0, 0.0))
        turned = yaw + self._carrier.crane_yaw_rad
        return FrameTransform(
            timestamp=stamp, parent_frame_id=MAP, child_frame_id=BASE,
            translation=Vector3(
                x=east + cos(yaw) * x - sin(yaw) * y, y=north + sin(yaw) * x + cos(yaw) * y,
                z=pivot_height_m(self._carrier, sum(heights) / len(heights)) + z,
            ),
            rotation=Quaternion(x=0.0, y=0.0, z=sin(turned / 2), w=cos(turned / 2)),
        )  # fmt: skip

    def logs(self, report: LogsReport, stamp: Timestamp) -> SceneUpdate:
        """All logs of the map in place of those of before: each an entity, the targets and those given up by colour."""
        return SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletionType.All, id="")],
            entities=[self._entity(log, log.number in report.targets, stamp) for log in report.logs],
        )

    def _entity(self, log: MappedLog, is_target: bool, stamp: Timestamp) -> SceneEntity:
        x, y = self._ground.metres(*log.place)
        yaw = radians(90.0 - log.bearing_deg)
        # A cylinder stands; it is laid along x (a quarter turn about y) and then turned about z.
        laid = Quaternion(x=-_LYING * sin(yaw / 2), y=_LYING * cos(yaw / 2), z=_LYING * sin(yaw / 2),
                          w=_LYING * cos(yaw / 2))  # fmt: skip
        body = CylinderPrimitive(
            pose=Pose(position=Vector3(x=x, y=y, z=0.5 * log.diameter_m), orientation=laid),
            size=Vector3(x=log.diameter_m, y=log.diameter_m, z=log.length_m), bottom_scale=1.0, top_scale=1.0,
            color=TARGET if is_target else GIVEN_UP if log.given_up else LOG,
        )  # fmt: skip
        return SceneEntity(
            timestamp=stamp, frame_id=MAP, id=f"log {log.number}", lifetime=Duration(sec=0, nsec=0), frame_locked=True,
            metadata=[KeyValuePair(key="missed grasps", value=str(log.misses))], cylinders=[body],
        )  # fmt: skip
