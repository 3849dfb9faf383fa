"""Logs over time: which fit of a picture is of which log, and which number it keeps.

A log lies still until a picture shows it elsewhere; what is known of each is its ``LogFilter``'s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from autonomy.perception.camera.frame import Pose
from autonomy.perception.fitting.cylinder_fit import CylinderFit
from autonomy.perception.log_list.estimate import LogEstimate
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors, LogFilter, Track

GATE: Final = 24.3  # chi squared of seven numbers, 99.9 %
CONFIRMED: Final = 2  # pictures after which a log is believed
ODD: Final = 4  # fits in a row beyond the gate after which a log is begun anew
LOST: Final = 8  # pictures in a row without it after which it is given up
INSIDE, PARALLEL, AS_LONG_M = 0.7, 0.94, 0.25
"""Two logs of a length, their axes nearer than this share of their radii's sum, 20 degrees askew at most, are one."""
PIECE: Final = 0.5
"""A shorter log whose axis is nearer to that of a longer one than this share of their radii's sum is a piece of it."""
BAR: Final = 1e9  # a gap in the table of costs


def _lies_still(log: LogEstimate, fit: CylinderFit) -> bool:
    """What is known of a log's ways without its picture: none."""
    return False


def _are_one(log: LogEstimate, other: LogEstimate) -> bool:
    """Whether they would lie in each other, as two logs cannot."""
    as_long = abs(log.length_m - other.length_m) < AS_LONG_M  # a piece of a log is no reason to forget the whole
    return as_long and _lies_in(log, other, INSIDE)


def _lies_in(log: LogEstimate, other: LogEstimate, share: float) -> bool:
    """Whether a log's middle lies in another of its direction, its axis within a share of their radii's sum."""
    off = log.center_m - other.center_m
    along = float(off @ other.axis)
    apart_m = float(np.linalg.norm(off - along * other.axis))
    inside = apart_m < share * 0.5 * (log.diameter_m + other.diameter_m) and abs(along) < 0.5 * other.length_m
    return inside and abs(float(log.axis @ other.axis)) > PARALLEL


def _whole(tracks: Sequence[Track]) -> tuple[Track, ...]:
    """Those that are no piece of a longer one: a mask that fell apart shows one log twice, picture after picture."""

    def is_piece(log: Track) -> bool:
        one = log.estimate
        return any(o.estimate.length_m > one.length_m and _lies_in(one, o.estimate, PIECE) for o in tracks)

    return tuple(log for log in tracks if not is_piece(log))


class LogTracker:
    """All logs of a scene."""

    def __init__(self, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._errors, self._next = errors, 1
        self._logs: list[LogFilter] = []

    def step(
        self, fits: Sequence[CylinderFit], pose: Pose, stamp_ns: int, moved: Callable[[LogEstimate, CylinderFit], bool] = _lies_still
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
            log = LogFilter(self._next, fits[j], pose, self._errors)
            log.update(fits[j], pose, stamp_ns)
            self._logs.append(log)
            self._next += 1
        return _whole([log.track() for log in self._logs if log.hits >= CONFIRMED])

    def _paired(self, fits: Sequence[CylinderFit], pose: Pose) -> tuple[dict[int, int], set[int]]:
        """Which fit is nearest to which log, and which logs theirs agrees with."""
        costs = np.full((len(self._logs), len(fits)), BAR)
        for i, log in enumerate(self._logs):
            for j, fit in enumerate(fits):
                costs[i, j] = min(BAR, log.distance2(fit, pose))
        pairs = {i: j for i, j in zip(*linear_sum_assignment(costs), strict=True) if costs[i, j] < BAR}
        return pairs, {i for i, j in pairs.items() if costs[i, j] < GATE}

    def _elsewhere(
        self, found: dict[int, int], fits: Sequence[CylinderFit], moved: Callable[[LogEstimate, CylinderFit], bool]
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

    def _anew(self, log: LogFilter, fit: CylinderFit, pose: Pose) -> LogFilter:
        """The log begun again where a fit shows it, with its number."""
        return LogFilter(log.id, fit, pose, self._errors, log.hits if log.hits >= CONFIRMED else 0)

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
