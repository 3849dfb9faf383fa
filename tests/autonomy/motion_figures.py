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

STEP_S, GRAVITY_M_S2 = 0.005, 9.81
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


def sampled(motion: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Positions and the velocities that the motion states, every 5 ms, with rest before and after."""
    q, v = zip(*(motion.at(t) for t in np.arange(-0.02, motion.duration_s + 0.02, STEP_S)), strict=True)
    return np.array(q), np.array(v)


def pins(profile: Profile, q: np.ndarray) -> np.ndarray:
    """Where the pin is (n, 3)."""
    return np.array([pin_position(profile.kinematics, row) for row in q.tolist()])


def assert_within_limits(profile: Profile, motion: Trajectory, pump: float = 0.96) -> None:
    """Within the joints' ranges, speeds and accelerations and a share of the pump's oil; its velocities are its own."""
    q, stated = sampled(motion)
    assert np.max(np.abs(np.gradient(q, STEP_S, axis=0) - stated)) < 0.005
    acceleration = np.abs(np.gradient(stated, STEP_S, axis=0))
    for j in JOINTS:
        spec = joint(profile, j)
        assert q[:, j].min() >= spec.lower and q[:, j].max() <= spec.upper
        assert np.max(np.abs(stated[:, j])) < spec.speed_limit and np.max(acceleration[:, j]) < spec.acceleration_limit
    assert np.max(_flow(profile, q, stated)) < pump * profile.hydraulics.pump_flow_m3_s


def swing(pin: np.ndarray, period_s: float, damping: float = 0.0) -> tuple[float, float]:
    """A point mass on a rigid rod below a pin that is known every 5 ms: what it swings when the pin stands, and at
    most, [rad]."""
    omega, angle, rate, most = 2.0 * pi / period_s, np.zeros(2), np.zeros(2), 0.0
    for push in np.diff(pin[:, :2], n=2, axis=0) / STEP_S**2:
        pull = omega**2 * (push / GRAVITY_M_S2 * np.cos(angle) + np.sin(angle))
        rate -= STEP_S * (pull + 2.0 * damping * omega * rate)
        angle += STEP_S * rate
        most = max(most, hypot(*angle))
    return hypot(hypot(*angle), hypot(*rate) / omega), most


def figures(profile: Profile, motion: Trajectory, around: CollisionScene, held: HeldLog | None) -> Figures:
    """All of them, looked at every 5 ms, clearances every 20 ms."""
    q, v = sampled(motion)
    a = np.diff(v, axis=0) / STEP_S
    jerk = np.abs(np.diff(np.array(motion.velocity), n=2, axis=0)) / 0.02**2
    specs = [joint(profile, j) for j in JOINTS]
    most = np.array([s.acceleration_limit for s in specs])
    low, high = (np.array([getattr(s, side) for s in specs]) for side in ("lower", "upper"))
    pin = pins(profile, q)
    apart, away = _apart(profile, q[::4], pin[::4], around, held)
    middle = away > LEAVE_M
    return Figures(
        float(np.max(np.abs(2.0 * q - low - high) / (high - low))),
        float(np.max(np.abs(v) / [s.speed_limit for s in specs])),
        float(np.max(np.abs(a) / most)),
        float(np.max(_flow(profile, q, v))) / profile.hydraulics.pump_flow_m3_s,
        float(1.0 / max(np.max(jerk / most), 1e-9)),
        max(swing(pin, period)[0] for period in PERIODS_S),
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
