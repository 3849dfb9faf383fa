"""One log as the rest of the machine receives it from perception."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_ROWS: Final = 7
TRIANGLE: Final = _ROWS * (_ROWS + 1) // 2
"""Numbers in the upper triangle of an observation's covariance."""


@dataclass(frozen=True, slots=True)
class LogObservation:
    """One log in the crane's base frame: centre [m], unit axis in either sense, length and diameter [m].

    ``covariance`` is the upper triangle, row by row (``TRIANGLE`` numbers), of the covariance that
    ``autonomy.perception.log_list.estimate`` defines; None when it is unknown.  ``seen`` is True when the newest
    picture shows the log and False when the log is remembered from an earlier picture.  A remembered log that hung in
    the grapple is no longer where it was.
    """

    id: int
    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float
    covariance: tuple[float, ...] | None = None
    seen: bool = True
