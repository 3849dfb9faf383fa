"""QGroundControl ``.plan``: JSON; positions are latitude, longitude, height.

Read: waypoints, the ground speed, fences (polygons and circles).  Heights are flight altitudes and are ignored, as are
all commands that a forwarder cannot execute: those that would move or hold the vehicle are warnings, all others notes.
A mission has one speed: of several that hold on its legs the slowest is taken, which is a warning.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, Final

from autonomy.missions.features import Draft, Position, Shape, assemble
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.model import MAX_WAYPOINTS, Options
from autonomy.missions.source import Source

NAV_WAYPOINT: Final = 16
NAV_SPLINE_WAYPOINT: Final = 82
DO_CHANGE_SPEED: Final = 178
TAKEOFFS: Final = frozenset({22, 84})
PLACES: Final = frozenset(range(NAV_WAYPOINT, 96)) - TAKEOFFS
CONDITIONS: Final = range(112, 160)
"""MAV_CMD: commands that go to a place, and commands that wait for something."""
DRIVES: Final = {
    **dict.fromkeys((32, 33, 34, 192), "moves to another place"),
    **dict.fromkeys(range(5000, 5005), "fence"),
    177: "jump",
    191: "go-around",
    193: "pause",
    194: "reverse",
    207: "fence switch",
    224: "jump",
    601: "jump",
    42702: "script",
}
"""MAV_CMD: other commands that change where or when the vehicle drives, and what they do."""
GROUND_SPEED: Final = 1
NO_CHANGE, DEFAULT_SPEED = -1, -2
GLOBAL_FRAMES: Final = frozenset({0, 3, 5, 6, 10, 11})
"""MAV_FRAME: latitude and longitude in degrees; the others are metres, or no place at all."""
ARDUPILOT: Final = 3
FENCE_PARTS: Final = ("polygon", "polygons", "circles", "breachReturn")
CIRCLE_CORNERS: Final = 48
Path = tuple[str | int, ...]


def read(document: dict[str, Any], source: Source) -> Draft:
    """Read the mission in a plan.

    Raises:
        MissionError: what is wrong, with its line.
    """
    reader = _Reader(source)
    mission = document.get("mission")
    if not isinstance(mission, dict) or not isinstance(mission.get("items"), list):
        sentence = "the plan has no list of mission items; draw a route and save it again"
        raise source.error("plan.items", ("mission",), sentence)
    reader.items(mission["items"])
    fence = document.get("geoFence", {})
    if not isinstance(fence, dict):
        raise source.error("plan.geofence", ("geoFence",), "geoFence is not an object")
    reader.fences(fence)
    draft = assemble(reader.shapes, source, "QGroundControl plan", "", Options(speed_m_s=reader.speed_m_s()))
    reader.tell(draft)
    if mission.get("firmwareType") == ARDUPILOT and sum(not fence.keep_out for fence in draft.mission.fences) > 1:
        sentence = (
            "ArduPilot stays inside all keep-in fences at once unless it is set otherwise; here the machine stays "
            "inside one of them, any of them, so draw the area as one fence"
        )
        draft.warn("plan.several-fences", ("geoFence",), sentence)
    draft.notes += [f"{count} × {item} ignored" for item, count in reader.left_out.items()]
    rally = document.get("rallyPoints")
    if isinstance(rally, dict) and rally.get("points"):
        draft.notes.append("rally points ignored")
    for part in fence:
        if part not in FENCE_PARTS and isinstance(fence[part], list | dict) and fence[part]:
            draft.warn("plan.geofence-part", ("geoFence", part), f"{part[:40]} of the fence is not read")
    if fence.get("breachReturn"):
        draft.notes.append("the point to return to from outside the fence ignored")
    return draft


class _Reader:
    """Collects shapes and the speed."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.shapes: list[Shape] = []
        self.left_out: Counter[str] = Counter()
        self.not_driven: dict[str, list[Path]] = {}
        self.speeds_m_s: list[float | None] = []
        self.other_speed: Path | None = None

    def speed_m_s(self) -> float | None:
        """Return the slowest speed that holds on a leg; None if none is given."""
        return min((speed for speed in self.speeds_m_s if speed is not None), default=None)

    def tell(self, draft: Draft) -> None:
        """Warn of speeds that the mission does not have."""
        slowest = self.speed_m_s()
        if slowest is not None and len(set(self.speeds_m_s)) > 1:
            sentence = (
                f"the plan changes its speed on the way; a mission has one, so all legs are driven at {slowest:g} m/s"
            )
            draft.warn("plan.several-speeds", ("mission", "items"), sentence)
        if self.other_speed is not None:
            sentence = "this speed is no ground speed (type 1) in m/s and is not used; set the ground speed"
            draft.warn("plan.speed-type", self.other_speed, sentence)
        for item, paths in self.not_driven.items():
            sentence = f"{len(paths)} × {item}: a mission does not have it, and the machine drives on without it"
            draft.warn("plan.not-driven", paths[0], sentence)

    def items(self, items: list[Any]) -> None:
        """Read the route: every waypoint item in its order."""
        if len(items) > 2 * MAX_WAYPOINTS:
            sentence = f"has {len(items)} items; a route has at most {MAX_WAYPOINTS} waypoints"
            raise self.source.error("mission.too-many-waypoints", ("mission", "items"), sentence)
        route = []
        speed: float | None = None
        for i, item in enumerate(items):
            path: Path = ("mission", "items", i)
            if not isinstance(item, dict):
                raise self.source.error("plan.item", path, "this is not a mission item")
            command: Any = item.get("command")
            given = item.get("params")
            if item.get("type") == "ComplexItem":
                self.not_driven.setdefault(str(item.get("complexItemType", "complex item"))[:40], []).append(path)
            elif command in (NAV_WAYPOINT, NAV_SPLINE_WAYPOINT):
                if not isinstance(given, list) or len(given) < 6:
                    sentence = "a waypoint has seven params; the 5th and 6th are its position"
                    raise self.source.error("plan.params", path, sentence)
                frame = item.get("frame", 0)
                if not _number(frame) or frame not in GLOBAL_FRAMES:
                    sentence = "the frame of this waypoint is not latitude and longitude; use a global frame"
                    raise self.source.error("plan.frame", path, sentence)
                route.append(self.position(given[4:6], (*path, "params")))
                if (_number(given[0]) and given[0] > 0) or item.get("autoContinue") is False:
                    self.not_driven.setdefault("wait at a waypoint", []).append(path)
                self.speeds_m_s.append(speed)
            elif command == DO_CHANGE_SPEED:
                quantity, value, _, relative = (
                    (*given, None, None, 0, 0)[:4] if isinstance(given, list) else (None,) * 4
                )
                if quantity == GROUND_SPEED and _number(value) and not relative:
                    if value != NO_CHANGE:
                        speed = None if value == DEFAULT_SPEED else float(value)
                elif value != NO_CHANGE:
                    self.other_speed = path
            elif _number(command) and (command in PLACES or command in CONDITIONS or command in DRIVES):
                does = DRIVES.get(command, "wait" if command in CONDITIONS else "movement")
                self.not_driven.setdefault(f"{does} (command {command})"[:80], []).append(path)
            else:
                self.left_out[f"command {command}"[:40]] += 1
        if len(route) > 1:
            del self.speeds_m_s[0]  # a speed holds on the legs after it
        if not route:
            self.speeds_m_s = [speed]  # a plan of fences may still name it
        else:
            kind: Any = "line" if len(route) > 1 else "point"
            self.shapes.append(Shape(kind, (tuple(route),), {}, ("mission", "items")))

    def fences(self, fence: dict[str, Any]) -> None:
        """Read polygons of version 2, the single one of version 1, and circles."""
        if isinstance(fence.get("polygon"), list) and fence["polygon"]:
            self.polygon(fence["polygon"], True, ("geoFence", "polygon"))
        for kind, inner in (("polygons", "polygon"), ("circles", "circle")):
            listed = fence.get(kind) or []
            if not isinstance(listed, list):
                raise self.source.error("plan.geofence", ("geoFence", kind), f"{kind} is not a list")
            for i, entry in enumerate(listed):
                path: Path = ("geoFence", kind, i)
                shape = entry.get(inner) if isinstance(entry, dict) else None
                inclusion = entry.get("inclusion", True) if isinstance(entry, dict) else True
                if inclusion not in (True, False):
                    raise self.source.error("plan.geofence", path, "inclusion of this fence is neither true nor false")
                if kind == "polygons" and isinstance(shape, list):
                    self.polygon(shape, bool(inclusion), (*path, inner))
                elif kind == "circles" and isinstance(shape, dict):
                    self.circle(shape, bool(inclusion), (*path, inner))
                else:
                    raise self.source.error("plan.geofence", path, f"this fence has no {inner}")

    def polygon(self, corners: list[Any], inclusion: bool, path: Path) -> None:
        if not corners:
            return
        ring = tuple(self.position(corner, (*path, i)) for i, corner in enumerate(corners[: MAX_WAYPOINTS + 1]))
        self.shapes.append(Shape("polygon", (ring,), {"role": _role(inclusion)}, path))

    def circle(self, circle: dict[str, Any], inclusion: bool, path: Path) -> None:
        """Draw a circle as a polygon on the safe side: inside a keep-in circle, round a keep-out circle."""
        center = self.position(circle.get("center"), (*path, "center"))
        radius = circle.get("radius")
        if not isinstance(radius, int | float) or isinstance(radius, bool) or not 0.0 < radius < 1e5:
            sentence = f"radius {radius!r} is invalid; give it in metres"
            raise self.source.error("plan.radius", (*path, "radius"), sentence)
        if not (abs(center.latitude_deg) <= 90.0 and abs(center.longitude_deg) <= 180.0):
            self.shapes.append(Shape("polygon", ((center,) * 3,), {"role": _role(inclusion)}, path))
            return
        frame = LocalFrame(center.latitude_deg, center.longitude_deg)
        reach = radius if inclusion else radius / math.cos(math.pi / CIRCLE_CORNERS)
        ring = []
        for i in range(CIRCLE_CORNERS):
            angle = math.tau * i / CIRCLE_CORNERS
            at = frame.point(reach * math.cos(angle), reach * math.sin(angle))
            ring.append(Position(at.latitude_deg, at.longitude_deg, None, path))
        self.shapes.append(Shape("polygon", (tuple(ring),), {"role": _role(inclusion)}, path))

    def position(self, value: Any, path: Path) -> Position:
        if not isinstance(value, list) or len(value) < 2 or not all(_number(x) for x in value[:2]):
            raise self.source.error("plan.position", path, "a position is [latitude, longitude], two numbers")
        return Position(float(value[0]), float(value[1]), None, path)


def _role(inclusion: bool) -> str:
    return "fence" if inclusion else "keep-out"


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
