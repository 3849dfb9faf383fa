"""Movement primitives of one machine between bunk and log, and Algorithm 1 of paper B.

A primitive moves the pin in the crane's plane: slew, distance, height and telescope.  There a quasi-parabola over the
stakes keeps its shape whatever the goal; only the slew is scaled, so that the other side is the mirror image
(`Dmp`).  ``out`` leads from the bunk to a log, ``back`` from it to the bunk; where only one was
demonstrated, the other is its reverse (paper B 3.2.5).  The rotator turns along with the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.demonstration import JointTrack, joint_vectors
from autonomy.motion.trajectory import STEP_S, Trajectory, smooth_progress, within_limits
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.kinematics import Unreachable, reachable_extensions
from machine.profile import Bunk, Profile
from runtime.errors import InputRefused

# -- Dynamic movement primitives: a point-to-point motion learned from demonstrations, replayed to any goal.
#
# Ijspeert 2013 with the goal term of Pastor 2009 (docs/reference/machines.md section 6; paper B 3.2.5), per
# coordinate y and share of time:
#
#     tau z' = alpha (beta (g - y) - z) + alpha beta (F(x) - (g - y0) x),   tau y' = z,   tau x' = -alpha_x x
#     F(x) = x sum psi_i w_i / sum psi_i,   psi_i = exp(-h_i (x - c_i)^2)
#
# The classic form multiplies F by (g - y0): it diverges where a demonstration ends where it began, and turns a lift
# into a dip where the sign changes.  Here F is added as demonstrated, whatever the goal.  Only for a ``scaled``
# coordinate is F a share of its travel, because it should mirror: a slew to the other side.  Such a coordinate is
# learned only from demonstrations that move it.  The weights come from locally weighted regression over all
# demonstrations together.
#
# The equations are linear with constant coefficients, so a rollout is exact except for F between its points.  Numpy
# only, no clock.

ALPHA: Final = 25.0
BETA: Final = ALPHA / 4.0
ALPHA_X: Final = -float(np.log(0.01))
"""The phase x falls to 0.01 over the duration."""
BASIS_COUNT: Final = 40
BASIS_OVERLAP: Final = 0.2
"""Value of a basis function at the centre of the next."""
CORRECTION_SHARE: Final = 0.4
"""Last share of the duration, in which the residual of the phase is corrected: some percent of the goal's change."""
_STEP_COUNT: Final = 400
_MIN_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Dmp:
    """A primitive of D coordinates: duration [s] of the demonstrations, weights (D, n), which coordinates are
    scaled."""

    duration_s: float
    weights: np.ndarray
    scaled: tuple[bool, ...]

    def rollout(self, start: np.ndarray, goal: np.ndarray) -> Rollout:
        """Compute the motion from rest at ``start`` (D,) to rest at ``goal`` (D,).

        Raises:
            InputRefused: a number is not finite, or the number of coordinates differs.
        """
        start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
        if start.shape != (len(self.weights),) or goal.shape != start.shape:
            raise InputRefused(
                "primitive.wrong-shape",
                f"a primitive of {len(self.weights)} coordinates got {start.shape} and {goal.shape}",
            )
        if not (np.all(np.isfinite(start)) and np.all(np.isfinite(goal))):
            raise InputRefused("primitive.not-finite", "start and goal of a primitive must be finite numbers")
        path = goal - start
        share = np.arange(_STEP_COUNT + 1) / _STEP_COUNT
        x = np.exp(-ALPHA_X * share)
        force = _design(x, self.weights.shape[1]) @ self.weights.T * np.where(self.scaled, path, 1.0)
        y = start + _filtered(path - path * x[:, None] + force)
        return Rollout(share * self.duration_s, _ending_at_goal(y, goal))


@dataclass(frozen=True, slots=True)
class Rollout:
    """A motion at rest at both ends: times (n,) [s] from 0 and positions (n, D)."""

    time_s: np.ndarray
    position: np.ndarray

    @property
    def duration_s(self) -> float:
        """Time of the last point."""
        return float(self.time_s[-1])

    def at(self, time_s: np.ndarray, duration_s: float | None = None) -> np.ndarray:
        """Interpolate positions (m, D) at times (m,), cubics between points; ``duration_s`` slows it down to that."""
        span = self.duration_s
        t = np.clip(np.asarray(time_s, dtype=float) * (span / (duration_s or span)), 0.0, span)
        step = self.time_s[1]
        i = np.minimum((t / step).astype(int), len(self.time_s) - 2)
        s = (t / step - i)[:, None]
        slope = np.gradient(self.position, axis=0)
        slope[0] = slope[-1] = 0.0
        p0, p1, m0, m1 = self.position[i], self.position[i + 1], slope[i], slope[i + 1]
        c2, c3 = 3.0 * (p1 - p0) - 2.0 * m0 - m1, m0 + m1 - 2.0 * (p1 - p0)
        result: np.ndarray = p0 + s * (m0 + s * (c2 + s * c3))
        return result


def learn(
    demonstrations: Sequence[tuple[np.ndarray, np.ndarray]],
    scaled: Sequence[bool] | None = None,
    bases: int = BASIS_COUNT,
    least_way: float = 0.2,
) -> Dmp:
    """Learn a primitive from demonstrations (times (n,) [s], positions (n, D)), each from rest to rest.

    ``scaled`` coordinates learn only from demonstrations that move them by at least ``least_way``; by default none is
    scaled.  The duration is the mean of the demonstrations'.

    Raises:
        InputRefused: there is nothing to learn from.
    """
    if not demonstrations:
        raise InputRefused("demonstration.none", "there is no demonstration to learn from")
    if bases < 2:
        raise InputRefused("demonstration.too-few-bases", f"a primitive needs at least 2 basis functions, not {bases}")
    count = np.asarray(demonstrations[0][1]).shape[-1]
    flags = tuple(scaled) if scaled is not None else (False,) * count
    above, below, spans = np.zeros((count, bases)), np.zeros((count, bases)), []
    for number, (time_s, position) in enumerate(demonstrations, 1):
        share, y, span = _normalized(number, time_s, position, count)
        spans.append(span)
        x = np.exp(-ALPHA_X * share)
        velocity = np.gradient(y, share, axis=0)
        acceleration = np.gradient(velocity, share, axis=0)
        path = y[-1] - y[0]
        target_forcing = (acceleration + ALPHA * velocity) / (ALPHA * BETA) - (y[-1] - y) + path * x[:, None]
        size = np.where(flags, path, 1.0)
        use = ~np.array(flags) | (np.abs(path) >= least_way)
        target_forcing = target_forcing / np.where(use, size, 1.0)
        psi = _activations(x, bases)
        # demonstrations have equal weight, however many samples they have
        above += np.where(use[:, None], (target_forcing * x[:, None]).T @ psi, 0.0) / len(x)
        below += np.where(use[:, None], np.sum(psi * (x**2)[:, None], axis=0), 0.0) / len(x)
    if np.any(below <= 0.0):
        j = int(np.argmax(np.any(below <= 0.0, axis=1)))
        raise InputRefused(
            "demonstration.coordinate-unmoved",
            f"no demonstration moves coordinate {j} by {least_way:g}; add one that does",
        )
    return Dmp(float(np.mean(spans)), above / below, flags)


def _ending_at_goal(y: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the same motion (n, D) ending at rest at the goal, corrected by a polynomial over its last part."""
    last = int(CORRECTION_SHARE * _STEP_COUNT)
    h = 1.0 / last
    tail = y[-3:]
    speed, bend = (tail[2] - tail[1]) / h, (tail[2] - 2.0 * tail[1] + tail[0]) / h**2
    goal_error = goal - y[-1]
    # Position, speed and acceleration of the correction are 0 at its beginning and the residuals at its end.
    a, b, c = np.linalg.solve(
        [[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]], np.stack([goal_error, -speed, -bend])
    )
    t = np.linspace(0.0, 1.0, last + 1)[:, None]
    out = y.copy()
    out[-last - 1 :] += t**3 * (a + t * (b + t * c))
    return out


def _normalized(
    number: int, time_s: np.ndarray, position: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, float]:
    t, y = np.asarray(time_s, dtype=float), np.asarray(position, dtype=float)
    if y.ndim != 2 or t.shape != y.shape[:1] or y.shape[1] != count:
        raise InputRefused(
            "demonstration.wrong-shape", f"demonstration {number} has {t.shape} times and {y.shape} positions"
        )
    if len(t) < _MIN_SAMPLES:
        raise InputRefused(
            "demonstration.too-few-samples",
            f"demonstration {number} has {len(t)} samples; at least {_MIN_SAMPLES} are needed",
        )
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(y))):
        raise InputRefused("demonstration.not-finite", f"demonstration {number} holds a number that is not finite")
    if np.any(np.diff(t) <= 0.0):
        raise InputRefused(
            "demonstration.times-not-increasing", f"demonstration {number} has times that do not increase"
        )
    span = float(t[-1] - t[0])
    return (t - t[0]) / span, y, span


def _centres(bases: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute centres in the phase, evenly in time, and widths that overlap by `BASIS_OVERLAP`."""
    centres = np.exp(-ALPHA_X * np.linspace(0.0, 1.0, bases))
    gaps = np.diff(centres)
    return centres, -np.log(BASIS_OVERLAP) / np.append(gaps, gaps[-1]) ** 2


def _activations(x: np.ndarray, bases: int) -> np.ndarray:
    """Compute psi (n, bases), each row summing to 1."""
    centres, widths = _centres(bases)
    psi = np.exp(-widths * (np.maximum(x, centres[-1])[:, None] - centres) ** 2)
    result: np.ndarray = psi / np.sum(psi, axis=1, keepdims=True)
    return result


def _design(x: np.ndarray, bases: int) -> np.ndarray:
    """Compute the matrix of F(x) = _design(x) @ w."""
    result: np.ndarray = x[:, None] * _activations(x, bases)
    return result


def _filtered(pull: np.ndarray) -> np.ndarray:
    """Solve y'' + alpha y' + alpha beta y = alpha beta pull from rest at 0, for pull (n, D) every 1 / `_STEP_COUNT`,
    linear between: exact, as alpha = 4 beta makes the double pole p = -alpha / 2.
    """
    h, p = 1.0 / _STEP_COUNT, -ALPHA / 2.0
    e = np.exp(p * h)
    free = e * np.array([[1.0 - p * h, h], [-p * p * h, 1.0 + p * h]])
    # With y - pull as the state, a linear pull has the particular solution pull - slope * alpha / (alpha beta).
    y, out, lag = np.zeros((2, pull.shape[1])), np.zeros_like(pull), ALPHA / (ALPHA * BETA)
    slopes = np.diff(pull, axis=0) / h
    for k, slope in enumerate(slopes):
        steady = np.stack([pull[k] - lag * slope, slope])
        y = steady + free @ (y - steady)
        y[0] += slope * h
        out[k + 1] = y[0]
    return out


SCHEMA: Final = 1
BUNK_MARGIN_M: Final = 0.4
"""A motion that ends within this distance of the bunk's sides ends at the bunk."""
SHIPPED_FOLDER: Final = Path(__file__).parent / "demonstration_data"
_SCALED_AXES: Final = (True, False, False, False)
_LIMIT_RESERVE_M: Final = 0.08
"""Distance from its limits of a telescope that gives way to a height or a distance."""


class Primitive(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A `Dmp` of (slew, r, z, ext) and the number of demonstrations behind it."""

    duration_s: float
    demonstrations: int
    weights: list[list[float]]

    def dmp(self) -> Dmp:
        """Return the primitive as equations."""
        return Dmp(self.duration_s, np.array(self.weights), _SCALED_AXES)


class Primitives(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The primitives of one machine: out to a log and back to the bunk."""

    schema: int
    profile: str
    out: Primitive
    back: Primitive


def pose_track(arm: Arm, motion: JointTrack) -> np.ndarray:
    """Convert a demonstration to the crane's plane: slew, r, z, ext (n, 4)."""
    return np.array([arm.pose(q)[:4] for q in joint_vectors(motion)])


def is_near_bunk(bunk: Bunk, xy: Sequence[float]) -> bool:
    """Tell whether a point is over the bunk or next to it."""
    x, y = xy[0] - bunk.center_m[0], xy[1] - bunk.center_m[1]
    c, s = np.cos(bunk.yaw_rad), np.sin(bunk.yaw_rad)
    along, across = x * c + y * s, y * c - x * s
    return bool(abs(along) < bunk.length_m / 2 + BUNK_MARGIN_M and abs(across) < bunk.width_m / 2 + BUNK_MARGIN_M)


def split_by_direction(arm: Arm, motions: Sequence[JointTrack]) -> tuple[list[JointTrack], list[JointTrack]]:
    """Select the motions out of the bunk, and those into it; others are left out."""
    out: list[JointTrack] = []
    back: list[JointTrack] = []
    for motion in motions:
        q = joint_vectors(motion)
        begins, ends = (is_near_bunk(arm.profile.bunk, arm.xy(arm.pose(q[i]))) for i in (0, -1))
        if begins != ends:
            (back if ends else out).append(motion)
    return out, back


def learn_primitives(profile: Profile, motions: Sequence[JointTrack], bases: int = BASIS_COUNT) -> Primitives:
    """Learn primitives from demonstrations of the machine.

    Raises:
        InputRefused: none of them leads between the bunk and another place.
    """
    arm = Arm(profile)
    out, back = split_by_direction(arm, motions)
    if not out and not back:
        raise InputRefused(
            "demonstration.not-at-bunk",
            f"none of the {len(motions)} motions leads between the bunk and another place; "
            "demonstrate some from the bunk to a log and back",
        )
    shown = [[(m.time_s, pose_track(arm, m)) for m in group] for group in (out, back)]
    for direction_index, opposite_index in ((0, 1), (1, 0)):
        if not shown[direction_index]:
            shown[direction_index] = [(t, poses[::-1]) for t, poses in shown[opposite_index]]
    counts = len(out), len(back)
    made = [learn(group, _SCALED_AXES, bases) for group in shown]
    packed = [Primitive(d.duration_s, n, d.weights.tolist()) for d, n in zip(made, counts, strict=True)]
    return Primitives(SCHEMA, profile.name, *packed)


def encode(primitives: Primitives) -> bytes:
    """Encode the file of primitives, weights to seven digits."""

    def short(p: Primitive) -> Primitive:
        rows = [[float(f"{w:.7g}") for w in row] for row in p.weights]
        return msgspec.structs.replace(p, duration_s=round(p.duration_s, 3), weights=rows)

    primitives = msgspec.structs.replace(primitives, out=short(primitives.out), back=short(primitives.back))
    return msgspec.json.encode(primitives) + b"\n"


def load(profile: Profile, path: Path | None = None) -> Primitives:
    """Load the primitives in a file, by default those shipped for the machine.

    Raises:
        InputRefused: the file cannot be read or is not for this machine.
    """
    path = path or SHIPPED_FOLDER / f"{profile.name}.json"
    hint = "learn some with `timberhand plan learn LOG --out FILE`"
    try:
        primitives = msgspec.json.decode(path.read_bytes(), type=Primitives)
    except OSError as error:
        raise InputRefused("primitives.unreadable", f"{path} cannot be read ({error.strerror}); {hint}") from None
    except msgspec.MsgspecError as error:
        raise InputRefused("primitives.malformed", f"{path} is no file of primitives ({error}); {hint}") from None
    if primitives.schema != SCHEMA or primitives.profile != profile.name:
        raise InputRefused(
            "primitives.other-machine",
            f"{path} is for {primitives.profile}, schema {primitives.schema}, not for {profile.name}, schema {SCHEMA}; "
            f"{hint}",
        )
    for primitive in (primitives.out, primitives.back):
        rows = primitive.weights
        good = len(rows) == len(_SCALED_AXES) and len({len(row) for row in rows}) == 1 and len(rows[0]) >= 2
        if not good or not 0.5 < primitive.duration_s < 120.0 or not np.all(np.isfinite(primitive.weights)):
            raise InputRefused(
                "primitives.implausible", f"{path} holds a primitive with implausible weights or duration; {hint}"
            )
    return primitives


class PrimitiveMotions:
    """Motions by primitives, with the signature of `autonomy.motion.trajectory.travel_over`.

    The requested heights are ignored: the demonstrations contain the path over the stakes.
    """

    def __init__(self, primitives: Primitives) -> None:
        self._out, self._back = primitives.out.dmp(), primitives.back.dmp()

    def __call__(self, arm: Arm, start: Pose, goal: Pose, height_m: float = 0.0, free_m: float = 0.0) -> Trajectory:
        """Plan the back primitive where the goal is at the bunk, otherwise the out primitive.

        Raises:
            machine.geometry.kinematics.Unreachable: the motion would leave the crane's reach.
        """
        dmp = self._back if is_near_bunk(arm.profile.bunk, arm.xy(goal)) else self._out
        return primitive_motion(arm, dmp, start, goal)


def primitive_motion(arm: Arm, dmp: Dmp, start: Pose, goal: Pose) -> Trajectory:
    """Plan a primitive's motion from rest to rest, slowed to the arm's limits; raise ``Unreachable`` out of reach."""
    path = dmp.rollout(np.array(start[:4]), np.array(goal[:4]))

    def sampled(duration_s: float) -> np.ndarray:
        time_s = np.linspace(0.0, duration_s, max(2, int(np.ceil(duration_s / STEP_S)) + 1))
        turned = start.rot_rad + smooth_progress(time_s / duration_s) * (goal.rot_rad - start.rot_rad)
        return _joints(arm, np.column_stack([path.at(time_s, duration_s), turned]))

    return within_limits(arm, sampled, path.duration_s)


def _joints(arm: Arm, poses: np.ndarray) -> np.ndarray:
    """Compute joints of poses; where the arm is too short or too long for a pose, its telescope gives way smoothly."""
    try:
        return arm.joints(poses)
    except Unreachable:
        pass
    coarse = np.unique(np.append(np.arange(0, len(poses), 10), len(poses) - 1))
    low, high = np.empty(len(coarse)), np.empty(len(coarse))
    for i, pose in enumerate(map(Pose._make, poses[coarse].tolist())):
        spans = reachable_extensions(arm.profile, *arm.xy(pose), pose.z_m)
        if not spans:
            arm.joints(poses[coarse[i] : coarse[i] + 1])  # raises with the reason
            raise Unreachable(
                f"the primitive leaves the crane's reach at a height of {pose.z_m:.2f} m",
                "motion.primitive-out-of-reach",
            )
        low[i], high[i] = min(spans, key=lambda s: max(s[0] - pose.ext_m, pose.ext_m - s[1], 0.0))
    room = np.minimum(_LIMIT_RESERVE_M, (high - low) / 2)
    ext = poses[coarse, 3]
    extension_change_m = np.clip(ext, low + room, high - room) - ext
    extension_change_m[0] = extension_change_m[-1] = 0.0
    # A bump wide enough for every sample, at rest at both ends.
    share = coarse / coarse[-1]
    bump = np.maximum(np.sin(np.pi * share) ** 2, 1e-3)
    shape = np.zeros(len(coarse))
    for i in np.flatnonzero(np.abs(extension_change_m) > 0.0).tolist():
        local_change_m = extension_change_m[i] * np.minimum(bump / bump[i], 1.0)
        shape = np.where(np.abs(local_change_m) > np.abs(shape), local_change_m, shape)
    kernel = np.hanning(9)[1:-1]
    shape = np.convolve(shape, kernel / kernel.sum(), mode="same") * (np.sin(np.pi * share) > 0.0)
    eased = poses.copy()
    eased[:, 3] += np.interp(np.arange(len(poses)), coarse, shape)
    return arm.joints(eased)


@dataclass(frozen=True, slots=True)
class Stage:
    """A step of Algorithm 1: the motion, and the grapple's commands during and after it."""

    motion: Trajectory
    meanwhile: GrappleCommand
    then: GrappleCommand


def algorithm_1(arm: Arm, primitives: Primitives, start: Pose, target: Pose, bunk: Pose) -> tuple[Stage, Stage]:
    """Plan paper B's Algorithm 1: from the bunk towards the log while the grapple opens, then it closes (lines 2 to 5);
    with the log to the bunk, then it opens (lines 6 to 9).

    The second stage begins when the first has reached its target and the grapple is closed (line 7).  Raises
    ``Unreachable``.
    """
    move = PrimitiveMotions(primitives)
    out = primitive_motion(arm, primitives.out.dmp(), start, target)
    return (
        Stage(out, GrappleCommand.OPEN, GrappleCommand.CLOSE),
        Stage(move(arm, target, bunk), GrappleCommand.HOLD, GrappleCommand.OPEN),
    )
