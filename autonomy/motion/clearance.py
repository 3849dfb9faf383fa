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

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.obstacles import CollisionScene, Ground, HeldLog, ObstacleArrays, SweptCapsules, swept_capsules
from autonomy.motion.time_law import PENDULUM_S
from autonomy.motion.trajectory import Trajectory

# -- Distances between a moving crane and obstacles: swept capsules against boxes, capsules and the ground.
#
# Distances are exact for every sample, negative inside capsules and the ground (0 inside a box), and vectorized;
# the motion of a part between two samples is bounded by its greatest displacement.  Lengths in m.


_SMALL: Final = 1e-12


def segment_segment(p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Compute the distances of segments p0-p1 and q0-q1 (..., 3), exact, also for points and parallels."""
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c = _dot(u, u), _dot(u, v), _dot(v, v)
    d, e = _dot(u, w), _dot(v, w)
    det = a * c - b * b
    s = np.where(det > _SMALL * np.maximum(a * c, _SMALL), (b * e - c * d) / np.maximum(det, _SMALL), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((b * s + e) / np.maximum(c, _SMALL), 0.0, 1.0)
    s = np.clip((b * t - d) / np.maximum(a, _SMALL), 0.0, 1.0)
    t = np.clip((b * s + e) / np.maximum(c, _SMALL), 0.0, 1.0)
    result: np.ndarray = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    return result


def segment_box(p0: np.ndarray, p1: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Compute the distances of segments (..., 3) and boxes of half edges (..., 3) about the origin, exact; 0 inside.

    The squared distance along the segment is convex, and quadratic between the crossings of the faces' planes; the zero
    of its piecewise linear slope is the nearest point.
    """
    direction = p1 - p0
    safe = np.where(np.abs(direction) > _SMALL, direction, 1.0)
    crossings = np.concatenate([(half - p0) / safe, (-half - p0) / safe], axis=-1)
    crossings = np.where(np.concatenate([np.abs(direction) > _SMALL] * 2, axis=-1), crossings, 0.0)
    ends = np.zeros((*crossings.shape[:-1], 1))
    t = np.sort(np.clip(np.concatenate([ends, crossings, ends + 1.0], axis=-1), 0.0, 1.0), axis=-1)

    def out(at: np.ndarray) -> np.ndarray:
        points = p0[..., None, :] + at[..., None] * direction[..., None, :]
        result: np.ndarray = points - np.clip(points, -half[..., None, :], half[..., None, :])
        return result

    slope = np.sum(out(t) * direction[..., None, :], axis=-1)
    k = np.clip(np.sum(slope < 0.0, axis=-1), 1, t.shape[-1] - 1)[..., None]
    s0, s1 = np.take_along_axis(slope, k - 1, -1), np.take_along_axis(slope, k, -1)
    t0, t1 = np.take_along_axis(t, k - 1, -1), np.take_along_axis(t, k, -1)
    rise = s1 - s0
    best = np.where(s0 >= 0.0, t0, np.where(s1 <= 0.0, t1, t0 - s0 * (t1 - t0) / np.where(rise > _SMALL, rise, 1.0)))
    result: np.ndarray = np.linalg.norm(out(best)[..., 0, :], axis=-1)
    return result


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.einsum("...i,...i->...", a, b)
    return result


def clearances(scene: CollisionScene, body: SweptCapsules, near_m: float = np.inf) -> np.ndarray:
    """Compute distances (n, m, k) of m parts at n samples from ground, boxes and capsules (`CollisionScene.names`).

    Beyond ``near_m`` a value may be less than the distance, but not less than ``near_m``.
    """
    return obstacle_distances(scene.arrays, body, np.array(near_m))


def obstacle_distances(things: ObstacleArrays, body: SweptCapsules, near_m: np.ndarray) -> np.ndarray:
    """Compute the same for obstacles as arrays; ``near_m`` broadcasts to (n, m, 1)."""
    limit = near_m + body.radius[:, None]
    middle, half_axis = (body.a + body.b) / 2, (body.b - body.a) / 2
    columns = [_height_above_ground(things.ground, body.a, body.b)]
    # Axis by axis, a part and an obstacle are at least as far apart as their bounding boxes.
    x, y, z = (middle[..., i, None] - things.center[:, i] for i in range(3))
    cos_, sin_ = things.turn.T
    x, y = cos_ * x + sin_ * y, cos_ * y - sin_ * x
    wx, wy, wz = (half_axis[..., i, None] for i in range(3))
    wx, wy = cos_ * wx + sin_ * wy, cos_ * wy - sin_ * wx
    hx, hy, hz = things.half.T
    far = _gap_length(np.abs(x) - np.abs(wx) - hx, np.abs(y) - np.abs(wy) - hy, np.abs(z) - np.abs(wz) - hz)
    i, m, k = np.nonzero(far < limit)
    at, to = np.stack([x[i, m, k], y[i, m, k], z[i, m, k]], -1), np.stack([wx[i, m, k], wy[i, m, k], wz[i, m, 0]], -1)
    far[i, m, k] = segment_box(at - to, at + to, things.half[k])
    columns.append(far)
    far = _gap_length(
        *(
            np.abs(middle[..., i, None] - things.middle[:, i])
            - np.abs(half_axis[..., i, None])
            - np.abs(things.along[:, i])
            for i in range(3)
        )
    )
    far -= things.radius
    i, m, k = np.nonzero(far < limit)
    begin, end = things.middle[k] - things.along[k], things.middle[k] + things.along[k]
    far[i, m, k] = segment_segment(body.a[i, m], body.b[i, m], begin, end) - things.radius[k]
    columns.append(far)
    result: np.ndarray = np.concatenate(columns, axis=2) - body.radius[:, None]
    return result


def _gap_length(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Compute the length of a gap (n, m, k) from its components along the axes; negative components count as 0."""
    x, y, z = np.maximum(x, 0.0), np.maximum(y, 0.0), np.maximum(z, 0.0)
    result: np.ndarray = np.sqrt(x * x + y * y + z * z)
    return result


def _height_above_ground(ground: Ground, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the least height of both ends and the middle above the ground, (n, m, 1)."""
    heights = []
    for share in (0.0, 0.5, 1.0):
        p = a + share * (b - a)
        heights.append(p[..., 2] - (ground(p[..., 0], p[..., 1]) if callable(ground) else ground))
    result: np.ndarray = np.min(np.stack(heights, axis=-1), axis=-1)[..., None]
    return result


def motion_between_samples(body: SweptCapsules) -> np.ndarray:
    """Compute by how much a part may be nearer between two samples than at either, (n, m): half of its displacement."""
    move = np.maximum(np.linalg.norm(np.diff(body.a, axis=0), axis=2), np.linalg.norm(np.diff(body.b, axis=0), axis=2))
    nothing = np.zeros((1, move.shape[1]))
    result: np.ndarray = 0.5 * np.maximum(np.concatenate([nothing, move]), np.concatenate([move, nothing]))
    return result


def least_clearance(scene: CollisionScene, body: SweptCapsules) -> tuple[float, str, str, int]:
    """Find the least clearance [m], the part, the obstacle, and the sample."""
    apart = clearances(scene, body)
    i, m, k = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return float(apart[i, m, k]), body.names[m], scene.names[k], int(i)


# -- Clearance of a motion from all obstacles, with the swing of the grapple that the motion causes


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
    """Compute the least clearance of a motion beyond what is required [m], negative where it is too near, and a
    sentence about it."""
    time_s = np.linspace(0.0, motion.duration_s, SAMPLE_COUNT)
    q = np.array([motion.at(t)[0] for t in time_s])
    pin = pin_positions(arm, np.array([arm.pose(row) for row in q.tolist()]))
    reserve_m, why, _ = evaluate_clearance(arm, q, pin, scene, held, time_s[1])
    return reserve_m, why


def pin_positions(arm: Arm, poses: np.ndarray) -> np.ndarray:
    """Compute true pin positions (n, 3) of poses (n, 5)."""
    theta = poses[:, 0] + arm.profile.kinematics.theta1_offset_rad
    return np.column_stack([poses[:, 1] * np.cos(theta), poses[:, 1] * np.sin(theta), poses[:, 2]])


def _predicted_swing(pin: np.ndarray, step_s: float) -> np.ndarray:
    """Predict the lean of the hanging grapple [rad] under a pin (n, 3) sampled every ``step_s``, (pendulums, n, 2)."""
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
    """Find the least clearance beyond what is required [m] (negative: too near), a sentence about it, and the sample.

    ``step_s``: time between samples; None before the time law is known, with room for an assumed swing.  Where the
    clearance suffices, the value may be less than the true one.
    """
    body = swept_capsules(arm.profile, q, pin, held)
    deep = body.depth(body.b)
    depth, n = float(np.max(deep)), len(pin)
    away = [np.linalg.norm(pin - pin[i], axis=1) for i in (0, -1)]
    room_factor = np.clip(2.0 * (np.minimum(*away) / DEPARTURE_ZONE_M - 1.0), 0.0, 1.0)
    room = motion_between_samples(body)
    if step_s is None:
        room = room + np.where(body.hangs, ASSUMED_SWING_RAD * np.max(deep[..., 0], axis=0), 0.0)
    room = room * room_factor[:, None]
    low, high = np.min(np.minimum(body.a, body.b), axis=(0, 1)), np.max(np.maximum(body.a, body.b), axis=(0, 1))
    things = scene.arrays.near(low - BROAD_PHASE_M, high + BROAD_PHASE_M)
    # All samples with every lean and with none (a grapple that swings less than predicted must not need its swing to
    # come past a stake), and both ends as they stand, at once.
    leans = [] if step_s is None else [body.shifted(lean * depth, depth) for lean in _predicted_swing(pin, step_s)]
    bodies = [*leans, body, body.rows([0, -1])]
    whole = replace(body, a=np.concatenate([b.a for b in bodies]), b=np.concatenate([b.b for b in bodies]))
    times = len(bodies) - 1
    near = np.concatenate([np.tile(room, (times, 1)), np.zeros((2, room.shape[1]))]) + MARGIN_M + CONTACT_ALLOWANCE_M
    distances_m = obstacle_distances(things, whole, near[:, :, None])
    spare_m = distances_m[:-2].reshape(times, n, *distances_m.shape[1:]) - _required_clearance(
        distances_m[-2:], away, room
    )
    _, i, m, k = np.unravel_index(int(np.argmin(spare_m)), spare_m.shape)
    x, y, z = pin[i]
    why = f"the {body.names[m]} would come too near to {things.names[k]} at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    return float(spare_m.min()), why, int(i)


def _required_clearance(ends: np.ndarray, away: list[np.ndarray], room: np.ndarray) -> np.ndarray:
    """Compute the required clearance (n, m, k) from that at both ends (2, m, k) and the samples' distances from them.

    It is the margin, or near an end the clearance at that end: a part may leave an obstacle at which it stands.
    """
    need = np.full((len(room), *ends.shape[1:]), MARGIN_M)
    for end_clearance_m, end_distance_m in zip(ends - CONTACT_ALLOWANCE_M, away, strict=True):
        close = end_distance_m < DEPARTURE_ZONE_M
        need[close] = np.minimum(need[close], end_clearance_m)
    result: np.ndarray = need + room[:, :, None]
    return result
