"""Drift monitor: does a joint creep away, by its encoder, while its valve is shut?  (docs/reference/safety.md case 3)

An encoder that drifts slowly looks like a joint that moves.  While the reference stands, the law pulls the joint back
by small pulses (`controller.laws.joint.EndPositioning`), so that the error stays small and nothing else shows: the real
joint wanders with the drift.  What shows is that the joint goes one way whenever its valve is shut and is commanded the
other way whenever it is open.  Both ways are summed in leaky integrals.  A valve that leaks as fast looks the same, and
deserves the same.  While the reference moves, the valve is open and the monitor is blind; what was commanded then is
no pulse and does not count, or the way to a pose would hide a drift along it for seconds.

It is judged only where nothing else explains a creep.  Jaws that press on ground and logs, a log that they let go,
another joint's valve and a carrier that drives move every joint by some millimetres on its oil and steel, within some
tenths of a second; a law answers them by the same pulses.  So what a joint does while one of them is at work, and
`SETTLE_S` longer, is no evidence (``calm``).
"""

from __future__ import annotations

import math
from typing import Final

from controller.estimation.joint_estimator import TrackedJoint

MEMORY_S: Final = 3.0
SHUT_S: Final = 0.4
"""What a joint does until this time after its valve has shut belongs to the command before."""
PULSE_S: Final = 1.0
"""A valve that is open for longer follows a reference that moves: the longest pulse takes 0.8 s."""
DRIFT_S_AT_LIMIT: Final = 0.012
DRIFT_NOISES: Final = 3.0
"""A drift is further than the way of the first at the speed limit and this many times noise and resolution, ..."""
SETTLE_S: Final = 1.0
"""A joint that something else moved has come to rest on its oil after this time."""
COMMANDED_SHARE: Final = 0.3
"""... and the command went at least this share of it the other way: the gain of small pulses is known badly."""


class DriftMonitor:
    """Monitors one joint; `step` tells whether it drifts."""

    __slots__ = (
        "_alone",
        "_before",
        "_calm_s",
        "_commanded",
        "_decay",
        "_limit",
        "_open_s",
        "_period_s",
        "_shut_s",
    )

    def __init__(self, spec: TrackedJoint, period_s: float, least_speed: float = 0.0) -> None:
        """``least_speed``: see `controller.estimation.usual_speed`."""
        encoder = spec.encoder
        noise = 0.0 if encoder is None else encoder.noise + encoder.unit_per_count
        usual = max(spec.speed_limit, least_speed)
        self._limit = DRIFT_S_AT_LIMIT * usual + DRIFT_NOISES * noise
        self._period_s, self._decay = period_s, math.exp(-period_s / MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """Nothing has moved yet."""
        self._alone = self._commanded = self._before = self._shut_s = self._open_s = self._calm_s = 0.0

    def step(self, neutral: bool, expected_velocity: float, position: float, calm: bool) -> bool:
        """One period: is the valve ``neutral``, the velocity that the command lets expect, the position, and whether
        nothing else moves the joint.
        """
        self._shut_s = self._shut_s + self._period_s if neutral else 0.0
        self._calm_s = self._calm_s + self._period_s if calm else 0.0
        self._open_s = 0.0 if neutral else self._open_s + self._period_s
        judged = self._shut_s > SHUT_S and self._calm_s > SETTLE_S
        moved = position - self._before if judged else 0.0
        self._before = position
        self._alone = alone = self._decay * self._alone + moved
        if self._open_s > PULSE_S:
            self._commanded = 0.0
        else:
            self._commanded = self._decay * self._commanded + self._period_s * expected_velocity
        against = -self._commanded if alone > 0.0 else self._commanded
        return abs(alone) > self._limit and against > COMMANDED_SHARE * abs(alone)

    def share(self) -> float:
        """What was measured over what is a drift; 1 and more is one."""
        alone = abs(self._alone)
        against = -self._commanded if self._alone > 0.0 else self._commanded
        return max(0.0, min(alone / self._limit, against / (COMMANDED_SHARE * alone))) if alone > 0.0 else 0.0
