"""Noise monitor: has an encoder become noisy, by what its profile says, or by what it was?  (docs/reference/safety.md
case 4)

Two means of the estimator's innovations.  The mean square of the innovation itself is compared with the noise of the
profile: a data sheet allows more than a good device shows, and motion is in it, too, so only noise beyond all that is
found.  The mean square of its second difference is the noise alone, without steady speeds and accelerations, and is
compared with its own long mean: a device ten times better than its data sheet is found when it becomes ten times
worse.  A single large sample counts for little, so that a knock at the steel is no noise.
"""

from __future__ import annotations

import math
from typing import Final

PROFILE_RATIO: Final = 25.0
"""An encoder is noisy when the mean square of the innovation is this many times what its profile explains, ..."""
MEAN_S: Final = 0.25
"""... averaged over this time, ..."""
USUAL_RATIO: Final = 12.0
"""... or when the mean square of the second difference is this many times the usual one.  Ten times the noise is a
hundred times the square, of which `LEAST_SHARE` leaves 36; work without a fault reaches 6, of a telescope whose grapple
takes up a log (the nominal scenes of experiments/faults)."""
LEAST_SHARE: Final = 1.0 / 6.0
"""A device better than this share of its profile's noise sees the steel tremble: noise up to here is always usual."""
USUAL_S: Final = 30.0
"""The usual noise is the mean over this time, and over what there is of it at the start."""
_LEARNING_SHARE: Final = 0.01
"""The first hundred samples only teach what is usual."""
_QUIET_RATIO: Final = 3.0
"""Above this many times the usual nothing is learned, or a fault would teach its own noise before it is found, ..."""
_TAUGHT_RATIO: Final = 9.0
"""... and one sample teaches at most this many times the usual: three standard deviations."""
_CLIP_RATIO: Final = 4.0
"""One sample counts at most as this many times the limit: alone it moves the mean by a twelfth of the limit."""
_SECOND_DIFFERENCE: Final = 6.0
"""Variance of the second difference of white noise, over that of the noise."""
_ROUNDING: Final = 1.0 / 12.0
"""Variance of rounding in squared counts, ..."""
_TOSS_RATIO: Final = 3.0
"""... of which a joint that rests between two counts, as by tossing a coin, shows this many times, ..."""
_ROUNDING_RATIO: Final = 4.0
"""... and this many times, which is more, are allowed."""


class NoiseMonitor:
    """Monitors one encoder; ``noisy`` is the finding after `update`."""

    __slots__ = (
        "_allowed", "_before", "_before_that", "_gain", "_least", "_least_share", "_limit", "_max_innovation", "_mean",
        "_most", "_punctual", "_scatter", "_share", "_toss", "_usual", "noisy",
    )  # fmt: skip

    def __init__(
        self, noise: float, unit_per_count: float, innovation_ratio: float, period_s: float, punctual: bool = True
    ) -> None:
        """``noise`` is the profile's [unit]; the filter makes the variance of the innovation ``innovation_ratio`` times
        that of a sample.  Samples that are not ``punctual``, as a PLC passes them on, scatter by speed times lateness:
        they are compared with the profile alone."""
        rounding = _ROUNDING * unit_per_count**2
        self._max_innovation = PROFILE_RATIO * innovation_ratio * (noise**2 + rounding)
        made = _SECOND_DIFFERENCE * innovation_ratio
        self._least, self._most = made * (LEAST_SHARE * noise) ** 2, made * noise**2
        self._toss, self._allowed = made * _TOSS_RATIO * rounding, made * _ROUNDING_RATIO * rounding
        self._gain, self._least_share = -math.expm1(-period_s / MEAN_S), -math.expm1(-period_s / USUAL_S)
        self._usual, self._share = 0.0, 1.0
        self._punctual = punctual
        self.restart()

    def restart(self) -> None:
        """The estimator starts again; what is usual stays known."""
        self._mean = self._scatter = self._before = self._before_that = 0.0
        self._limit = self._max_innovation
        self.noisy = False

    def update(self, innovation: float) -> None:
        """Use the innovation of one sample [unit]."""
        difference = innovation - 2.0 * self._before + self._before_that
        self._before_that, self._before = self._before, innovation
        square = difference * difference
        usual = min(max(self._usual - self._toss, self._least), self._most)
        self._limit = limit = USUAL_RATIO * usual + self._allowed
        self._mean += self._gain * (innovation * innovation - self._mean)
        self._scatter += self._gain * (min(square, _CLIP_RATIO * limit) - self._scatter)
        learning = self._share > _LEARNING_SHARE
        if learning or self._scatter < _QUIET_RATIO * usual + self._toss:
            taught = square if learning else min(square, _TAUGHT_RATIO * (usual + self._toss))
            self._usual += self._share * (taught - self._usual)
            # Shares 1, 1/2, 1/3 and so on make the plain mean of the first samples.
            self._share = max(self._least_share, self._share / (1.0 + self._share))
        unusual = self._punctual and not learning and self._scatter > limit
        self.noisy = unusual or self._mean > self._max_innovation

    def share(self) -> float:
        """What was measured over what is noise; 1 and more is noisy."""
        scatter = self._scatter / self._limit if self._punctual and self._share <= _LEARNING_SHARE else 0.0
        return max(scatter, self._mean / self._max_innovation)
