"""Logs over time: an information filter each, identities, and errors that do not average out.

A log lies still in the frame in which poses are given, until a picture shows it elsewhere.  Its state is its seven
numbers about a fixed line, and the camera's errors that stay: scale of depth, turn and shift of the mount.  These are
told apart from the log's place only where the camera moves; standing still their prior remains, so that a thousand
frames never claim a millimetre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from filterpy.kalman import InformationFilter
from scipy.optimize import linear_sum_assignment

from autonomy.perception.cylinder import across_view
from autonomy.perception.estimate import SIZE, LogEstimate, across
from autonomy.perception.frame import Pose
from autonomy.perception.refine import Fit

STATES: Final = SIZE + 7  # and scale, three turns, three shifts
GATE: Final = 24.3  # chi squared of seven numbers, 99.9 %
CLOSE_M: Final = 0.25  # middles of one log in two pictures, across its axis, at most this and what is uncertain
FAR_M: Final = 3.0  # apart by this, they are of two logs whatever is uncertain
CONFIRMED: Final = 2  # pictures after which a log is believed
ODD: Final = 4  # fits in a row beyond the gate after which a log is begun anew
SAME_VIEW: Final = 0.1  # a camera that moved by less than this share of the range sees the same
LOST: Final = 8  # pictures in a row without it after which it is given up
INSIDE, PARALLEL, AS_LONG_M = 0.7, 0.94, 0.25
"""Two logs of a length, their axes nearer than this share of their radii's sum, 20 degrees askew at most, are one."""
BAR: Final = 1e9  # a gap in the table of costs
_PLACES: Final = [0, 1, 4, 5]  # of the seven numbers, those that are places; 2 and 3 are directions
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True, slots=True)
class Errors:
    """Standard deviations of what errs: lasting ones of the camera (share of depth, turn and shift of the mount), and
    a pose's own in every picture."""

    scale: float = 0.0075
    mount_rad: float = 0.004
    mount_m: float = 0.008
    pose_rad: float = 0.0005
    pose_m: float = 0.002


NOMINAL: Final = Errors()


@dataclass(frozen=True, slots=True)
class Track:
    """A log with its number, which it keeps; how many pictures it was in, and when last."""

    id: int
    estimate: LogEstimate
    hits: int
    last_seen_ns: int


class _Log:
    """One log's filter, about the line on which it was first seen."""

    def __init__(self, number: int, fit: Fit, pose: Pose, errors: Errors, hits: int = 0) -> None:
        self.id, self.hits, self.missed, self.odd, self.stamp_ns = number, hits, 0, 0, 0
        self.ends, self.score, self._errors = [0, 0], 0.0, errors
        self.shared, self.eye_m, self.alike = np.eye(SIZE), pose.position_m, 0
        self.anchor = pose.to_base(fit.body.center_m)
        self.axis = pose.rotation @ fit.body.axis
        self.e1, self.e2 = across(self.axis)
        self._filter = InformationFilter(STATES, SIZE, compute_log_likelihood=False)
        wide = [10.0, 10.0, 3.0, 3.0, 10.0, 10.0, 1.0]
        lasting = [errors.scale, *[errors.mount_rad] * 3, *[errors.mount_m] * 3]
        self._filter.P_inv = np.diag(1.0 / np.square([*wide, *lasting]))
        self._filter.x = np.zeros((STATES, 1))
        self._spread = np.linalg.inv(self._filter.P_inv)

    def measured(self, fit: Fit, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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
        shared = jacobian * fit.lasting
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

    def distance2(self, fit: Fit, pose: Pose) -> float:
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

    def update(self, fit: Fit, pose: Pose, stamp_ns: int) -> None:
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


def _lies_still(log: LogEstimate, fit: Fit) -> bool:
    """What is known of a log's ways without its picture: none."""
    return False


def _are_one(log: LogEstimate, other: LogEstimate) -> bool:
    """Whether they would lie in each other, as two logs cannot."""
    off = log.center_m - other.center_m
    along = float(off @ other.axis)
    apart_m = float(np.linalg.norm(off - along * other.axis))
    inside = apart_m < INSIDE * 0.5 * (log.diameter_m + other.diameter_m) and abs(along) < 0.5 * other.length_m
    as_long = abs(log.length_m - other.length_m) < AS_LONG_M  # a piece of a log is no reason to forget the whole
    return inside and as_long and abs(float(log.axis @ other.axis)) > PARALLEL


class Tracks:
    """All logs of a scene."""

    def __init__(self, errors: Errors = NOMINAL) -> None:
        self._errors, self._logs, self._next = errors, [], 1

    def step(
        self, fits: Sequence[Fit], pose: Pose, stamp_ns: int, moved: Callable[[LogEstimate, Fit], bool] = _lies_still
    ) -> tuple[Track, ...]:
        """Take one picture's fits in; the logs believed in, by number.

        ``moved`` says whether the picture shows a log that is not where it was as another fit: it keeps its number.
        """
        pairs, found = self._paired(fits, pose)
        for i, j in self._elsewhere({i: pairs[i] for i in found}, fits, moved):
            self._logs[i] = self._anew(self._logs[i], fits[j], pose)
            pairs[i] = j
            found.add(i)
        for i, j in pairs.items():
            # A fit of this log that errs beyond the gate changes nothing, and is no other log either; but when
            # several in a row do, it is the log that was wrong from the start.  One that was in a single picture
            # is not believed by two that do not agree: it begins with the second.
            log = self._logs[i]
            log.odd = 0 if i in found else log.odd + 1
            if log.odd >= (ODD if log.hits >= CONFIRMED else 1):
                self._logs[i] = log = self._anew(log, fits[j], pose)
            if log.odd == 0:
                log.update(fits[j], pose, stamp_ns)
                found.add(i)
        self._forget(found)
        for j in sorted(set(range(len(fits))) - set(pairs.values())):
            log = _Log(self._next, fits[j], pose, self._errors)
            log.update(fits[j], pose, stamp_ns)
            self._logs.append(log)
            self._next += 1
        return tuple(log.track() for log in self._logs if log.hits >= CONFIRMED)

    def _paired(self, fits: Sequence[Fit], pose: Pose) -> tuple[dict[int, int], set[int]]:
        """Which fit is nearest to which log, and which logs theirs agrees with."""
        costs = np.full((len(self._logs), len(fits)), BAR)
        for i, log in enumerate(self._logs):
            for j, fit in enumerate(fits):
                costs[i, j] = min(BAR, log.distance2(fit, pose))
        pairs = {i: j for i, j in zip(*linear_sum_assignment(costs), strict=True) if costs[i, j] < BAR}
        return pairs, {i for i, j in pairs.items() if costs[i, j] < GATE}

    def _elsewhere(
        self, found: dict[int, int], fits: Sequence[Fit], moved: Callable[[LogEstimate, Fit], bool]
    ) -> list[tuple[int, int]]:
        """Logs that are believed in and not found where they were, each with the fit that shows it elsewhere."""
        shown, free = [], [j for j in range(len(fits)) if j not in found.values()]
        for i, log in enumerate(self._logs):
            if i in found or log.hits < CONFIRMED:
                continue
            estimate = log.track().estimate
            at = [j for j in free if moved(estimate, fits[j])]
            if at:
                best = min(at, key=lambda j: abs(fits[j].body.length_m - estimate.length_m))
                free.remove(best)
                shown.append((i, best))
        return shown

    def _anew(self, log: _Log, fit: Fit, pose: Pose) -> _Log:
        """The log begun again where a fit shows it, with its number."""
        return _Log(log.id, fit, pose, self._errors, log.hits if log.hits >= CONFIRMED else 0)

    def _forget(self, found: set[int]) -> None:
        """Give up the logs that were long not found, and at once those in whose place another is found."""
        shown = [(self._logs[i], self._logs[i].track().estimate) for i in found]
        for i, log in enumerate(self._logs):
            if i in found:
                continue
            log.missed += 1
            estimate = log.track().estimate
            twin = next((other for other, at in shown if _are_one(estimate, at)), None)
            if twin is not None:  # it keeps the older number
                twin.id, log.id, log.missed = min(twin.id, log.id), max(twin.id, log.id), LOST
        self._logs = [log for log in self._logs if log.missed < (LOST if log.hits >= CONFIRMED else CONFIRMED)]
