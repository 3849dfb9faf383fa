"""One log over time: an information filter of its seven numbers and of the camera's errors that do not average out.

A log lies still in the frame in which poses are given.  Its state is its seven numbers about a fixed line, and the
camera's errors that stay: scale of depth, turn and shift of the mount.  These are told apart from the log's place only
where the camera moves; standing still their prior remains, so that a thousand frames never claim a millimetre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from filterpy.kalman import InformationFilter

from autonomy.perception.camera.frame import Pose
from autonomy.perception.fitting.cylinder import across_view
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list.estimate import SIZE, LogEstimate, across

STATES: Final = SIZE + 7  # and scale, three turns, three shifts
CLOSE_M: Final = 0.25  # middles of one log in two pictures, across its axis, at most this and what is uncertain
FAR_M: Final = 3.0  # apart by this, they are of two logs whatever is uncertain
SAME_VIEW: Final = 0.1  # a camera that moved by less than this share of the range sees the same
_PLACES: Final = [0, 1, 4, 5]  # of the seven numbers, those that are places; 2 and 3 are directions
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """Standard deviations of what errs: lasting ones of the camera (share of depth, turn and shift of the mount), and
    a pose's own in every picture."""

    scale: float = 0.0075
    mount_rad: float = 0.004
    mount_m: float = 0.008
    pose_rad: float = 0.0005
    pose_m: float = 0.002


NOMINAL_ERRORS: Final = CameraErrors()


@dataclass(frozen=True, slots=True)
class Track:
    """A log with its number, which it keeps; how many pictures it was in, and when last."""

    id: int
    estimate: LogEstimate
    hits: int
    last_seen_ns: int


class LogFilter:
    """One log's filter, about the line on which it was first seen."""

    def __init__(self, number: int, fit: CylinderFit, pose: Pose, errors: CameraErrors, hits: int = 0) -> None:
        self.id, self.hits, self.missed, self.odd, self.stamp_ns = number, hits, 0, 0, 0
        self.ends, self.score, self._errors = [0, 0], 0.0, errors
        self.shared, self.eye_m, self.alike = np.eye(SIZE), pose.position_m, 0
        self.anchor = pose.to_base(fit.body.center_m)
        self.axis = pose.rotation @ fit.body.axis
        self.e1, self.e2 = across(self.axis)
        self._filter = InformationFilter(STATES, SIZE, compute_log_likelihood=False)
        wide = [10.0, 10.0, 3.0, 3.0, 10.0, 10.0, 1.0]
        systematic = [errors.scale, *[errors.mount_rad] * 3, *[errors.mount_m] * 3]
        self._filter.P_inv = np.diag(1.0 / np.square([*wide, *systematic]))
        self._filter.x = np.zeros((STATES, 1))
        self._spread = np.linalg.inv(self._filter.P_inv)

    def measured(self, fit: CylinderFit, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What a fit says about this log: seven numbers (7,), their covariance (7, 7), the part of it that pictures
        alike share, and H (7, STATES)."""
        body = fit.body
        center, axis = pose.to_base(body.center_m), pose.rotation @ body.axis
        along = float(axis @ self.axis)
        sense = 1.0 if along >= 0.0 else -1.0
        half = 0.5 * body.length_m * sense
        start, end = center - half * axis, center + half * axis
        point = center + axis * (float((self.anchor - center) @ self.axis) / along)
        off, tilt = point - self.anchor, axis / along
        z = np.array(
            [
                off @ self.e1, off @ self.e2, tilt @ self.e1, tilt @ self.e2,
                (start - self.anchor) @ self.axis, (end - self.anchor) @ self.axis, body.radius_m,
            ]
        )  # fmt: skip
        f1, f2 = (pose.rotation @ f for f in across_view(body.axis, body.point_m))
        turn = np.array([[f1 @ self.e1, f2 @ self.e1], [f1 @ self.e2, f2 @ self.e2]])
        move = float((point - center) @ axis)
        jacobian = np.zeros((SIZE, SIZE))
        jacobian[:2, :2], jacobian[2:4, 2:4] = turn, sense * turn
        jacobian[:2, 2:4] = move * turn
        jacobian[4:6, 4:6] = np.eye(2) if sense > 0.0 else [[0.0, -1.0], [-1.0, 0.0]]
        jacobian[6, 6] = 1.0
        h = self._h(pose, point, start, end, body.radius_m)
        # A pose errs anew in every picture just as the mount does for good.
        jitter = h[:, 8:] * np.repeat([self._errors.pose_rad, self._errors.pose_m], 3)
        shared = jacobian * fit.systematic
        return z, jacobian @ fit.covariance @ jacobian.T + jitter @ jitter.T, shared @ shared.T, h

    def _h(self, pose: Pose, point: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
        """Derivatives of the seven numbers by the state: by themselves, scale, turns and shifts in the camera."""
        h = np.zeros((SIZE, STATES))
        h[:, :SIZE] = np.eye(SIZE)
        arms = np.array([point, point, self.axis, self.axis, start, end])
        arms[_PLACES] -= pose.position_m
        ways = np.array([self.e1, self.e2, self.e1, self.e2, self.axis, self.axis])
        turns = arms[:, _NEXT] * ways[:, _LAST] - arms[:, _LAST] * ways[:, _NEXT]  # cross products
        h[:6, 8:11] = turns @ pose.rotation
        h[_PLACES, 7] = (arms[_PLACES] * ways[_PLACES]).sum(axis=1)
        h[_PLACES, 11:14] = ways[_PLACES] @ pose.rotation
        h[6, 7] = radius
        return h

    def distance2(self, fit: CylinderFit, pose: Pose) -> float:
        """Squared distance of a fit in standard deviations; infinite when it is elsewhere."""
        away = pose.to_base(fit.body.center_m) - self.anchor
        across_m = away - (away @ self.axis) * self.axis
        if abs(float(pose.rotation @ fit.body.axis @ self.axis)) < 0.7 or across_m @ across_m > FAR_M**2:
            return math.inf
        z, noise, _, h = self.measured(fit, pose)
        state = self._filter.x[:, 0]
        spread = h @ self._spread @ h.T + noise
        miss = z - h @ state
        if not np.hypot(miss[0], miss[1]) < CLOSE_M + 3.0 * math.sqrt(spread[0, 0] + spread[1, 1]):
            return math.inf
        return float(miss @ np.linalg.solve(spread, miss))

    def update(self, fit: CylinderFit, pose: Pose, stamp_ns: int) -> None:
        """Take a fit in."""
        z, noise, shared, h = self.measured(fit, pose)
        if np.trace(shared) < np.trace(self.shared):
            self.shared = shared
        moved_m = float(np.linalg.norm(pose.position_m - self.eye_m))
        if moved_m > SAME_VIEW * float(np.linalg.norm(self.anchor - pose.position_m)):
            self.eye_m, self.alike = pose.position_m, 0
        self.alike += 1
        # So that all pictures from one place together say little more than one about what they have in common.
        self._filter.H, self._filter.R_inv = h, np.linalg.inv(noise + (self.alike**2 - 1) * shared)
        self._filter.update(z[:, None])
        self._spread = np.linalg.inv(self._filter.P_inv)
        same = float(pose.rotation @ fit.body.axis @ self.axis) > 0.0
        for i, seen in enumerate(fit.ends_seen if same else fit.ends_seen[::-1]):
            self.ends[i] += seen
        self.hits, self.missed, self.stamp_ns = self.hits + 1, 0, stamp_ns
        self.score += (fit.explained - self.score) / self.hits

    def track(self) -> Track:
        """The log as it is believed to be."""
        x, covariance = self._filter.x[:SIZE, 0], self._spread[:SIZE, :SIZE]
        axis = self.axis + x[2] * self.e1 + x[3] * self.e2
        stretch = float(np.linalg.norm(axis))
        point = self.anchor + x[0] * self.e1 + x[1] * self.e2
        middle = 0.5 * (x[4] + x[5])
        shift = np.eye(SIZE)
        shift[0, 2] = shift[1, 3] = middle
        covariance = shift @ (covariance + self.shared) @ shift.T
        seen = (self.ends[0] > 0, self.ends[1] > 0)
        length, diameter = (x[5] - x[4]) * stretch, 2.0 * x[6]
        estimate = LogEstimate(
            point + middle * axis, axis / stretch, float(length), float(diameter), covariance, seen, self.score
        )
        return Track(self.id, estimate, self.hits, self.stamp_ns)
