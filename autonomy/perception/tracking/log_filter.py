"""One log over frames: an information filter of its seven numbers and of the camera's systematic errors.

A log lies still in the frame in which poses are given.  The state is its seven numbers about a fixed line, and the
systematic errors of the camera: scale of depth, rotation and shift of the mount.  Only a moving camera can tell these
errors from the position of the log.  With a camera at rest their prior remains in the covariance, so that a thousand
frames never claim a millimetre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from filterpy.kalman import InformationFilter

from autonomy.perception.camera.frame import Pose
from autonomy.perception.fitting.cylinder import across_view
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list import SIZE, LogEstimate, across

STATES: Final = SIZE + 7  # with the scale of depth, three rotations and three shifts of the mount
MAX_ACROSS_M: Final = 0.25  # between the middles of one log in two pictures, across its axis, beside the uncertainty
MAX_ACROSS_SIGMAS: Final = 3.0
MAX_DISTANCE_M: Final = 3.0  # fits farther apart are of two logs, however uncertain they are
MIN_PARALLEL_COSINE: Final = 0.7
SAME_VIEW_SHARE: Final = 0.1  # a camera that moved by less than this share of the range has the same view
_PLACES: Final = [0, 1, 4, 5]  # of the seven numbers, those that are positions; 2 and 3 are directions
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """Standard deviations of errors: systematic ones of the camera (scale of depth as a share, rotation and shift of
    the mount), and those of the pose in every picture."""

    scale: float = 0.0075
    mount_rad: float = 0.004
    mount_m: float = 0.008
    pose_rad: float = 0.0005
    pose_m: float = 0.002


NOMINAL_ERRORS: Final = CameraErrors()
SURVEYED: Final = CameraErrors(scale=0.0015, mount_rad=0.0015, mount_m=0.004)
"""Errors that remain after the survey of a camera on the crane."""
SURVEYED_BY_GNSS: Final = replace(SURVEYED, pose_rad=0.002, pose_m=0.012)
"""The same on a vehicle that a dual-antenna RTK receiver localizes."""


@dataclass(frozen=True, slots=True)
class Track:
    """A log with its permanent number, the count of pictures that showed it, and the stamp of the last of them."""

    id: int
    estimate: LogEstimate
    hits: int
    last_seen_ns: int


class LogFilter:
    """The filter of one log, about the line on which it was first seen."""

    def __init__(self, number: int, fit: CylinderFit, pose: Pose, errors: CameraErrors, hits: int = 0) -> None:
        self.id, self.hits, self.misses, self.outliers, self._stamp_ns = number, hits, 0, 0, 0
        self._end_hits, self._score, self._errors = [0, 0], 0.0, errors
        self._shared, self._eye_m, self._same_view_count = np.eye(SIZE), pose.position_m, 0
        self._anchor = pose.to_base(fit.body.center_m)
        self._axis = pose.rotation @ fit.body.axis
        self._e1, self._e2 = across(self._axis)
        self._filter = InformationFilter(STATES, SIZE, compute_log_likelihood=False)
        wide = [10.0, 10.0, 3.0, 3.0, 10.0, 10.0, 1.0]
        systematic = [errors.scale, *[errors.mount_rad] * 3, *[errors.mount_m] * 3]
        self._filter.P_inv = np.diag(1.0 / np.square([*wide, *systematic]))
        self._filter.x = np.zeros((STATES, 1))
        self._spread = np.linalg.inv(self._filter.P_inv)

    def _measurement(self, fit: CylinderFit, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the measurement of a fit: seven numbers (7,), their covariance (7, 7), the part of it that pictures
        from the same place have in common (7, 7), and the measurement matrix H (7, STATES)."""
        body = fit.body
        center, axis = pose.to_base(body.center_m), pose.rotation @ body.axis
        along = float(axis @ self._axis)
        sense = 1.0 if along >= 0.0 else -1.0
        half = 0.5 * body.length_m * sense
        start, end = center - half * axis, center + half * axis
        point = center + axis * (float((self._anchor - center) @ self._axis) / along)
        off, tilt = point - self._anchor, axis / along
        z = np.array(
            [
                off @ self._e1,
                off @ self._e2,
                tilt @ self._e1,
                tilt @ self._e2,
                (start - self._anchor) @ self._axis,
                (end - self._anchor) @ self._axis,
                body.radius_m,
            ]
        )
        f1, f2 = (pose.rotation @ f for f in across_view(body.axis, body.point_m))
        turn = np.array([[f1 @ self._e1, f2 @ self._e1], [f1 @ self._e2, f2 @ self._e2]])
        move = float((point - center) @ axis)
        jacobian = np.zeros((SIZE, SIZE))
        jacobian[:2, :2], jacobian[2:4, 2:4] = turn, sense * turn
        jacobian[:2, 2:4] = move * turn
        jacobian[4:6, 4:6] = np.eye(2) if sense > 0.0 else [[0.0, -1.0], [-1.0, 0.0]]
        jacobian[6, 6] = 1.0
        h = self._h(pose, point, start, end, body.radius_m)
        # The error of a pose is independent in every picture; that of the mount is the same in all.
        jitter = h[:, 8:] * np.repeat([self._errors.pose_rad, self._errors.pose_m], 3)
        shared = jacobian * fit.systematic
        return z, jacobian @ fit.covariance @ jacobian.T + jitter @ jitter.T, shared @ shared.T, h

    def _h(self, pose: Pose, point: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
        """Differentiate the seven numbers by the state: by themselves, scale, rotations and shifts of the camera."""
        h = np.zeros((SIZE, STATES))
        h[:, :SIZE] = np.eye(SIZE)
        arms = np.array([point, point, self._axis, self._axis, start, end])
        arms[_PLACES] -= pose.position_m
        ways = np.array([self._e1, self._e2, self._e1, self._e2, self._axis, self._axis])
        turns = arms[:, _NEXT] * ways[:, _LAST] - arms[:, _LAST] * ways[:, _NEXT]  # cross products
        h[:6, 8:11] = turns @ pose.rotation
        h[_PLACES, 7] = (arms[_PLACES] * ways[_PLACES]).sum(axis=1)
        h[_PLACES, 11:14] = ways[_PLACES] @ pose.rotation
        h[6, 7] = radius
        return h

    def distance2(self, fit: CylinderFit, pose: Pose) -> float:
        """Compute the squared Mahalanobis distance of a fit; infinite when the fit is of another log."""
        away = pose.to_base(fit.body.center_m) - self._anchor
        across_m = away - (away @ self._axis) * self._axis
        cosine = abs(float(pose.rotation @ fit.body.axis @ self._axis))
        if cosine < MIN_PARALLEL_COSINE or across_m @ across_m > MAX_DISTANCE_M**2:
            return math.inf
        z, noise, _, h = self._measurement(fit, pose)
        state = self._filter.x[:, 0]
        spread = h @ self._spread @ h.T + noise
        miss = z - h @ state
        if not np.hypot(miss[0], miss[1]) < MAX_ACROSS_M + MAX_ACROSS_SIGMAS * math.sqrt(spread[0, 0] + spread[1, 1]):
            return math.inf
        return float(miss @ np.linalg.solve(spread, miss))

    def update(self, fit: CylinderFit, pose: Pose, stamp_ns: int) -> None:
        """Update the log with a fit."""
        z, noise, shared, h = self._measurement(fit, pose)
        if np.trace(shared) < np.trace(self._shared):
            self._shared = shared
        moved_m = float(np.linalg.norm(pose.position_m - self._eye_m))
        if moved_m > SAME_VIEW_SHARE * float(np.linalg.norm(self._anchor - pose.position_m)):
            self._eye_m, self._same_view_count = pose.position_m, 0
        self._same_view_count += 1
        # Inflate the common part, so that all pictures from one place together say little more about it than one.
        self._filter.H = h
        self._filter.R_inv = np.linalg.inv(noise + (self._same_view_count**2 - 1) * shared)
        self._filter.update(z[:, None])
        self._spread = np.linalg.inv(self._filter.P_inv)
        same = float(pose.rotation @ fit.body.axis @ self._axis) > 0.0
        for i, end_seen in enumerate(fit.ends_seen if same else fit.ends_seen[::-1]):
            self._end_hits[i] += end_seen
        self.hits, self.misses, self._stamp_ns = self.hits + 1, 0, stamp_ns
        self._score += (fit.explained - self._score) / self.hits

    def track(self) -> Track:
        """Return the current estimate of the log."""
        x, covariance = self._filter.x[:SIZE, 0], self._spread[:SIZE, :SIZE]
        axis = self._axis + x[2] * self._e1 + x[3] * self._e2
        stretch = float(np.linalg.norm(axis))
        point = self._anchor + x[0] * self._e1 + x[1] * self._e2
        middle = 0.5 * (x[4] + x[5])
        shift = np.eye(SIZE)
        shift[0, 2] = shift[1, 3] = middle
        covariance = shift @ (covariance + self._shared) @ shift.T
        ends_seen = (self._end_hits[0] > 0, self._end_hits[1] > 0)
        length, diameter = (x[5] - x[4]) * stretch, 2.0 * x[6]
        estimate = LogEstimate(
            point + middle * axis, axis / stretch, float(length), float(diameter), covariance, ends_seen, self._score
        )
        return Track(self.id, estimate, self.hits, self._stamp_ns)
