"""Grasp and place of one log from its pose alone, as for a detector that makes no mistakes.

The tongs open across the log's axis at its centre, or at the nearest point along it that the crane reaches;
they go down in the open position and the pin follows their sweep while they close, so that the tips stay just
above what the log lies on.  The place is the bunk, the log along its axis.  Inputs: the machine, the mission,
the log list.  Failure: ``NoGrasp`` with one sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, pi, remainder, sin
from typing import Final

import numpy as np

from autonomy.logs import LogObservation
from autonomy.mission import Mission
from autonomy.motion.arm import Arm, Pose
from machine.grapple import lowest_tip_below_pin_m, rotator_for_yaw, tip_below_pin_m
from machine.kinematics import Unreachable
from machine.profile import Bunk, Profile

CLEARANCE_M: Final = (0.025, 0.05)
"""Least and greatest height of the tips over the support while closing: 3 to 5 cm lift 19 of 20, 1.5 cm 13 of
20 (plant.md 1)."""
TONG_HALF_PLATE_M: Final = 0.018
_UNDER: Final = 0.35
"""Tips under this share of a log's diameter scoop it, higher ones pinch it and lose it."""
_TOUCH: Final = 0.45
"""The tips touch a log when their half gap is this share of its diameter."""
RELEASE_CLEARANCE_M: Final = 0.07
HOVER_M: Final = 0.5
"""Open tips above the support before the vertical descent; more than a log's diameter."""
TRAVEL_CLEARANCE_M: Final = 0.40
"""Tips of a closed grapple above the stakes: a tilted log, its sway and the tracking error fit in between."""
RETREAT_CLEARANCE_M: Final = 0.20
LIFT_M: Final = 0.7
"""How far a log is lifted before the grasp is judged."""
_ALONG_M: Final = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
_STEEPEST: Final = 0.5
_RISE_LEAD_S: Final = 0.3
_FALL_LEAD_S: Final = 0.1
"""How far ahead of the tongs the pin rises and sinks: valve delay, and tips that would touch the ground."""
_SMOOTH_S: Final = 0.4
_STEP_S: Final = 0.02


class NoGrasp(ValueError):
    """No log can be picked or placed; the message says which and why."""


@dataclass(frozen=True, slots=True)
class Grasp:
    """Where closing begins: the pose of the pin, the height of the support, the point along the axis."""

    log: LogObservation
    pose: Pose
    support_z_m: float
    along_m: float


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
    return grasp.support_z_m + tip_below_pin_m(profile.grapple.tongs, 0.0) + HOVER_M


def clearance(diameter_m: float) -> float:
    """Height of the tips over the support, m: in the middle between scraping and pinching the log."""
    low, high = CLEARANCE_M
    return min(max((TONG_HALF_PLATE_M + _UNDER * diameter_m) / 2, low), high)


def closing_height(profile: Profile, support_z_m: float, diameter_m: float) -> Callable[[float], float]:
    """Height of the pin [m] over the closing time [s], smooth and at rest before 0.

    The tips, which sweep deeper and then rise while the tongs turn, stay ``clearance`` above the support until
    they touch the log; from then on the pin stands still.
    """
    tongs = profile.grapple.tongs
    rate = tongs.angle_rad[-1] / profile.grapple.close_time_s
    meet = float(np.interp(_TOUCH * diameter_m, tongs.half_gap_m[::-1], tongs.angle_rad[::-1]))
    half = _SMOOTH_S / 2
    grid = np.arange(-half, meet / rate + _SMOOTH_S, _STEP_S)
    angles = np.linspace(0.0, meet, 200)
    depth = np.interp(angles, tongs.angle_rad, tongs.tip_below_pin_m)

    def deepest(time_s: float) -> float:
        time_s = max(time_s, half)
        early, late = np.searchsorted(angles, rate * np.array([time_s + _FALL_LEAD_S, time_s + _RISE_LEAD_S]))
        return float(np.max(depth[min(early, 199) : min(late, 199) + 1]))

    window = np.hanning(int(_SMOOTH_S / _STEP_S) + 3)[1:-1]
    padded = [deepest(t) for t in np.arange(grid[0] - half, grid[-1] + half + _STEP_S / 2, _STEP_S)]
    smooth = np.convolve(padded, window / window.sum(), mode="same")
    height = support_z_m + clearance(diameter_m) + smooth
    times = np.arange(len(height)) * _STEP_S + grid[0] - half
    inside = (times >= -1e-9) & (times <= grid[-1] + 1e-9)
    times, height = times[inside], height[inside]
    return lambda time_s: float(np.interp(time_s, times, height))


def choose(arm: Arm, mission: Mission, logs: Sequence[LogObservation], slew: float, rot: float) -> Grasp:
    """The grasp of the mission's log, or of the topmost log outside the bunk and of these the nearest by
    slewing.

    ``slew`` and ``rot`` are the present angles, rad.  Raises ``NoGrasp``.
    """
    if mission.log_id is not None:
        candidates = [log for log in logs if log.id == mission.log_id]
        missing = f"log {mission.log_id} is not in view"
    else:
        candidates = [log for log in logs if not lies_in(arm.profile.bunk, log)]
        missing = "no log lies outside the bunk"
    grasps, trouble = [], [missing]
    for log in candidates:
        try:
            grasps.append(plan_grasp(arm, log, rot))
        except NoGrasp as error:
            trouble.append(str(error))
    if not grasps:
        raise NoGrasp(trouble[-1])
    return min(grasps, key=lambda g: (-round(g.log.center_m[2], 1), abs(g.pose.slew_rad - slew)))


def plan_grasp(arm: Arm, log: LogObservation, rot: float) -> Grasp:
    """The grasp of one log; raises ``NoGrasp``."""
    profile = arm.profile
    if abs(log.axis[2]) > _STEEPEST:
        raise NoGrasp(f"log {log.id} stands at {degrees(abs(np.arcsin(log.axis[2]))):.0f} deg, too steep to grip")
    yaw = atan2(log.axis[1], log.axis[0])
    trouble = ""
    for along in _ALONG_M:
        x, y, z = (c + along * a for c, a in zip(log.center_m, log.axis, strict=True))
        support = max(profile.workspace.ground_z_m, z - log.diameter_m / 2)
        low = closing_height(profile, support, log.diameter_m)(0.0)
        try:
            pose = arm.over(x, y, low, travel_height(profile))
            turn = rotator_for_yaw(profile, pose.slew_rad, yaw + pi / 2, rot)
        except Unreachable as error:
            trouble = trouble or f"log {log.id} cannot be picked: {error}"
            continue
        return Grasp(log, pose._replace(rot_rad=turn), support, along)
    raise NoGrasp(trouble)


def plan_place(
    arm: Arm, mission: Mission, grasp: Grasp, logs: Sequence[LogObservation], held_yaw_rad: float | None = None
) -> Pose:
    """The pose of the pin in which the tongs may open over the bunk; raises ``NoGrasp``.

    ``held_yaw_rad``: the grapple's yaw while the log was seen to hang in it.  A thin log may lie askew in closed tongs;
    the grapple is turned so that the log, not the grapple, lies along the bunk.
    """
    profile, bunk = arm.profile, arm.profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    below = [o.center_m[2] + o.diameter_m / 2 for o in logs if o.id != grasp.log.id and lies_in(bunk, o)]
    support = max([bunk.floor_z_m, *below])
    if support + grasp.log.diameter_m > top:
        raise NoGrasp(f"the bunk is full: log {grasp.log.id} would lie above the stakes, empty the bunk")
    low = support + RELEASE_CLEARANCE_M + lowest_tip_below_pin_m(profile.grapple.tongs)
    # The tongs open at the place itself, which is free of stakes; a log gripped off its centre moves them
    # only as far as it would stick out of the bunk.
    out_m = max(0.0, abs(grasp.along_m) + grasp.log.length_m / 2 - bunk.length_m / 2)
    shift_m = out_m if grasp.along_m > 0.0 else -out_m
    log_yaw = atan2(grasp.log.axis[1], grasp.log.axis[0]) - grasp.pose.slew_rad - grasp.pose.rot_rad
    center_x, center_y = x, y = mission.place_m or bunk.center_m
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
    x, y = log.center_m[0] - bunk.center_m[0], log.center_m[1] - bunk.center_m[1]
    along = x * cos(bunk.yaw_rad) + y * sin(bunk.yaw_rad)
    across = -x * sin(bunk.yaw_rad) + y * cos(bunk.yaw_rad)
    inside = abs(along) <= bunk.length_m / 2 and abs(across) <= bunk.width_m / 2
    return inside and log.center_m[2] < bunk.floor_z_m + bunk.stake_height_m


def is_held(arm: Arm, log: LogObservation, pin: Pose) -> bool:
    """Whether the log hangs under a pin: near it sideways, and as high as tongs can hold it."""
    x, y = arm.xy(pin)
    reach = lowest_tip_below_pin_m(arm.profile.grapple.tongs) + 0.3
    near = hypot(log.center_m[0] - x, log.center_m[1] - y) < log.length_m / 2
    return near and log.center_m[2] > pin.z_m - reach
