"""The estimate of one log: seven numbers and their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.log_list.observation import LogObservation

ACROSS_1, ACROSS_2, TILT_1, TILT_2, START, END, RADIUS = range(7)
SIZE: Final = 7


@dataclass(frozen=True, slots=True)
class LogEstimate:
    """One log: centre (3,) [m] and unit axis (3,) in the crane's base frame, length and diameter [m].

    ``covariance`` (7, 7) is that of errors in the order ACROSS_1, ACROSS_2 [m] (of the axis at the centre, along the
    two directions of ``frame``), TILT_1, TILT_2 [rad] (of the axis towards these), START, END [m] (of the ends at
    -length/2 and +length/2, along the axis), RADIUS [m].  ``ends_seen`` says which ends are visible, not cut off by the
    edge of the picture or by something in front; the length is a lower bound unless both are.  ``score`` is in 0..1.
    """

    center_m: np.ndarray
    axis: np.ndarray
    length_m: float
    diameter_m: float
    covariance: np.ndarray
    ends_seen: tuple[bool, bool] = (True, True)
    score: float = 1.0

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """The two unit vectors (3,) across the axis to which the covariance refers: level, and up."""
        return across(self.axis)

    def position_sigma_m(self) -> np.ndarray:
        """Standard deviation (3,) [m] of the centre: along ``frame``'s two directions and along the axis."""
        c = self.covariance
        along = 0.25 * (c[START, START] + c[END, END] + 2.0 * c[START, END])
        return np.sqrt(np.maximum([c[ACROSS_1, ACROSS_1], c[ACROSS_2, ACROSS_2], along], 0.0))

    def observation(self, number: int, seen: bool = True) -> LogObservation:
        """The observation with this number; ``seen``: the newest picture shows the log."""
        x, y, z = (float(v) for v in self.center_m)
        ax, ay, az = (float(v) for v in self.axis)
        # Four digits suffice, and a reply about a hundred logs must fit into one datagram.
        known = tuple(float(f"{v:.4g}") for v in self.covariance[np.triu_indices(SIZE)])
        length_m, diameter_m = float(self.length_m), float(self.diameter_m)
        return LogObservation(number, (x, y, z), (ax, ay, az), length_m, diameter_m, known, seen)


def unpack_covariance(triangle: tuple[float, ...]) -> np.ndarray:
    """The covariance (7, 7) of a ``LogObservation``."""
    upper = np.zeros((SIZE, SIZE))
    upper[np.triu_indices(SIZE)] = triangle
    return np.asarray(upper + np.triu(upper, 1).T)


def across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a unit axis (3,): the first level (to the left of the axis), the second upward."""
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    level = np.cross(up, axis)
    level /= np.linalg.norm(level)
    return level, np.cross(axis, level)
