"""Heights of the hanger pin during a grasp: travel, hover, closing and release.

While the jaws close, the pin follows their sweep, so that the tips stay just above what the log lies on.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import inf
from typing import Final

import numpy as np

from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import lowest_tip_below_pin_m, rotator_for_yaw, tip_below_pin_m
from machine.profile import JawTable, Profile

TIP_CLEARANCE_M: Final = (0.025, 0.05)
"""Least and greatest height of the tips over the support while closing: 3 to 5 cm lift 19 of 20 logs, 1.5 cm 13 of
20 (docs/reference/plant-model.md section 1)."""
HALF_PLATE_M: Final = 0.018
SCOOP_SHARE: Final = 0.35
"""Tips below this share of a log's diameter scoop it; higher ones pinch it and lose it."""
_CONTACT_SHARE: Final = 0.45
"""The tips touch a log when their half gap is this share of its diameter."""
HOVER_CLEARANCE_M: Final = 0.5
"""Height of the open tips above the support before the vertical descent; more than a log's diameter."""
PASS_CLEARANCE_M: Final = 0.15
"""Height of the open tips above the logs that they pass over."""
TRAVEL_CLEARANCE_M: Final = 0.40
"""Height of the closed tips above the stakes: leaves room for a tilted log, its sway and the tracking error."""
RETREAT_CLEARANCE_M: Final = 0.20
VERIFY_LIFT_M: Final = 0.7
"""How far a log is lifted before the grasp is verified."""
RELEASE_SIDE_CLEARANCE_M: Final = 0.15
"""Tips this far beside a log do not take it along when they leave it."""
_RISE_LEAD_S: Final = 0.3
_FALL_LEAD_S: Final = 0.1
"""How far ahead of the jaws the pin rises and sinks: covers the valve delay and keeps the tips off the ground."""
_SMOOTH_S: Final = 0.4
_STEP_S: Final = 0.02


def travel_height_m(profile: Profile) -> float:
    """Compute the height of the pin at which a held log passes over the stakes, m."""
    bunk = profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    return top + lowest_tip_below_pin_m(profile.grapple.jaws) + TRAVEL_CLEARANCE_M


def retreat_height_m(profile: Profile) -> float:
    """Compute the height of the pin at which the open grapple is clear of the stakes, m."""
    bunk = profile.bunk
    top = bunk.floor_z_m + bunk.stake_height_m
    return top + tip_below_pin_m(profile.grapple.jaws, 0.0) + RETREAT_CLEARANCE_M


def approach_length_m(profile: Profile, log: LogObservation) -> float:
    """Compute the distance before the place at which a carried log must be at its travel height, m."""
    return (log.length_m + profile.bunk.length_m) / 2 + HOVER_CLEARANCE_M


def hover_height_m(profile: Profile, grasp: Grasp) -> float:
    """Compute the height of the pin from which the open grapple descends vertically, m."""
    over = grasp.support_z_m + HOVER_CLEARANCE_M
    if grasp.top_z_m is not None:
        over = max(over, grasp.top_z_m + PASS_CLEARANCE_M)
    return over + tip_below_pin_m(profile.grapple.jaws, 0.0)


def known_ground_m(profile: Profile) -> float:
    """Return the height below which nothing lies, m; -inf on a machine on wheels, whose frame moves up and down."""
    return profile.workspace.ground_z_m if profile.carrier is None else -inf


def release_angle_rad(profile: Profile, thickest_m: float) -> float:
    """Compute the jaw angle [rad] at which the tips are clear of a log that lies between them."""
    jaws = profile.grapple.jaws
    return float(np.interp(thickest_m / 2 + RELEASE_SIDE_CLEARANCE_M, jaws.half_gap_m[::-1], jaws.angle_rad[::-1]))


def tip_clearance_m(diameter_m: float) -> float:
    """Compute the height of the tips over the support, m: midway between scraping the ground and pinching the log."""
    low, high = TIP_CLEARANCE_M
    return min(max((HALF_PLATE_M + SCOOP_SHARE * diameter_m) / 2, low), high)


def closing_height_curve(profile: Profile, support_z_m: float, diameter_m: float) -> Callable[[float], float]:
    """Return the height of the pin [m] as a function of the closing time [s], smooth and at rest before 0.

    The tips first sweep deeper and then rise while the jaws turn.  The pin keeps them ``tip_clearance_m`` above the
    support until they touch the log; from then on it stands still.
    """
    times, sweep = _sweep(profile.grapple.jaws, profile.grapple.close_time_s, diameter_m)
    height = support_z_m + tip_clearance_m(diameter_m) + sweep
    return lambda time_s: float(np.interp(time_s, times, height))


@lru_cache(maxsize=64)
def _sweep(jaws: JawTable, close_time_s: float, diameter_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute times [s] and the depth of closing tips below the pin then [m]; cached, as logs repeat."""
    rate = jaws.angle_rad[-1] / close_time_s
    meet = float(np.interp(_CONTACT_SHARE * diameter_m, jaws.half_gap_m[::-1], jaws.angle_rad[::-1]))
    half = _SMOOTH_S / 2
    grid = np.arange(-half, meet / rate + _SMOOTH_S, _STEP_S)
    angles = np.linspace(0.0, meet, 200)
    depth = np.interp(angles, jaws.angle_rad, jaws.tip_below_pin_m)
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


def grasp_pose(
    arm: Arm, x_m: float, y_m: float, yaw_rad: float, support_z_m: float, thinnest_m: float, rot_rad: float
) -> Pose:
    """Compute the pose in which the grapple begins to close on logs over a support.

    The jaws open along ``yaw_rad``; ``thinnest_m`` is the least diameter of the logs; the rotator turns from
    ``rot_rad``.

    Raises:
        Unreachable: the pose is out of reach.
    """
    low = closing_height_curve(arm.profile, support_z_m, thinnest_m)(0.0)
    pose = arm.pose_above(x_m, y_m, low, travel_height_m(arm.profile))
    return pose._replace(rot_rad=rotator_for_yaw(arm.profile, pose.slew_rad, yaw_rad, rot_rad))
