"""What a grasp came to, by the plant's physics and the words of paper A, section IV-C."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sim.wood.logs import LogState

CLEAR_M: Final = 0.05
"""Air under the lowest point of a log that is off the ground, and how much more that is than it had where it lay."""
EDGE: Final = 0.25
"""Farther than this share of its length from a log's middle is its edge: half of the log is not."""
ALIGNED_RAD: Final = math.radians(20.0)
"""A grapple turned further than this off the mean direction of what it lifts is misaligned."""
TOP_LOG: Final = (3, 9)
ALL_LOGS: Final = (2, 4, 5, 6, 7)
PILES: Final = (10, 11, 12)
RISEN_M: Final = 0.25
"""So much higher than it lay is a log that hangs in the grapple; one that was only pushed onto others is not."""
LIES_ON_M: Final = 0.06


@dataclass(frozen=True, slots=True)
class Grip:
    """Where the grapple closed: middle between the tips and direction of the opening axis, in truth, base frame."""

    x_m: float
    y_m: float
    yaw_rad: float


def clearance(log: LogState, ground_z_m: float) -> float:
    """Air [m] under the lowest of a log's ends."""
    fall = log.taper_m_m * log.length_m / 2
    return min(end[2] - (log.diameter_m + d) / 2 - ground_z_m for end, d in zip(log.ends_m, (fall, -fall), strict=True))


def lifted(before: Sequence[LogState], after: Sequence[LogState], ground_z_m: float) -> list[int]:
    """The logs that hang: risen, and with more air under all of them than they had."""
    return [
        i
        for i, (was, now) in enumerate(zip(before, after, strict=True))
        if now.position_m[2] - was.position_m[2] > RISEN_M
        and clearance(now, ground_z_m) > CLEAR_M + max(0.0, clearance(was, ground_z_m))
    ]


def category(number: int, before: Sequence[LogState], up: Sequence[int], grip: Grip, misled: bool) -> str:
    """``failed``, ``optimal``, ``NI`` (from under another log, or at an edge), ``MA`` (askew) or, where perception
    misled the planner into one of these, ``SE``.
    """
    if not up:
        return "failed"
    if _askew(before, up, grip) > ALIGNED_RAD:
        return "SE" if misled else "MA"
    if _under(before, up) or _edge(before, up, grip) or (number in TOP_LOG and max(_heights(before)) not in up):
        return "SE" if misled else "NI"
    return "optimal"


def _heights(logs: Sequence[LogState]) -> list[int]:
    """The number of the topmost log."""
    return [max(range(len(logs)), key=lambda i: logs[i].position_m[2])]


def _askew(before: Sequence[LogState], up: Sequence[int], grip: Grip) -> float:
    """Angle [rad] between the tongs' normal and the mean direction of the logs that came up."""
    doubled = [2.0 * math.atan2(before[i].axis[1], before[i].axis[0]) for i in up]
    along = math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0
    return abs(math.remainder(grip.yaw_rad - math.pi / 2 - along, math.pi))


def _edge(before: Sequence[LogState], up: Sequence[int], grip: Grip) -> bool:
    """Whether the grapple closed near the ends of what came up, all logs together."""
    doubled = [2.0 * math.atan2(before[i].axis[1], before[i].axis[0]) for i in up]
    along = math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0
    ax, ay = math.cos(along), math.sin(along)
    reach = [end[0] * ax + end[1] * ay for i in up for end in before[i].ends_m]
    middle, length = (max(reach) + min(reach)) / 2, max(reach) - min(reach)
    return abs(grip.x_m * ax + grip.y_m * ay - middle) > EDGE * length


def _under(before: Sequence[LogState], up: Sequence[int]) -> bool:
    """Whether a log came up from under one that did not."""
    stay = [i for i in range(len(before)) if i not in up]
    return any(lies_on(before[j], before[i]) for i in up for j in stay)


def lies_on(upper: LogState, lower: LogState) -> bool:
    """Whether a log rests on another: they touch, and it is higher there by a third of their radii together."""
    radii = (upper.diameter_m + lower.diameter_m) / 2
    gap, rise = min((_between(p, lower) for p in _points(upper)), key=lambda g: g[0])
    return gap < radii + LIES_ON_M and rise > 0.3 * radii


def _points(log: LogState, count: int = 41) -> list[tuple[float, ...]]:
    a, b = log.ends_m
    return [tuple(p + i / (count - 1) * (q - p) for p, q in zip(a, b, strict=True)) for i in range(count)]


def _between(point: Sequence[float], log: LogState) -> tuple[float, float]:
    """Distance [m] of a point from a log's axis, and how much higher it is there."""
    a, b = log.ends_m
    way = [q - p for p, q in zip(a, b, strict=True)]
    t = sum((x - p) * w for x, p, w in zip(point, a, way, strict=True)) / sum(w * w for w in way)
    foot = [p + min(max(t, 0.0), 1.0) * w for p, w in zip(a, way, strict=True)]
    return math.dist(point, foot), point[2] - foot[2]
