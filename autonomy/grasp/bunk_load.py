"""Where a log released over a bunk comes to rest: a cross-section of the load, logs as circles between stakes.

A log drops onto what is below it and rolls down to the nearest hollow.  Logs that lie askew count where they are at
both ends and in the middle of the new one.  Nothing is pushed aside: real loads settle a little lower.  Inputs: the
bunk, the logs that may lie in it, the new log.  No clock, no randomness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, inf, pi, remainder, sin
from typing import Final

import numpy as np

from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.grasp.planner import BunkFull, Grasp, NoGrasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m, rotator_for_yaw
from machine.geometry.kinematics import Unreachable
from machine.profile import Bunk

GRID_M: Final = 0.01
RELEASE_ERROR_M: Final = 0.05
"""Lateral error of a released log: tracking error, sway, a bent log."""
OPENING_CLEARANCE_M: Final = 0.17
"""Space that the jaws need beside a log while they open: the travel of the tips, and their thickness."""
_DROP_COST: Final = 0.6
"""Cost of a drop per metre, as height: a log that drops far may roll on or push others."""
_SPREAD_COST: Final = 2.0
"""Cost of the spread of the resting place per metre (standard deviation), as height: a log released on top of another
rolls to either side or stays there, and the last ones lie over the stakes."""
_COST_GRAIN_M: Final = 0.03
"""Places whose cost differs by less are equal."""
_ROLL_GRAIN_M: Final = 0.1
"""A log that rolls less far rests where it was released."""
ROLLS_FROM: Final = 0.05
"""A log that lies on others or on a plane rolls from this slope on."""
_SECTION_SHARE: Final = 0.35
"""Positions of the cross-sections through the new log, as shares of its length from the middle."""


@dataclass(frozen=True, slots=True)
class RestingPlace:
    """A place across the bunk [m, from its middle], the height of what is under log and jaws there, and the greatest
    height at which the log's axis may come to rest, m.
    """

    across_m: float
    support_z_m: float
    rest_z_m: float


class BunkLoad:
    """The load of a bunk, as a new log of the given diameter and length [m] meets it.

    ``slope``: how the machine stands (`autonomy.motion.arm_kinematics`); on a slope logs roll to the lower stakes.
    """

    def __init__(
        self,
        bunk: Bunk,
        logs: Sequence[LogObservation],
        diameter_m: float,
        length_m: float,
        slope: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._radius_m = radius = diameter_m / 2
        half = max(bunk.width_m / 2 - radius, 0.0)
        steps = int(half / GRID_M)
        self._across = np.arange(-steps, steps + 1) * GRID_M
        sections = np.array([-_SECTION_SHARE, 0.0, _SECTION_SHARE]) * length_m
        across, height, other = _sections(bunk, logs, sections)
        beside = np.abs(self._across[:, None] - across)
        wide = radius + other
        over = height + np.sqrt(np.maximum(wide**2 - beside**2, 0.0))
        self._bed = np.max(np.where(beside < wide, over, -np.inf), axis=1, initial=bunk.floor_z_m + radius)
        self._empty = bool(np.all(self._bed <= bunk.floor_z_m + radius))
        near = np.where(beside < wide + OPENING_CLEARANCE_M, height + other, -np.inf)
        self._under = np.max(near, axis=1, initial=bunk.floor_z_m)
        downhill = _rotated(bunk, *slope)[1]
        fall = downhill * self._across if abs(downhill) > ROLLS_FROM else 0.0
        self._hollow = _hollows(self._bed - fall)
        self._rest = self._bed[self._hollow]

    def place_at(self, across_m: float) -> RestingPlace:
        """Return the resting place of a log released there; beyond the stakes it counts as beside them."""
        return self._place(int(np.argmin(np.abs(self._across - across_m))))

    def resting_point(self, across_m: float) -> tuple[float, float]:
        """Return where the axis of a log released there comes to rest: across the bunk and height, m."""
        i = int(self._hollow[np.argmin(np.abs(self._across - across_m))])
        return float(self._across[i]), float(self._bed[i])

    def lowest_place(self, reach_m: float, highest_m: float = inf) -> RestingPlace:
        """Find the place at most ``reach_m`` from the middle where the log rests lowest.

        A place where it may come to rest above ``highest_m`` is chosen only where there is no other.  Among equal
        places it prefers the one where the log rolls least, then the middle of an empty bunk or else the place nearest
        to the stakes: a log there cannot roll, and the middle fills by itself.
        """
        grid_indices = np.flatnonzero(np.abs(self._across) <= reach_m + 0.5 * GRID_M).tolist()
        resting_places = [(i, self._place(i)) for i in grid_indices] or [(0, self.place_at(0.0))]
        resting_places = [item for item in resting_places if item[1].rest_z_m <= highest_m] or resting_places
        sign = 1.0 if self._empty else -1.0

        def cost(item: tuple[int, RestingPlace]) -> tuple[int, int, float]:
            i, rest = item
            low = self._mean(i)
            cost = low + _DROP_COST * (rest.support_z_m + self._radius_m - low) + _SPREAD_COST * self._spread(i)
            rolls = abs(float(self._across[self._hollow[i]]) - rest.across_m)
            return round(cost / _COST_GRAIN_M), round(rolls / _ROLL_GRAIN_M), sign * abs(rest.across_m)

        return min(resting_places, key=cost)[1]

    def _release_window(self, i: int, off_m: float = RELEASE_ERROR_M) -> slice:
        few = round(off_m / GRID_M)
        return slice(max(i - few, 0), i + few + 1)

    def _mean(self, i: int) -> float:
        return float(np.mean(self._rest[self._release_window(i)]))

    def _spread(self, i: int) -> float:
        """Compute how much more the resting places vary than the release places."""
        around = self._release_window(i, 2.0 * RELEASE_ERROR_M)
        return max(float(np.std(self._across[self._hollow[around]]) - np.std(self._across[around])), 0.0)

    def _place(self, i: int) -> RestingPlace:
        return RestingPlace(
            float(self._across[i]), float(self._under[i]), float(np.max(self._rest[self._release_window(i)]))
        )


def log_in_bunk(bunk: Bunk, log: LogObservation) -> tuple[float, float]:
    """Compute the position of a log's centre along and across a bunk, from its middle, m."""
    return point_in_bunk(bunk, log.center_m[0], log.center_m[1])


def point_in_bunk(bunk: Bunk, x_m: float, y_m: float) -> tuple[float, float]:
    """Compute the position of a point along and across a bunk, from its middle, m."""
    return _rotated(bunk, x_m - bunk.center_m[0], y_m - bunk.center_m[1])


def is_over_bunk(bunk: Bunk, x_m: float, y_m: float) -> bool:
    """Tell whether a point is between the stakes, seen from above."""
    along, across = point_in_bunk(bunk, x_m, y_m)
    return abs(along) <= bunk.length_m / 2 and abs(across) <= bunk.width_m / 2


def settled_in_bunk(
    bunk: Bunk, log: LogObservation, logs: Sequence[LogObservation], slope: tuple[float, float] = (0.0, 0.0)
) -> LogObservation:
    """Return a log released over a bunk that holds others as it then lies; keep a log beside the bunk as it is."""
    if not is_over_bunk(bunk, *log.center_m[:2]):
        return log
    across = log_in_bunk(bunk, log)[1]
    at, z = BunkLoad(bunk, logs, log.diameter_m, log.length_m, slope).resting_point(across)
    c, s, aside = cos(bunk.yaw_rad), sin(bunk.yaw_rad), at - across
    level = hypot(*log.axis[:2])
    axis = (log.axis[0] / level, log.axis[1] / level, 0.0) if level > 0.0 else log.axis
    x, y, _ = log.center_m
    return replace(log, center_m=(x - s * aside, y + c * aside, z), axis=axis, covariance=None)


def _rotated(bunk: Bunk, x: float, y: float) -> tuple[float, float]:
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    return x * c + y * s, -x * s + y * c


def _sections(
    bunk: Bunk, logs: Sequence[LogObservation], along: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute lateral places and heights of the logs' axes, and their radii, in cross-sections through the bunk."""
    cuts = []
    for log in logs:
        middle = log_in_bunk(bunk, log)
        ahead, aside = _rotated(bunk, log.axis[0], log.axis[1])
        if abs(ahead) < _SECTION_SHARE:  # it lies across the bunk: it counts everywhere between its ends
            ahead = _SECTION_SHARE if ahead >= 0.0 else -_SECTION_SHARE
        for at in along - middle[0]:
            share = at / ahead
            if abs(share) <= log.length_m / 2 + log.diameter_m / 2:
                rise = share * log.axis[2]
                cuts.append((middle[1] + share * aside, log.center_m[2] + rise, log.diameter_m / 2))
    across, height, radius = np.array(cuts).reshape(-1, 3).T
    return across, height, radius


def _hollows(bed: np.ndarray) -> np.ndarray:
    """Find for every place the index of the hollow that a log rolls down to from there; level ground keeps the log."""
    last = len(bed) - 1
    to = np.full(len(bed), -1)
    for begin in np.argsort(bed, kind="stable"):  # from the lowest, so that the hollow next to each place is known
        i = int(begin)
        sides = [k for k in (i - 1, i + 1) if 0 <= k <= last and bed[k] < bed[i] - 1e-9]
        to[i] = to[min(sides, key=lambda k: float(bed[k]))] if sides else i
    return to


# -- Where a gripped log is laid down: the lowest resting place in the bunk, the log along the bunk's axis.

BELOW_STAKE_TOP_M: Final = 0.05
"""The middle of a log must come to rest at least this far below the top of the stakes."""
RELEASE_CLEARANCE_M: Final = 0.07
STAKE_CLEARANCE_M: Final = 0.15
"""Between a log that is laid down and the stakes: covers sway and the tracking error."""
GRAPPLE_STAKE_CLEARANCE_M: Final = 0.40
"""Between the middle of the closed grapple and the stakes: its half width, and the path's margin."""

_END_ERROR_M, _SKEW_ERROR_RAD = 0.05, 0.15
"""A log in the bunk may be measured so far beside its place and its direction."""


def plan_place(
    arm: Arm,
    job: CraneJob,
    grasp: Grasp,
    logs: Sequence[LogObservation],
    held_yaw_rad: float | None = None,
    stands_rad: float | None = None,
    knows_load: bool = True,
    askew_rad: float = 0.0,
) -> Pose:
    """Plan the pose of the pin in which the grapple may open over the bunk.

    ``held_yaw_rad`` is the grapple's yaw while the log was seen to hang in it.  A thin log may lie askew in closed
    jaws: the rotator turns so that the log, not the grapple, lies along the bunk.  Of the turns that differ by half a
    turn it makes the one that ends nearest to ``stands_rad``, its angle by then; None: that of the grasp.  Without
    ``knows_load`` the log may lie above the stakes.  ``askew_rad``: by which it may lie askew in the jaws, unseen; it
    is laid so far from the stakes that its ends stay between them.

    Raises:
        BunkFull: the log would lie above the stakes.
        NoGrasp: the place is out of reach.
    """
    profile, bunk = arm.profile, job.to(arm.profile.bunk)
    top, thickest = bunk.floor_z_m + bunk.stake_height_m, max(log.diameter_m for log in grasp.logs)
    taken = {log.id for log in grasp.logs}
    load = BunkLoad(bunk, [o for o in logs if o.id not in taken], thickest, grasp.log.length_m, arm.slope)
    highest_m = top - BELOW_STAKE_TOP_M
    reach_m = bunk.width_m / 2 - max(thickest / 2 + STAKE_CLEARANCE_M, GRAPPLE_STAKE_CLEARANCE_M)
    reach_m = max(reach_m - 0.5 * grasp.log.length_m * sin(askew_rad), 0.0)
    rest = load.lowest_place(reach_m, highest_m)
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    center_x, center_y = bunk.center_m[0] - rest.across_m * s, bunk.center_m[1] + rest.across_m * c
    if job.place_m is not None:
        center_x, center_y = job.place_m
        rest = load.place_at(point_in_bunk(bunk, *job.place_m)[1])
    if knows_load and rest.rest_z_m > highest_m:
        raise BunkFull(
            "grasp.bunk-full", f"the bunk is full: log {grasp.log.id} would lie above the stakes; empty the bunk"
        )
    low = rest.support_z_m + RELEASE_CLEARANCE_M + lowest_tip_below_pin_m(profile.grapple.jaws)
    # The jaws open at the place itself, which is free of stakes; a log gripped off its centre shifts them only as far
    # as it would stick out of the bunk.
    out_m = max(0.0, abs(grasp.along_m) + grasp.log.length_m / 2 - bunk.length_m / 2)
    shift_m = out_m if grasp.along_m > 0.0 else -out_m
    log_yaw = atan2(grasp.log.axis[1], grasp.log.axis[0]) - grasp.pose.slew_rad - grasp.pose.rot_rad
    x, y = center_x, center_y
    observed_log = next((o for o in logs if o.id == grasp.log.id), None)
    skew, near = 0.0, grasp.pose.rot_rad if stands_rad is None else stands_rad
    if observed_log is not None and held_yaw_rad is not None:
        skew = remainder(atan2(observed_log.axis[1], observed_log.axis[0]) - (held_yaw_rad - pi / 2), pi)
        log_yaw += skew
    try:
        for _ in range(2):  # the log's direction depends on the place
            pose = arm.pose_above(x, y, low, travel_height_m(profile))
            rot = rotator_for_yaw(profile, pose.slew_rad, bunk.yaw_rad + pi / 2 - skew, near)
            laid = log_yaw + pose.slew_rad + rot
            x, y = center_x + shift_m * cos(laid), center_y + shift_m * sin(laid)
    except Unreachable as error:
        raise NoGrasp("grasp.place-out-of-reach", f"log {grasp.log.id} cannot be laid down: {error}") from None
    return pose._replace(rot_rad=rot)


def lies_in_bunk(bunk: Bunk, log: LogObservation) -> bool:
    """Tell whether the log's centre is between the stakes."""
    return is_over_bunk(bunk, *log.center_m[:2]) and log.center_m[2] < bunk.floor_z_m + bunk.stake_height_m


def reaches_above_stakes(bunk: Bunk, log: LogObservation) -> bool:
    """Tell whether a log in the bunk reaches above its stakes, over which a bump may throw it."""
    return log.center_m[2] + log.diameter_m / 2 > bunk.floor_z_m + bunk.stake_height_m


def lies_across_stakes(bunk: Bunk, log: LogObservation) -> bool:
    """Tell whether a log lies askew, with an end beyond the stakes by more than it may be measured wrongly."""
    across, skew = point_in_bunk(bunk, *log.center_m[:2])[1], atan2(log.axis[1], log.axis[0]) - bunk.yaw_rad
    aside_m = 0.5 * log.length_m * abs(sin(skew)) * hypot(*log.axis[:2])
    return abs(remainder(skew, pi)) > _SKEW_ERROR_RAD and abs(across) + aside_m > bunk.width_m / 2 + _END_ERROR_M
