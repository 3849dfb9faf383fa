"""Clearance of a motion from all obstacles, with the swing of the grapple that the motion causes.

Every part keeps a margin; near the ends of a motion it may be as near to an obstacle as it is there, for a grapple goes
into bunks and over logs.  The hanging grapple leans as a pendulum of the shortest and of the longest period would under
this pin.  No clock, no randomness.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from autonomy.motion.arm import Arm
from autonomy.motion.distances import motion_between_samples, obstacle_distances
from autonomy.motion.obstacles import CollisionScene, HeldLog, swept_capsules
from autonomy.motion.time_law import PENDULUM_S
from autonomy.motion.trajectory import Trajectory

MARGIN_M: Final = 0.10
"""Least clearance along the path, beyond the predicted swing; near its ends a part may be as near to an obstacle as it
is there."""
ASSUMED_SWING_RAD: Final = 0.06
"""Lean of the hanging grapple for which a path leaves room before its time law is known."""
DEPARTURE_ZONE_M: Final = 1.2
"""Distance from its ends within which a path may stay as near to obstacles as it is there."""
CONTACT_ALLOWANCE_M: Final = 0.02
"""An obstacle this near at an end may also come this much nearer: it is gripped or lies there."""
SAMPLE_COUNT: Final = 49
BROAD_PHASE_M: Final = 0.8
"""Obstacles farther than this from all that moves are ignored; more than radii, margin and swing together."""
_DAMPING_RATIO: Final = 0.03


def clearance_reserve(
    arm: Arm, motion: Trajectory, scene: CollisionScene, held: HeldLog | None = None
) -> tuple[float, str]:
    """Least clearance of a motion beyond what is required [m], negative where it is too near, and a sentence about
    it."""
    time_s = np.linspace(0.0, motion.duration_s, SAMPLE_COUNT)
    q = np.array([motion.at(t)[0] for t in time_s])
    pin = pin_positions(arm, np.array([arm.pose(row) for row in q.tolist()]))
    found, why, _ = evaluate_clearance(arm, q, pin, scene, held, time_s[1])
    return found, why


def pin_positions(arm: Arm, poses: np.ndarray) -> np.ndarray:
    """True pin positions (n, 3) of poses (n, 5)."""
    theta = poses[:, 0] + arm.profile.kinematics.theta1_offset_rad
    return np.column_stack([poses[:, 1] * np.cos(theta), poses[:, 1] * np.sin(theta), poses[:, 2]])


def _predicted_swing(pin: np.ndarray, step_s: float) -> np.ndarray:
    """Lean of the hanging grapple [rad] under a pin (n, 3) sampled every ``step_s``, (pendulums, n, 2)."""
    fine = np.linspace(0.0, len(pin) - 1.0, (len(pin) - 1) * 4 + 1)
    curve = CubicSpline(np.arange(len(pin)), pin[:, :2], bc_type="clamped")
    push = curve(fine, 2) / step_s**2 / 9.81
    leans = []
    for period in (PENDULUM_S[0], PENDULUM_S[-1]):
        w = 2.0 * pi / period * step_s / 4
        # Semi-implicit steps of lean'' = -w^2 (lean + push) - 2 z w lean'.
        damp = 1.0 - 2.0 * _DAMPING_RATIO * w
        leans.append(lfilter([0.0, -(w**2)], [1.0, -(1.0 + damp - w**2), damp], push, axis=0)[::4])
    return np.stack(leans)


def evaluate_clearance(
    arm: Arm, q: np.ndarray, pin: np.ndarray, scene: CollisionScene, held: HeldLog | None, step_s: float | None
) -> tuple[float, str, int]:
    """Least clearance beyond what is required [m] (negative: too near), a sentence about it, and the sample.

    ``step_s``: time between samples; None before the time law is known, with room for an assumed swing.  Where the
    clearance suffices, the value may be less than the true one.
    """
    body = swept_capsules(arm.profile, q, pin, held)
    deep = body.depth(body.b)
    depth, n = float(np.max(deep)), len(pin)
    away = [np.linalg.norm(pin - pin[i], axis=1) for i in (0, -1)]
    left = np.clip(2.0 * (np.minimum(*away) / DEPARTURE_ZONE_M - 1.0), 0.0, 1.0)
    room = motion_between_samples(body)
    if step_s is None:
        room = room + np.where(body.hangs, ASSUMED_SWING_RAD * np.max(deep[..., 0], axis=0), 0.0)
    room = room * left[:, None]
    low, high = np.min(np.minimum(body.a, body.b), axis=(0, 1)), np.max(np.maximum(body.a, body.b), axis=(0, 1))
    things = scene.arrays.near(low - BROAD_PHASE_M, high + BROAD_PHASE_M)
    # All samples with every lean, and both ends as they stand, at once.
    leans = [] if step_s is None else [body.shifted(lean * depth, depth) for lean in _predicted_swing(pin, step_s)]
    bodies = [*(leans or [body]), body.rows([0, -1])]
    whole = replace(body, a=np.concatenate([b.a for b in bodies]), b=np.concatenate([b.b for b in bodies]))
    times = len(bodies) - 1
    near = np.concatenate([np.tile(room, (times, 1)), np.zeros((2, room.shape[1]))]) + MARGIN_M + CONTACT_ALLOWANCE_M
    found = obstacle_distances(things, whole, near[:, :, None])
    spare_m = found[:-2].reshape(times, n, *found.shape[1:]) - _required_clearance(found[-2:], away, room)
    _, i, m, k = np.unravel_index(int(np.argmin(spare_m)), spare_m.shape)
    x, y, z = pin[i]
    why = f"the {body.names[m]} would come too near to {things.names[k]} at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    return float(spare_m.min()), why, int(i)


def _required_clearance(ends: np.ndarray, away: list[np.ndarray], room: np.ndarray) -> np.ndarray:
    """The required clearance (n, m, k) from that at both ends (2, m, k) and the samples' distances from each end.

    It is the margin, or near an end the clearance at that end: a part may leave an obstacle at which it stands.
    """
    need = np.full((len(room), *ends.shape[1:]), MARGIN_M)
    for here, far in zip(ends - CONTACT_ALLOWANCE_M, away, strict=True):
        close = far < DEPARTURE_ZONE_M
        need[close] = np.minimum(need[close], here)
    result: np.ndarray = need + room[:, :, None]
    return result
