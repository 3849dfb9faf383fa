"""Movement primitives of one machine between bunk and log, and Algorithm 1 of paper B.

A primitive moves the pin in the crane's plane: slew, distance, height and telescope.  There a quasi-parabola over the
stakes keeps its shape whatever the goal; only the slew is scaled, so that the other side is the mirror image
(`autonomy.motion.dmp`).  ``out`` leads from the bunk to a log, ``back`` from it to the bunk; where only one was
demonstrated, the other is its reverse (paper B 3.2.5).  The rotator turns along with the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from autonomy.motion.arm import Arm
from autonomy.motion.demonstration import JointTrack, joint_vectors
from autonomy.motion.dmp import BASIS_COUNT, Dmp, learn
from autonomy.motion.pose import Pose
from autonomy.motion.trajectory import STEP_S, Trajectory, smooth_progress, within_limits
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.kinematics import Unreachable, reachable_extensions
from machine.profile import Bunk, Profile
from runtime.errors import InputRefused

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
        """The primitive as equations."""
        return Dmp(self.duration_s, np.array(self.weights), _SCALED_AXES)


class Primitives(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The primitives of one machine: out to a log and back to the bunk."""

    schema: int
    profile: str
    out: Primitive
    back: Primitive


def pose_track(arm: Arm, motion: JointTrack) -> np.ndarray:
    """A demonstration in the crane's plane: slew, r, z, ext (n, 4)."""
    return np.array([arm.pose(q)[:4] for q in joint_vectors(motion)])


def is_near_bunk(bunk: Bunk, xy: Sequence[float]) -> bool:
    """Whether a point is over the bunk or next to it."""
    x, y = xy[0] - bunk.center_m[0], xy[1] - bunk.center_m[1]
    c, s = np.cos(bunk.yaw_rad), np.sin(bunk.yaw_rad)
    along, across = x * c + y * s, y * c - x * s
    return bool(abs(along) < bunk.length_m / 2 + BUNK_MARGIN_M and abs(across) < bunk.width_m / 2 + BUNK_MARGIN_M)


def split_by_direction(arm: Arm, motions: Sequence[JointTrack]) -> tuple[list[JointTrack], list[JointTrack]]:
    """Motions out of the bunk, and into it; others are left out."""
    out: list[JointTrack] = []
    back: list[JointTrack] = []
    for motion in motions:
        q = joint_vectors(motion)
        begins, ends = (is_near_bunk(arm.profile.bunk, arm.xy(arm.pose(q[i]))) for i in (0, -1))
        if begins != ends:
            (back if ends else out).append(motion)
    return out, back


def learn_primitives(profile: Profile, motions: Sequence[JointTrack], bases: int = BASIS_COUNT) -> Primitives:
    """Primitives from demonstrations of the machine.

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
    for mine, other in ((0, 1), (1, 0)):
        if not shown[mine]:
            shown[mine] = [(t, poses[::-1]) for t, poses in shown[other]]
    counts = len(out), len(back)
    made = [learn(group, _SCALED_AXES, bases) for group in shown]
    packed = [Primitive(d.duration_s, n, d.weights.tolist()) for d, n in zip(made, counts, strict=True)]
    return Primitives(SCHEMA, profile.name, *packed)


def encode(primitives: Primitives) -> bytes:
    """The file of primitives, weights to seven digits."""

    def short(p: Primitive) -> Primitive:
        rows = [[float(f"{w:.7g}") for w in row] for row in p.weights]
        return msgspec.structs.replace(p, duration_s=round(p.duration_s, 3), weights=rows)

    primitives = msgspec.structs.replace(primitives, out=short(primitives.out), back=short(primitives.back))
    return msgspec.json.encode(primitives) + b"\n"


def load(profile: Profile, path: Path | None = None) -> Primitives:
    """The primitives in a file, by default those shipped for the machine.

    Raises:
        InputRefused: the file cannot be read or is not for this machine.
    """
    path = path or SHIPPED_FOLDER / f"{profile.name}.json"
    hint = "learn some with `timberhand plan learn LOG --out FILE`"
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Primitives)
    except OSError as error:
        raise InputRefused("primitives.unreadable", f"{path} cannot be read ({error.strerror}); {hint}") from None
    except msgspec.MsgspecError as error:
        raise InputRefused("primitives.malformed", f"{path} is no file of primitives ({error}); {hint}") from None
    if found.schema != SCHEMA or found.profile != profile.name:
        raise InputRefused(
            "primitives.other-machine",
            f"{path} is for {found.profile}, schema {found.schema}, not for {profile.name}, schema {SCHEMA}; {hint}",
        )
    for primitive in (found.out, found.back):
        rows = primitive.weights
        good = len(rows) == len(_SCALED_AXES) and len({len(row) for row in rows}) == 1 and len(rows[0]) >= 2
        if not good or not 0.5 < primitive.duration_s < 120.0 or not np.all(np.isfinite(primitive.weights)):
            raise InputRefused(
                "primitives.implausible", f"{path} holds a primitive with implausible weights or duration; {hint}"
            )
    return found


class PrimitiveMotions:
    """Motions by primitives, with the signature of `autonomy.motion.trajectory.travel_over`.

    The requested heights are ignored: the demonstrations contain the path over the stakes.
    """

    def __init__(self, primitives: Primitives) -> None:
        self._out, self._back = primitives.out.dmp(), primitives.back.dmp()

    def __call__(self, arm: Arm, start: Pose, goal: Pose, height_m: float = 0.0, free_m: float = 0.0) -> Trajectory:
        """The back primitive where the goal is at the bunk, otherwise the out primitive.

        Raises:
            machine.geometry.kinematics.Unreachable: the motion would leave the crane's reach.
        """
        dmp = self._back if is_near_bunk(arm.profile.bunk, arm.xy(goal)) else self._out
        return primitive_motion(arm, dmp, start, goal)


def primitive_motion(arm: Arm, dmp: Dmp, start: Pose, goal: Pose) -> Trajectory:
    """The motion of a primitive from rest to rest, slowed down to the arm's limits; raises ``Unreachable``."""
    path = dmp.rollout(np.array(start[:4]), np.array(goal[:4]))

    def sampled(duration_s: float) -> np.ndarray:
        time_s = np.linspace(0.0, duration_s, max(2, int(np.ceil(duration_s / STEP_S)) + 1))
        turned = start.rot_rad + smooth_progress(time_s / duration_s) * (goal.rot_rad - start.rot_rad)
        return _joints(arm, np.column_stack([path.at(time_s, duration_s), turned]))

    return within_limits(arm, sampled, path.duration_s)


def _joints(arm: Arm, poses: np.ndarray) -> np.ndarray:
    """Joints of poses; where the arm is too short or too long for a pose, its telescope gives way smoothly."""
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
    wanted = np.clip(ext, low + room, high - room) - ext
    wanted[0] = wanted[-1] = 0.0
    # A bump wide enough for every sample, at rest at both ends.
    share = coarse / coarse[-1]
    bump = np.maximum(np.sin(np.pi * share) ** 2, 1e-3)
    shape = np.zeros(len(coarse))
    for i in np.flatnonzero(np.abs(wanted) > 0.0).tolist():
        there = wanted[i] * np.minimum(bump / bump[i], 1.0)
        shape = np.where(np.abs(there) > np.abs(shape), there, shape)
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
    """Paper B's Algorithm 1: from the bunk towards the log while the grapple opens, then it closes (lines 2 to 5);
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
