"""Grasp and place of one log from its pose alone, as for a detector that makes no mistakes; and how any grasp is done.

The tongs open across the log's axis at its centre, or at the nearest point along it that the crane reaches;
they go down in the open position and the pin follows their sweep while they close, so that the tips stay just
above what the log lies on.  The place is the bunk, the log along its axis.  A planner (``autonomy.grasp.proposal``)
may choose instead, also several logs at once; ``Planned`` makes its proposal a grasp of the same kind.  Inputs: the
machine, the mission, the log list.  Failure: ``NoGrasp`` with one sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, cos, degrees, hypot, inf, pi, remainder, sin
from typing import Final

import numpy as np

from autonomy.grasp.heap import Heap, is_over, point_in_bunk
from autonomy.grasp.proposal import BunkFull, NoGrasp, Planner
from autonomy.missions.crane_job import Mission
from autonomy.motion.arm import Arm, Pose
from autonomy.perception.logs import LogObservation
from machine.grapple import lowest_tip_below_pin_m, rotator_for_yaw, tip_below_pin_m
from machine.kinematics import Unreachable
from machine.profile import Bunk, Profile, TongTable

CLEARANCE_M: Final = (0.025, 0.05)
"""Least and greatest height of the tips over the support while closing: 3 to 5 cm lift 19 of 20, 1.5 cm 13 of
20 (plant.md 1)."""
TONG_HALF_PLATE_M: Final = 0.018
UNDER: Final = 0.35
"""Tips under this share of a log's diameter scoop it, higher ones pinch it and lose it."""
_TOUCH: Final = 0.45
"""The tips touch a log when their half gap is this share of its diameter."""
BELOW_TOP_M: Final = 0.05
"""The middle of a log is to come to rest so far below the top of the stakes or lower."""
RELEASE_CLEARANCE_M: Final = 0.07
HOVER_M: Final = 0.5
"""Open tips above the support before the vertical descent; more than a log's diameter."""
PASS_M: Final = 0.15
"""Open tips above the logs that they come in over."""
TRAVEL_CLEARANCE_M: Final = 0.40
"""Tips of a closed grapple above the stakes: a tilted log, its sway and the tracking error fit in between."""
RETREAT_CLEARANCE_M: Final = 0.20
LIFT_M: Final = 0.7
"""How far a log is lifted before the grasp is judged."""
SIDE_M: Final = 0.15
"""Between a log that is laid down and the stakes: sway and the tracking error."""
TONGS_SIDE_M: Final = 0.40
"""Between the middle of closed tongs and the stakes: their half width, and the way's margin."""
BESIDE_M: Final = 0.15
"""Tips that are so far beside a log when they leave it do not take it along."""
ALONE_M: Final = 0.9
"""A grasp with no other log so near to it cannot scoop one up: the tongs' half opening, and some."""
_ALONG_M: Final = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
_STEEPEST: Final = 0.5
_RISE_LEAD_S: Final = 0.3
_FALL_LEAD_S: Final = 0.1
"""How far ahead of the tongs the pin rises and sinks: valve delay, and tips that would touch the ground."""
_SMOOTH_S: Final = 0.4
_STEP_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Grasp:
    """Where closing begins: the pose of the pin, the height of the support, the point along the axis of ``log``.

    ``others`` come up with it; ``top_z_m`` is the highest point of a log under the way down, or None; ``reason`` is a
    sentence for the operator, ``probability`` that of success where a planner reckons with one; ``pressed``: the tongs
    go down among other logs, as far as these let them; ``drawn``: to draw the log out of a row; ``drags``: pinched by
    its upper half it is dragged out, to be gripped there.
    """

    log: LogObservation
    pose: Pose
    support_z_m: float
    along_m: float
    others: tuple[LogObservation, ...] = ()
    top_z_m: float | None = None
    reason: str = ""
    probability: float | None = None
    pressed: bool = False
    drawn: bool = False
    drags: bool = False

    @property
    def logs(self) -> tuple[LogObservation, ...]:
        """All logs that are to come up."""
        return (self.log, *self.others)

    @property
    def gathered(self) -> bool:
        """Whether it is lifted slowly while the tongs go on closing: what a planner chose may settle in them."""
        return self.top_z_m is not None

    @property
    def thinnest_m(self) -> float:
        """Least diameter of these."""
        return min(log.diameter_m for log in self.logs)


Chooser = Callable[[Arm, Mission, Sequence[LogObservation], float, float], Grasp]
"""How a grasp is chosen: arm, mission, log list, present slew and rotator [rad]; raises ``NoGrasp``."""


def travel_height(profile: Profile) -> float:
    """Height of the pin at which a held log passes over the stakes, m."""
    bunk = profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    return top + lowest_tip_below_pin_m(profile.grapple.tongs) + TRAVEL_CLEARANCE_M


def retreat_height(profile: Profile) -> float:
    """Height of the pin at which the open grapple is clear of the stakes, m."""
    bunk = profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    return top + tip_below_pin_m(profile.grapple.tongs, 0.0) + RETREAT_CLEARANCE_M


def approach_length(profile: Profile, log: LogObservation) -> float:
    """How far before the place a carried log must be at its travel height, m."""
    return (log.length_m + profile.bunk.length_m) / 2 + HOVER_M


def hover_height(profile: Profile, grasp: Grasp) -> float:
    """Height of the pin from which the open grapple goes straight down, m."""
    over = grasp.support_z_m + HOVER_M
    if grasp.top_z_m is not None:
        over = max(over, grasp.top_z_m + PASS_M)
    return over + tip_below_pin_m(profile.grapple.tongs, 0.0)


def known_ground_m(profile: Profile) -> float:
    """Height below which nothing lies, m: a machine on wheels knows none, for its frame goes up and down."""
    return profile.workspace.ground_z_m if profile.carrier is None else -inf


def opened_angle(profile: Profile, thickest_m: float) -> float:
    """The tong angle [rad] at which the tips are clear of a log that lies between them."""
    tongs = profile.grapple.tongs
    return float(np.interp(thickest_m / 2 + BESIDE_M, tongs.half_gap_m[::-1], tongs.angle_rad[::-1]))


def clearance(diameter_m: float) -> float:
    """Height of the tips over the support, m: in the middle between scraping and pinching the log."""
    low, high = CLEARANCE_M
    return min(max((TONG_HALF_PLATE_M + UNDER * diameter_m) / 2, low), high)


def closing_height(profile: Profile, support_z_m: float, diameter_m: float) -> Callable[[float], float]:
    """Height of the pin [m] over the closing time [s], smooth and at rest before 0.

    The tips, which sweep deeper and then rise while the tongs turn, stay ``clearance`` above the support until
    they touch the log; from then on the pin stands still.
    """
    times, sweep = _sweep(profile.grapple.tongs, profile.grapple.close_time_s, diameter_m)
    height = support_z_m + clearance(diameter_m) + sweep
    return lambda time_s: float(np.interp(time_s, times, height))


@lru_cache(maxsize=64)
def _sweep(tongs: TongTable, close_time_s: float, diameter_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and how deep below the pin closing tongs reach then [m]; a log is asked about again and again."""
    rate = tongs.angle_rad[-1] / close_time_s
    meet = float(np.interp(_TOUCH * diameter_m, tongs.half_gap_m[::-1], tongs.angle_rad[::-1]))
    half = _SMOOTH_S / 2
    grid = np.arange(-half, meet / rate + _SMOOTH_S, _STEP_S)
    angles = np.linspace(0.0, meet, 200)
    depth = np.interp(angles, tongs.angle_rad, tongs.tip_below_pin_m)
    padded = np.maximum(np.arange(grid[0] - half, grid[-1] + half + _STEP_S / 2, _STEP_S), half)[:, None]
    early, late = (np.searchsorted(angles, rate * (padded + lead)) for lead in (_FALL_LEAD_S, _RISE_LEAD_S))
    at = np.arange(len(angles))
    under_way = (at >= np.minimum(early, 199)) & (at <= late)
    deepest = np.max(np.where(under_way, depth, -inf), axis=1)
    window = np.hanning(int(_SMOOTH_S / _STEP_S) + 3)[1:-1]
    smooth = np.convolve(deepest, window / window.sum(), mode="same")
    times = np.arange(len(smooth)) * _STEP_S + grid[0] - half
    inside = (times >= -1e-9) & (times <= grid[-1] + 1e-9)
    return times[inside], smooth[inside]


def pose_over(
    arm: Arm, x_m: float, y_m: float, yaw_rad: float, support_z_m: float, thinnest_m: float, rot_rad: float
) -> Pose:
    """The pose in which tongs that open along ``yaw_rad`` begin to close over a support round logs of which the
    thinnest is ``thinnest_m``, the rotator turned from ``rot_rad``; raises ``Unreachable``.
    """
    low = closing_height(arm.profile, support_z_m, thinnest_m)(0.0)
    pose = arm.over(x_m, y_m, low, travel_height(arm.profile))
    return pose._replace(rot_rad=rotator_for_yaw(arm.profile, pose.slew_rad, yaw_rad, rot_rad))


def choose(arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
    """The grasp of the mission's log, or of the topmost log outside the bunk and of these the nearest by
    slewing.

    ``slew`` and ``rot`` are the present angles, rad.  Raises ``NoGrasp``.
    """
    if mission.log_id is not None:
        candidates = [log for log in logs if log.id == mission.log_id]
        missing, why = f"log {mission.log_id} is not in view", "the one that the mission names"
    else:
        candidates, missing = waiting(arm.profile, mission, logs)
        why = "the topmost that is in reach, of these the nearest by slewing"
    grasps, trouble = [], [missing]
    for log in candidates:
        try:
            grasps.append(plan_grasp(arm, log, rot))
        except NoGrasp as error:
            trouble.append(str(error))
    if not grasps:
        raise NoGrasp(trouble[-1])
    best = min(grasps, key=lambda g: (-round(g.log.center_m[2], 1), abs(g.pose.slew_rad - slew)))
    return replace(best, reason=f"log {best.log.id}, {why}")


def waiting(profile: Profile, mission: Mission, logs: Sequence[LogObservation]) -> tuple[list[LogObservation], str]:
    """The logs that are still to be picked, and the sentence for when there is none."""
    there, missing = _there(profile, mission, logs)
    found = [log for log in there if log.id not in mission.leave]
    return found, "every log that lies there is to stay" if there else missing


def _there(profile: Profile, mission: Mission, logs: Sequence[LogObservation]) -> tuple[list[LogObservation], str]:
    """The logs that lie where logs come from, also those that are to stay; and the sentence for when none does."""
    if mission.source is not None:
        return [log for log in logs if lies_in(mission.source, log)], "no log is left where logs come from"
    target = mission.to(profile.bunk)
    return [log for log in logs if not lies_in(target, log)], "no log lies outside the bunk"


def plan_grasp(arm: Arm, log: LogObservation, rot: float) -> Grasp:
    """The grasp of one log; raises ``NoGrasp``."""
    profile = arm.profile
    if abs(log.axis[2]) > _STEEPEST:
        raise NoGrasp(f"log {log.id} stands at {degrees(abs(np.arcsin(log.axis[2]))):.0f} deg, too steep to grip")
    yaw = atan2(log.axis[1], log.axis[0])
    trouble = ""
    for along in _ALONG_M:
        x, y, z = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        support = max(known_ground_m(profile), z - log.diameter_m / 2)
        try:
            pose = pose_over(arm, x, y, yaw + pi / 2, support, log.diameter_m, rot)
        except Unreachable as error:
            trouble = trouble or f"log {log.id} cannot be picked: {error}"
            continue
        return Grasp(log, pose, support, along)
    raise NoGrasp(trouble)


class Planned:
    """A ``Chooser`` that lets a planner choose among the logs outside the bunk."""

    def __init__(self, planner: Planner) -> None:
        self._planner = planner

    def __call__(self, arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
        """The proposal as a grasp; a mission that names its log is served by ``choose``."""
        if mission.log_id is not None:
            return choose(arm, mission, logs, slew, rot)
        wanted, missing = waiting(arm.profile, mission, logs)
        if not wanted:
            raise NoGrasp(missing)
        there, _ = _there(arm.profile, mission, logs)
        stay = {i for i, log in enumerate(there) if log.id in mission.leave}
        p = self._planner(arm, there, slew, rot, stay)
        first, *others = sorted((there[i] for i in p.logs), key=lambda log: -log.length_m)
        thinnest = min(log.diameter_m for log in (first, *others))
        try:
            pose = pose_over(arm, p.x_m, p.y_m, p.yaw_rad, p.support_z_m, thinnest, rot)
        except Unreachable as error:
            raise NoGrasp(f"the planner's grasp is out of reach: {error}") from None
        along = _along((p.x_m, p.y_m), first)
        near = [log for log in there if log is not first and _beside((p.x_m, p.y_m), log) < ALONE_M]
        # What lies alone cannot settle, and comes up as `choose` would lift it.
        top = _top(there) if near or others else None
        return Grasp(first, pose, p.support_z_m, along, tuple(others), top, p.reason, p.probability, p.pressed, p.drawn)


def _top(logs: Sequence[LogObservation]) -> float:
    """The highest point of logs, m."""
    return max(log.center_m[2] + abs(log.axis[2]) * log.length_m / 2 + log.diameter_m / 2 for log in logs)


def _beside(point: tuple[float, float], log: LogObservation) -> float:
    """How far a point is from a log, seen from above, m; 0 over it."""
    along = min(max(_along(point, log), -log.length_m / 2), log.length_m / 2)
    x, y = (c + along * a for c, a in zip(log.center_m[:2], log.axis[:2], strict=True))
    return max(hypot(point[0] - x, point[1] - y) - log.diameter_m / 2, 0.0)


def _along(point: tuple[float, float], log: LogObservation) -> float:
    """How far along a log's axis a point is from its centre, m."""
    return (point[0] - log.center_m[0]) * log.axis[0] + (point[1] - log.center_m[1]) * log.axis[1]


def only(arm: Arm, grasp: Grasp, held: Sequence[int]) -> Grasp:
    """The grasp with those of its logs that truly came up, by their numbers."""
    if all(log.id in held for log in grasp.logs):
        return grasp
    first, *others = (log for log in grasp.logs if log.id in held)
    return replace(grasp, log=first, others=tuple(others), along_m=_along(arm.xy(grasp.pose), first))


def plan_place(
    arm: Arm, mission: Mission, grasp: Grasp, logs: Sequence[LogObservation], held_yaw_rad: float | None = None
) -> Pose:
    """The pose of the pin in which the tongs may open over the bunk; raises ``NoGrasp``.

    ``held_yaw_rad``: the grapple's yaw while the log was seen to hang in it.  A thin log may lie askew in closed tongs;
    the grapple is turned so that the log, not the grapple, lies along the bunk.
    """
    profile, bunk = arm.profile, mission.to(arm.profile.bunk)
    top, thickest = bunk.floor_z_m + bunk.stake_height_m, max(log.diameter_m for log in grasp.logs)
    taken = {log.id for log in grasp.logs}
    heap = Heap(bunk, [o for o in logs if o.id not in taken], thickest, grasp.log.length_m)
    rest = heap.lowest(bunk.width_m / 2 - max(thickest / 2 + SIDE_M, TONGS_SIDE_M))
    c, s = cos(bunk.yaw_rad), sin(bunk.yaw_rad)
    center_x, center_y = bunk.center_m[0] - rest.across_m * s, bunk.center_m[1] + rest.across_m * c
    if mission.place_m is not None:
        center_x, center_y = mission.place_m
        rest = heap.at(point_in_bunk(bunk, *mission.place_m)[1])
    if rest.rest_z_m > top - BELOW_TOP_M:
        raise BunkFull(f"the bunk is full: log {grasp.log.id} would lie above the stakes, empty the bunk")
    low = rest.support_z_m + RELEASE_CLEARANCE_M + lowest_tip_below_pin_m(profile.grapple.tongs)
    # The tongs open at the place itself, which is free of stakes; a log gripped off its centre moves them
    # only as far as it would stick out of the bunk.
    out_m = max(0.0, abs(grasp.along_m) + grasp.log.length_m / 2 - bunk.length_m / 2)
    shift_m = out_m if grasp.along_m > 0.0 else -out_m
    log_yaw = atan2(grasp.log.axis[1], grasp.log.axis[0]) - grasp.pose.slew_rad - grasp.pose.rot_rad
    x, y = center_x, center_y
    seen = next((o for o in logs if o.id == grasp.log.id), None)
    skew = 0.0
    if seen is not None and held_yaw_rad is not None:
        skew = remainder(atan2(seen.axis[1], seen.axis[0]) - (held_yaw_rad - pi / 2), pi)
        log_yaw += skew
    try:
        for _ in range(2):  # which way the log points is known once the place is
            pose = arm.over(x, y, low, travel_height(profile))
            rot = rotator_for_yaw(profile, pose.slew_rad, bunk.yaw_rad + pi / 2 - skew, grasp.pose.rot_rad)
            laid = log_yaw + pose.slew_rad + rot
            x, y = center_x + shift_m * cos(laid), center_y + shift_m * sin(laid)
    except Unreachable as error:
        raise NoGrasp(f"log {grasp.log.id} cannot be laid down: {error}") from None
    return pose._replace(rot_rad=rot)


def lies_in(bunk: Bunk, log: LogObservation) -> bool:
    """Whether the log's centre is between the stakes."""
    return is_over(bunk, *log.center_m[:2]) and log.center_m[2] < bunk.floor_z_m + bunk.stake_height_m


def is_held(arm: Arm, log: LogObservation, pin: Pose) -> bool:
    """Whether the log hangs under a pin: near it sideways, and as high as tongs can hold it."""
    x, y = arm.xy(pin)
    reach = lowest_tip_below_pin_m(arm.profile.grapple.tongs) + 0.3
    near = hypot(log.center_m[0] - x, log.center_m[1] - y) < log.length_m / 2
    return near and log.center_m[2] > pin.z_m - reach
