"""Logs over frames: association of fits with logs, and the number that each log keeps.

A log is assumed to lie still until a picture shows it elsewhere.  Each log has its own ``LogFilter``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list import LogEstimate
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors, LogFilter, Track

GATE_CHI2: Final = 24.3  # chi squared of seven numbers, 99.9 %
CONFIRMED_HITS: Final = 2  # pictures after which a log is reported
MAX_OUTLIERS: Final = 4  # fits in a row outside the gate after which a log is initialised anew
LOST_MISSES: Final = 8  # pictures in a row without it after which a log is deleted
DUPLICATE_DISTANCE_SHARE, MIN_PARALLEL_COSINE, MAX_LENGTH_DIFFERENCE_M = 0.7, 0.94, 0.25
"""Two logs are duplicates when their lengths differ by less, their axes are at most 20 degrees apart, and the distance
of their axes is below this share of the sum of their radii."""
FRAGMENT_DISTANCE_SHARE: Final = 0.5
"""A shorter log is a fragment of a longer one when their axes are nearer than this share of the sum of their radii."""
THINNEST_LOG_M: Final = 0.05
"""No thinner log is loaded; pictures that contradict each other in one log make one."""
NO_PAIR_COST: Final = 1e9  # in the assignment matrix


def _never_displaced(log: LogEstimate, fit: CylinderFit) -> bool:
    """Return False: without a picture, no log is known to have moved."""
    return False


def _are_duplicates(log: LogEstimate, other: LogEstimate) -> bool:
    """Tell whether two logs would occupy the same space, which two real logs cannot."""
    # A fragment of a log is no reason to delete the whole log: compare lengths.
    same_length = abs(log.length_m - other.length_m) < MAX_LENGTH_DIFFERENCE_M
    return same_length and _lies_in(log, other, DUPLICATE_DISTANCE_SHARE)


def _lies_in(log: LogEstimate, other: LogEstimate, share: float) -> bool:
    """Tell whether a log's middle lies in a parallel log, the axes' distance below a share of the sum of radii."""
    off = log.center_m - other.center_m
    along = float(off @ other.axis)
    apart_m = float(np.linalg.norm(off - along * other.axis))
    inside = apart_m < share * 0.5 * (log.diameter_m + other.diameter_m) and abs(along) < 0.5 * other.length_m
    return inside and abs(float(log.axis @ other.axis)) > MIN_PARALLEL_COSINE


def _without_fragments(tracks: Sequence[Track]) -> tuple[Track, ...]:
    """Drop tracks that are fragments of a longer one: a mask that splits shows one log as two in every picture."""

    def is_fragment(log: Track) -> bool:
        estimate = log.estimate
        return any(
            o.estimate.length_m > estimate.length_m and _lies_in(estimate, o.estimate, FRAGMENT_DISTANCE_SHARE)
            for o in tracks
        )

    return tuple(log for log in tracks if not is_fragment(log))


class LogTracker:
    """All logs of a scene."""

    def __init__(self, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._errors, self._next_id = errors, 1
        self._logs: list[LogFilter] = []

    def step(
        self,
        fits: Sequence[CylinderFit],
        pose: Pose,
        stamp_ns: int,
        displaced: Callable[[LogEstimate, CylinderFit], bool] = _never_displaced,
    ) -> tuple[Track, ...]:
        """Update the logs with the fits of one picture and return the confirmed logs in the order of their numbers.

        ``displaced`` says whether a fit shows a log that is no longer where it was; such a log keeps its number.
        """
        pairs, matched = self._associated(fits, pose)
        for i, j in self._displaced({i: pairs[i] for i in matched}, fits, displaced):
            self._logs[i] = self._restarted(self._logs[i], fits[j], pose)
            pairs[i] = j
            matched.add(i)
        for i, j in pairs.items():
            # A single fit outside the gate changes nothing, and does not start another log either.  Several in a row
            # mean that the log was wrong from the start.  A log from a single picture that the next one contradicts is
            # not confirmed: it starts again with the second picture.
            log = self._logs[i]
            log.outliers = 0 if i in matched else log.outliers + 1
            if log.outliers >= (MAX_OUTLIERS if log.hits >= CONFIRMED_HITS else 1):
                self._logs[i] = log = self._restarted(log, fits[j], pose)
            if log.outliers == 0:
                log.update(fits[j], pose, stamp_ns)
                matched.add(i)
        self._delete_lost(matched)
        for j in sorted(set(range(len(fits))) - set(pairs.values())):
            log = LogFilter(self._next_id, fits[j], pose, self._errors)
            log.update(fits[j], pose, stamp_ns)
            self._logs.append(log)
            self._next_id += 1
        tracks = [log.track() for log in self._logs if log.hits >= CONFIRMED_HITS]
        return _without_fragments([log for log in tracks if log.estimate.diameter_m >= THINNEST_LOG_M])

    def _associated(self, fits: Sequence[CylinderFit], pose: Pose) -> tuple[dict[int, int], set[int]]:
        """Find the nearest fit of each log, and the logs that agree with theirs."""
        costs = np.full((len(self._logs), len(fits)), NO_PAIR_COST)
        for i, log in enumerate(self._logs):
            for j, fit in enumerate(fits):
                costs[i, j] = min(NO_PAIR_COST, log.distance2(fit, pose))
        pairs = {i: j for i, j in zip(*linear_sum_assignment(costs), strict=True) if costs[i, j] < NO_PAIR_COST}
        return pairs, {i for i, j in pairs.items() if costs[i, j] < GATE_CHI2}

    def _displaced(
        self,
        matched: dict[int, int],
        fits: Sequence[CylinderFit],
        displaced: Callable[[LogEstimate, CylinderFit], bool],
    ) -> list[tuple[int, int]]:
        """Find confirmed logs that no longer lie where they were, each with the fit that shows it elsewhere."""
        moves, free = [], [j for j in range(len(fits)) if j not in matched.values()]
        for i, log in enumerate(self._logs):
            if i in matched or log.hits < CONFIRMED_HITS:
                continue
            estimate = log.track().estimate
            candidates = [j for j in free if displaced(estimate, fits[j])]
            if candidates:
                best = min(candidates, key=lambda j: abs(fits[j].body.length_m - estimate.length_m))
                free.remove(best)
                moves.append((i, best))
        return moves

    def _restarted(self, log: LogFilter, fit: CylinderFit, pose: Pose) -> LogFilter:
        """Return the log with its number, initialised anew where a fit shows it."""
        return LogFilter(log.id, fit, pose, self._errors, log.hits if log.hits >= CONFIRMED_HITS else 0)

    def _delete_lost(self, matched: set[int]) -> None:
        """Delete logs that were missed for long, and at once those in whose place another log is found."""
        present = [(self._logs[i], self._logs[i].track().estimate) for i in matched]
        for i, log in enumerate(self._logs):
            if i in matched:
                continue
            log.misses += 1
            estimate = log.track().estimate
            duplicate = next((other for other, at in present if _are_duplicates(estimate, at)), None)
            if duplicate is not None:  # it keeps the older number
                duplicate.id, log.id, log.misses = min(duplicate.id, log.id), max(duplicate.id, log.id), LOST_MISSES
        self._logs = [
            log for log in self._logs if log.misses < (LOST_MISSES if log.hits >= CONFIRMED_HITS else CONFIRMED_HITS)
        ]


# -- Whether a log that is not where it was is seen elsewhere: lifted, rolled away, or pulled from beneath another.

MAX_DISPLACEMENT_M: Final = 1.5  # between two pictures, of a log that is recognised by its shape
DISPLACED_LENGTH_DIFFERENCE_M: Final = 0.25  # of one log in two pictures
MAX_DIAMETER_DIFFERENCE_M: Final = 0.06
MIN_TURN_COSINE: Final = 0.94  # 20 degrees
DEPTH_TOLERANCE_M: Final = 0.1  # depth that agrees this well with a log shows it in its old place
MIN_GONE_SHARE: Final = 0.8  # of the visible part of the log's axis, that must show something else
_SAMPLES: Final = np.linspace(-0.45, 0.45, 25)  # along the axis, as shares of the length
_MIN_GONE_SAMPLES: Final = 10


def is_displaced(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Tell whether ``fit`` is ``log`` in another place.

    The two must have similar shapes, and along the old axis the picture must show what was behind the log, or ``fit``
    in front of it.
    """
    return _similar(pose, log, fit) and _gone(frame, pose, log, fit)


def _similar(pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    body = fit.body
    return (
        abs(body.length_m - log.length_m) < DISPLACED_LENGTH_DIFFERENCE_M
        and abs(2.0 * body.radius_m - log.diameter_m) < MAX_DIAMETER_DIFFERENCE_M
        and abs(float(pose.rotation @ body.axis @ log.axis)) > MIN_TURN_COSINE
        and float(np.linalg.norm(pose.to_base(body.center_m) - log.center_m)) < MAX_DISPLACEMENT_M
    )


def _gone(frame: RgbdFrame, pose: Pose, log: LogEstimate, fit: CylinderFit) -> bool:
    """Tell whether the old place shows something else, where no third object (the grapple, another log) hides it."""
    line_m = pose.to_optical(log.center_m + np.outer(_SAMPLES * log.length_m, log.axis))
    line_m = line_m[line_m[:, 2] > log.diameter_m]
    surface_m = line_m * (1.0 - 0.5 * log.diameter_m / np.linalg.norm(line_m, axis=1, keepdims=True))
    u, v = np.rint(frame.intrinsics.project(surface_m)).astype(int).T
    height, width = frame.depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    surface_m, depth_m = surface_m[inside], frame.depth_m[v[inside], u[inside]]
    nearer_m = surface_m[:, 2] - depth_m  # NaN where no depth is known
    visible_m = surface_m * (depth_m / surface_m[:, 2])[:, None]
    is_fit = (nearer_m > DEPTH_TOLERANCE_M) & (
        _distance_from_axis_m(visible_m, fit) < fit.body.radius_m + DEPTH_TOLERANCE_M
    )
    gone = np.count_nonzero((nearer_m < -DEPTH_TOLERANCE_M) | is_fit)
    there = np.count_nonzero(np.abs(nearer_m) <= DEPTH_TOLERANCE_M)
    return bool(gone >= _MIN_GONE_SAMPLES and gone >= MIN_GONE_SHARE * (gone + there))


def _distance_from_axis_m(points_m: np.ndarray, fit: CylinderFit) -> np.ndarray:
    """Compute distances (N,) of optical-frame points (N, 3) from the axis of a fit."""
    off = points_m - fit.body.center_m
    return np.asarray(np.linalg.norm(off - np.outer(off @ fit.body.axis, fit.body.axis), axis=1))
