"""Outcome of a grasp by the plant's physics, in the categories of paper A, section IV-C."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sim.wood.logs import LogState

MIN_CLEARANCE_M: Final = 0.05
"""Minimum clearance below a log off the ground, and its minimum increase over the clearance before."""
EDGE_SHARE: Final = 0.25
"""Points farther from the middle of a log than this share of its length are at its edge."""
MAX_MISALIGNMENT_RAD: Final = math.radians(20.0)
"""A grapple turned further than this off the mean direction of the lifted logs is misaligned."""
TOP_LOG: Final = (3, 9)
ALL_LOGS: Final = (2, 4, 5, 6, 7)
PILES: Final = (10, 11, 12)
MIN_RISE_M: Final = 0.25
"""Minimum rise of a log that hangs in the grapple; a log that was only pushed onto others rises less."""
CONTACT_M: Final = 0.06


@dataclass(frozen=True, slots=True)
class Grip:
    """True position where the grapple closed: middle between the tips, direction of the opening axis; base frame."""

    x_m: float
    y_m: float
    yaw_rad: float


def clearance(log: LogState, ground_z_m: float) -> float:
    """Compute the clearance [m] below the lowest end of a log."""
    fall = log.taper_m_m * log.length_m / 2
    return min(end[2] - (log.diameter_m + d) / 2 - ground_z_m for end, d in zip(log.ends_m, (fall, -fall), strict=True))


def lifted(before: Sequence[LogState], after: Sequence[LogState], ground_z_m: float) -> list[int]:
    """List the indices of the logs that hang: risen, and with more clearance than before."""
    return [
        i
        for i, (was, now) in enumerate(zip(before, after, strict=True))
        if now.position_m[2] - was.position_m[2] > MIN_RISE_M
        and clearance(now, ground_z_m) > MIN_CLEARANCE_M + max(0.0, clearance(was, ground_z_m))
    ]


def category(number: int, before: Sequence[LogState], up: Sequence[int], grip: Grip, misled: bool) -> str:
    """Name the category of a grasp: ``failed``, ``optimal``, ``NI`` (from under another log, or at an edge) or ``MA``
    (misaligned).

    ``SE`` replaces NI and MA if perception misled the planner.
    """
    if not up:
        return "failed"
    if _askew(before, up, grip) > MAX_MISALIGNMENT_RAD:
        return "SE" if misled else "MA"
    if _under(before, up) or _edge(before, up, grip) or (number in TOP_LOG and max(_heights(before)) not in up):
        return "SE" if misled else "NI"
    return "optimal"


def _heights(logs: Sequence[LogState]) -> list[int]:
    """Return the index of the topmost log."""
    return [max(range(len(logs)), key=lambda i: logs[i].position_m[2])]


def _askew(before: Sequence[LogState], up: Sequence[int], grip: Grip) -> float:
    """Compute the angle [rad] between the normal of the grapple and the mean direction of the lifted logs."""
    doubled = [2.0 * math.atan2(before[i].axis[1], before[i].axis[0]) for i in up]
    along = math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0
    return abs(math.remainder(grip.yaw_rad - math.pi / 2 - along, math.pi))


def _edge(before: Sequence[LogState], up: Sequence[int], grip: Grip) -> bool:
    """Tell whether the grapple closed near the ends of the lifted logs, taken together."""
    doubled = [2.0 * math.atan2(before[i].axis[1], before[i].axis[0]) for i in up]
    along = math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0
    ax, ay = math.cos(along), math.sin(along)
    reach = [end[0] * ax + end[1] * ay for i in up for end in before[i].ends_m]
    middle, length = (max(reach) + min(reach)) / 2, max(reach) - min(reach)
    return abs(grip.x_m * ax + grip.y_m * ay - middle) > EDGE_SHARE * length


def _under(before: Sequence[LogState], up: Sequence[int]) -> bool:
    """Tell whether a log was lifted from under one that was not."""
    stay = [i for i in range(len(before)) if i not in up]
    return any(lies_on(before[j], before[i]) for i in up for j in stay)


def lies_on(upper: LogState, lower: LogState) -> bool:
    """Tell whether a log rests on another: they touch, and it is higher there by a third of their radii together."""
    radii = (upper.diameter_m + lower.diameter_m) / 2
    gap, rise = min((_between(p, lower) for p in _points(upper)), key=lambda g: g[0])
    return gap < radii + CONTACT_M and rise > 0.3 * radii


def _points(log: LogState, count: int = 41) -> list[tuple[float, ...]]:
    a, b = log.ends_m
    return [tuple(p + i / (count - 1) * (q - p) for p, q in zip(a, b, strict=True)) for i in range(count)]


def _between(point: Sequence[float], log: LogState) -> tuple[float, float]:
    """Compute the distance [m] of a point from the axis of a log, and its height above the nearest point."""
    a, b = log.ends_m
    span = [q - p for p, q in zip(a, b, strict=True)]
    t = sum((x - p) * w for x, p, w in zip(point, a, span, strict=True)) / sum(w * w for w in span)
    foot = [p + min(max(t, 0.0), 1.0) * w for p, w in zip(a, span, strict=True)]
    return math.dist(point, foot), point[2] - foot[2]
