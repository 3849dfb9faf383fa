"""The logs of a mission in the local plane, merged from log lists that are observed while the machine drives.

Each list is in the crane's base frame; with the base pose it is transformed to the plane (x east, y north, z up, m).  A
log's position is the running average of its observations (paper B 3.2.6), weighted by their variance where that is
known.  A restarted average keeps the log's number.  Logs in the bunk are not mapped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.localization.local_plane import LocalPlane
from autonomy.missions.local_frame import yaw_from_bearing
from autonomy.missions.model import KnownLog
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import (
    ACROSS_1,
    ACROSS_2,
    END,
    HIDDEN_END_SIGMA_M,
    START,
    TILT_1,
    LogObservation,
    unpack_covariance,
)
from machine.profile import Bunk

MAX_ALONG_M: Final = 0.8
"""Two observations of one log are closer than this along its axis, ..."""
MAX_ACROSS_M: Final = 0.35
"""... and closer than this across it."""
MAX_ANGLE_RAD: Final = math.radians(40.0)
"""Axes of two observations of one log differ by less than this plus their uncertainty."""
DEFAULT_SIGMA_M: Final = 0.10
"""Assumed for an observation without a covariance (paper B's own value)."""
MIN_SIGMA_M: Final = 0.01
"""Lower bound of every sigma: errors of poses and mounts do not average out."""
LISTED_SIGMA_M: Final = 0.3
"""Assumed for a log that a mission lists without a sigma."""
PLACED_SIGMA_M: Final = 1.0
"""A listed log known less well is not where the list says: a harvester's machine stood within metres of it."""
DEFAULT_SIZE_M: Final = (3.0, 0.2)
"""Assumed length and diameter of a listed log without a size."""
TYPICAL_COUNT: Final = 3
"""Logs that were seen whole before their median length is that of a log with an unknown end."""
TYPICAL_SIGMA_M: Final = 0.3
"""1-sigma of an unknown end that is placed by it: logs of one stand are cut alike."""
CONFIRMED_HITS: Final = 2
"""Observations that confirm a log."""
_BAR_COST: Final = 1e9
"""Cost of a pair that cannot be the same log."""


@dataclass(frozen=True, slots=True)
class MappedLog:
    """A log in the plane: centre and unit axis (3,), length and diameter [m], 1-sigma of the centre [m], number of
    observations, time of the last one, number of failed grasps.
    """

    number: int
    center_m: np.ndarray
    axis: np.ndarray
    length_m: float
    diameter_m: float
    sigma_m: float
    hits: int
    seen_ns: int
    misses: int = 0
    assortment: str = ""
    turn_rad: float = 0.0
    """1-sigma of the axis direction on the ground."""
    species: str = ""
    product_key: int | None = None
    """What the mission says of a listed log, for the report of what was forwarded."""

    @property
    def has_place(self) -> bool:
        """Whether it was seen, or listed well enough to be gripped, or driven around, where the list says."""
        return bool(self.seen_ns) or self.sigma_m < PLACED_SIGMA_M

    def observation(self, base: Pose) -> LogObservation:
        """Return the log in the crane's base frame."""
        x, y, z = base.to_optical(self.center_m).tolist()
        ax, ay, az = (self.axis @ base.rotation).tolist()
        return LogObservation(self.number, (x, y, z), (ax, ay, az), self.length_m, self.diameter_m)


class LogMap:
    """All logs that were observed or listed and are not collected yet."""

    def __init__(self, bunk: Bunk) -> None:
        self._bunk = bunk
        self._logs: dict[int, MappedLog] = {}
        self._whole_lengths_m: dict[int, float] = {}
        """Length of each log, collected ones too, when both its ends were last seen."""
        self._next = 1
        self._confirmed: tuple[MappedLog, ...] = ()
        self._centers: np.ndarray | None = None
        """Centres (n, 2) of the confirmed logs; None after a change.  A site lists thousands, and each step asks."""

    @property
    def logs(self) -> tuple[MappedLog, ...]:
        """Confirmed logs in the order of their numbers."""
        return tuple(log for log in self._logs.values() if log.hits >= CONFIRMED_HITS)

    def near(self, point_m: np.ndarray, distance_m: float) -> list[MappedLog]:
        """List the confirmed logs whose centres are no farther than ``distance_m`` from a point (2,) of the plane."""
        if self._centers is None:
            self._confirmed = self.logs
            self._centers = np.array([log.center_m[:2] for log in self._confirmed]).reshape(-1, 2)
        off = self._centers - point_m
        return [self._confirmed[i] for i in np.flatnonzero(np.einsum("ij,ij->i", off, off) < distance_m**2)]

    @property
    def missed_logs(self) -> tuple[MappedLog, ...]:
        """Logs with at least one failed grasp, given up or not."""
        return tuple(log for log in self._logs.values() if log.misses)

    @property
    def next_number(self) -> int:
        """The next unused number."""
        return self._next

    def add_known(self, log: MappedLog) -> None:
        """Add a log known before it is observed, for example from a harvester; it gets the next number."""
        self._store(replace(log, number=self._next, hits=max(log.hits, CONFIRMED_HITS)))
        self._next += 1

    def restore(self, log: MappedLog) -> None:
        """Restore a log with its number."""
        self._store(log)

    def reserve_numbers(self, free: int) -> None:
        """Start new numbers at ``free`` or above."""
        self._next = max(self._next, free)

    def get(self, number: int) -> MappedLog | None:
        """Return the log with this number, None if it is not mapped."""
        return self._logs.get(number)

    def observe(self, observations: Iterable[LogObservation], base: Pose, now_ns: int) -> dict[int, int]:
        """Merge a list of observations; return the map number of each list number."""
        lying = [o for o in observations if not lies_in_bunk(self._bunk, o)]
        observed = [_observed_log(o, base, now_ns) for o in lying]
        known = list(self._logs.values())
        costs = np.full((len(known), len(observed)), _BAR_COST)
        for i, log in enumerate(known):
            for j, sighting in enumerate(observed):
                costs[i, j] = _distance_m(log, sighting)
        pairs = {int(j): int(i) for i, j in zip(*linear_sum_assignment(costs), strict=True) if costs[i, j] < _BAR_COST}
        numbers = {}
        lengths_m = self._whole_lengths_m.values()
        typical_m = median(lengths_m) if len(lengths_m) >= TYPICAL_COUNT else 0.0
        for j, (o, sighting) in enumerate(zip(lying, observed, strict=True)):
            before = known[pairs[j]] if j in pairs else None
            whole = _completed(sighting, o, before, typical_m)
            number = self._next if before is None else before.number
            self._store(replace(whole, number=number) if before is None else _averaged(before, whole))
            if not any(_unknown_ends(o)):
                self._whole_lengths_m[number] = self._logs[number].length_m
            numbers[o.id] = number
            self._next += before is None
        return numbers

    def restart_average(self, number: int) -> None:
        """Restart the average of a log with its next observation (paper B: at standstill)."""
        self._store(replace(self._logs[number], hits=0))

    def record_miss(self, number: int) -> int:
        """Record a failed grasp; return how many there were."""
        log = replace(self._logs[number], misses=self._logs[number].misses + 1, hits=0)
        self._store(log)
        return log.misses

    def remove(self, number: int) -> None:
        """Remove a log that is collected."""
        self._logs.pop(number, None)
        self._centers = None

    def _store(self, log: MappedLog) -> None:
        self._logs[log.number] = log
        self._centers = None


def nearest(logs: Sequence[MappedLog], point_m: np.ndarray) -> MappedLog | None:
    """Return the log whose centre is nearest to a point (2,) of the plane."""
    return min(logs, key=lambda log: math.dist(log.center_m[:2], point_m), default=None)


def listed_log(log: KnownLog, plane: LocalPlane, ground_m: float) -> MappedLog:
    """Place a listed log in the plane, on ground at a height [m]."""
    d = log.diameter_m or DEFAULT_SIZE_M[1]
    x, y, _ = plane.local(log.position.latitude_deg, log.position.longitude_deg)
    yaw = 0.0 if log.bearing_deg is None else yaw_from_bearing(log.bearing_deg)
    return MappedLog(
        0,
        np.array([x, y, ground_m + 0.5 * d]),
        np.array([math.cos(yaw), math.sin(yaw), 0.0]),
        log.length_m or DEFAULT_SIZE_M[0],
        d,
        log.sigma_m or LISTED_SIGMA_M,
        CONFIRMED_HITS,
        0,
        assortment=log.assortment,
        turn_rad=math.pi if log.bearing_deg is None else 0.0,
        species=log.species,
        product_key=log.product_key,
    )


def _observed_log(o: LogObservation, base: Pose, now_ns: int) -> MappedLog:
    center = base.to_base(np.asarray(o.center_m))
    axis, turn_rad = base.rotation @ np.asarray(o.axis), 0.0
    if o.covariance is not None:
        turn_rad = math.sqrt(unpack_covariance(o.covariance)[TILT_1, TILT_1])
    return MappedLog(0, center, axis, o.length_m, o.diameter_m, _sigma_m(o), 1, now_ns, turn_rad=turn_rad)


def _sigma_m(o: LogObservation) -> float:
    """Compute the 1-sigma of the centre on the ground: the larger of across and along."""
    if o.covariance is None:
        return DEFAULT_SIGMA_M
    c = unpack_covariance(o.covariance)
    along = 0.25 * (c[START, START] + c[END, END] + 2.0 * c[START, END])
    return max(MIN_SIGMA_M, math.sqrt(max(c[ACROSS_1, ACROSS_1], c[ACROSS_2, ACROSS_2], along)))


def _distance_m(log: MappedLog, sighting: MappedLog) -> float:
    """Compute the distance between two observations [m]; `_BAR_COST` when they cannot be of one log."""
    off = sighting.center_m - log.center_m
    along = float(off @ log.axis)
    across = float(np.linalg.norm(off - along * log.axis))
    tolerance_m = 3.0 * (log.sigma_m + sighting.sigma_m)
    angle_rad = math.acos(min(1.0, abs(float(log.axis @ sighting.axis))))
    if angle_rad > MAX_ANGLE_RAD + 3.0 * max(log.turn_rad, sighting.turn_rad):
        return _BAR_COST
    if abs(along) > MAX_ALONG_M + tolerance_m or across > MAX_ACROSS_M + tolerance_m:
        return _BAR_COST
    return math.hypot(along, across)


def _unknown_ends(o: LogObservation) -> tuple[bool, bool]:
    """Tell which ends, the start and the end, were not seen."""
    if o.covariance is None:
        return False, False
    c = unpack_covariance(o.covariance)
    return bool(c[START, START] >= HIDDEN_END_SIGMA_M**2), bool(c[END, END] >= HIDDEN_END_SIGMA_M**2)


def _completed(sighting: MappedLog, o: LogObservation, known: MappedLog | None, typical_m: float) -> MappedLog:
    """Return a sighting of which one end was not seen, with this end where the map knows it, or where a log of the
    typical length would have it (0: no such length is known), if that is farther out.

    A log beside the route leaves the picture as the machine passes, and may never be in it whole: without this its
    middle moved by 0.3 m towards the end that is seen.
    """
    unknown_start, unknown_end = _unknown_ends(o)
    if o.covariance is None or unknown_start == unknown_end:
        return sighting
    c = unpack_covariance(o.covariance)
    half_m, sense = 0.5 * sighting.length_m, -1.0 if unknown_start else 1.0
    reach_m, sigma_m = typical_m - half_m, TYPICAL_SIGMA_M
    if known is not None and known.seen_ns and known.hits:
        known_middle_m = float((known.center_m - sighting.center_m) @ sighting.axis)
        reach_m, sigma_m = sense * known_middle_m + 0.5 * known.length_m, known.sigma_m
    if reach_m <= half_m:
        return sighting
    seen = END if unknown_start else START
    along = 0.25 * (c[seen, seen] + sigma_m**2)
    return replace(
        sighting,
        center_m=sighting.center_m + 0.5 * sense * (reach_m - half_m) * sighting.axis,
        length_m=half_m + reach_m,
        sigma_m=max(MIN_SIGMA_M, math.sqrt(max(c[ACROSS_1, ACROSS_1], c[ACROSS_2, ACROSS_2], along))),
    )


def _averaged(log: MappedLog, sighting: MappedLog) -> MappedLog:
    """Compute the running average, weighted by variance; it is restarted when the log has no hits."""
    if not log.hits:
        return replace(
            sighting,
            number=log.number,
            misses=log.misses,
            assortment=log.assortment,
            species=log.species,
            product_key=log.product_key,
        )
    before, now = 1.0 / log.sigma_m**2, 1.0 / sighting.sigma_m**2
    share = now / (before + now)
    sign = 1.0 if float(log.axis @ sighting.axis) >= 0.0 else -1.0
    axis = log.axis + share * (sign * sighting.axis - log.axis)
    return replace(
        log,
        center_m=log.center_m + share * (sighting.center_m - log.center_m),
        axis=axis / np.linalg.norm(axis),
        length_m=log.length_m + share * (sighting.length_m - log.length_m),
        diameter_m=log.diameter_m + share * (sighting.diameter_m - log.diameter_m),
        sigma_m=max(MIN_SIGMA_M, 1.0 / math.sqrt(before + now)),
        turn_rad=min(log.turn_rad, sighting.turn_rad),
        hits=log.hits + 1,
        seen_ns=sighting.seen_ns,
    )
