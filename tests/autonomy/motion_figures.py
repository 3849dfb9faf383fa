"""What a motion asks of a crane and how near it comes to things, worked out without the planner's own distances, laws
and kinematics: from the profile's limits, the forward kinematics, pendulums step by step, and points upon every part.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, pi

import numpy as np

from autonomy.motion.obstacles import CollisionScene, HeldLog, swept_capsules
from autonomy.motion.trajectory import Trajectory
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS
from machine.profile import Profile, joint

STEP_S = 0.005
PERIODS_S = (1.5, 1.8, 2.1)
LEAVE_M = 1.2
POINTS = 41


@dataclass(frozen=True, slots=True)
class Figures:
    """Shares of the limits of stops (over 1: beyond), speed, acceleration and pump; the greatest jerk [s]: its limit of
    acceleration is reached in so long; swing left [rad]; clearance on the way, and what is lost near the ends, [m].
    """

    stops: float
    speed: float
    acceleration: float
    pump: float
    jerk_s: float
    swing_rad: float
    clearance_m: float
    lost_m: float


def figures(profile: Profile, motion: Trajectory, around: CollisionScene, held: HeldLog | None) -> Figures:
    """All of them, looked at every 5 ms, clearances every 20 ms."""
    time_s = np.arange(0.0, motion.duration_s + STEP_S / 2, STEP_S)
    both = [motion.at(min(t, motion.duration_s - 1e-9)) for t in time_s]
    q, v = (np.array(x) for x in zip(*both, strict=True))
    a = np.diff(v, axis=0) / STEP_S
    jerk = np.abs(np.diff(np.array(motion.velocity), n=2, axis=0)) / 0.02**2
    specs = [joint(profile, j) for j in JOINTS]
    most = np.array([s.acceleration_limit for s in specs])
    low, high = (np.array([getattr(s, side) for s in specs]) for side in ("lower", "upper"))
    pin = np.array([pin_position(profile.kinematics, row) for row in q.tolist()])
    apart, away = _apart(profile, q[::4], pin[::4], around, held)
    middle = away > LEAVE_M
    return Figures(
        float(np.max(np.abs(2.0 * q - low - high) / (high - low))),
        float(np.max(np.abs(v) / [s.speed_limit for s in specs])),
        float(np.max(np.abs(a) / most)),
        float(np.max(_flow(profile, q, v))) / profile.hydraulics.pump_flow_m3_s,
        float(1.0 / max(np.max(jerk / most), 1e-9)),
        max(_swing(pin, period) for period in PERIODS_S),
        float(np.min(apart[middle])) if middle.any() else np.inf,
        float(np.max(np.minimum(np.minimum(apart[0], apart[-1]), 0.05) - apart)),
    )


def _flow(profile: Profile, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    total = np.zeros(len(q))
    for j in JOINTS:
        valve = joint(profile, j).valve
        lever = np.interp(q[:, j], valve.lever_at, valve.lever) if valve.lever else 1.0
        total += np.where(v[:, j] > 0.0, v[:, j] * valve.flow_plus, -v[:, j] * valve.flow_minus) * lever
    return total


def _swing(pin: np.ndarray, period_s: float) -> float:
    """What is left when the pin stands."""
    omega, lean, rate = 2.0 * pi / period_s, np.zeros(2), np.zeros(2)
    for push in np.diff(pin[:, :2], n=2, axis=0) / STEP_S**2:
        rate += STEP_S * (-push - omega**2 * lean)
        lean += STEP_S * rate
    return float(np.hypot(hypot(*lean), hypot(*rate) / omega)) * omega**2 / 9.81


def _apart(
    profile: Profile, q: np.ndarray, pin: np.ndarray, around: CollisionScene, held: HeldLog | None
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of every part from every thing (n, m, k), by points, and of the pin from the motion's ends (n,)."""
    body = swept_capsules(profile, q, pin, held)
    share = np.linspace(0.0, 1.0, POINTS)[:, None, None, None]
    points = body.a + share * (body.b - body.a)
    ground = around.ground(points[..., 0], points[..., 1]) if callable(around.ground) else around.ground
    columns = [points[..., 2] - ground]
    for box in around.boxes:
        d = points - box.center_m
        c, s = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
        local = np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], d[..., 2]], -1)
        columns.append(np.linalg.norm(np.maximum(np.abs(local) - box.half_m, 0.0), axis=-1))
    for rod in around.capsules:
        a, b = np.array(rod.a_m), np.array(rod.b_m)
        along = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-12), 0.0, 1.0)
        columns.append(np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1) - rod.radius_m)
    apart = np.stack([column.min(axis=0) for column in columns], axis=-1) - body.radius[:, None]
    away = np.minimum(*(np.linalg.norm(pin - pin[i], axis=1) for i in (0, -1)))
    return apart, away
