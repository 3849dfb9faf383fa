"""A joint motion being followed: its clock slows down smoothly to wait or to stop, and where joints fall behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.motion.trajectory import Trajectory, hold
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint

ARRIVAL_TOLERANCE: Final = (0.015, 0.015, 0.02, 0.02, 0.06)
"""How near each joint comes to its goal before the next phase, rad (EXT m): a few cm at the pin."""
BRAKE_S: Final = 0.8
"""From full speed to a stop on the way."""
_MAX_LAG_S: Final = 0.4

Axes = tuple[float, ...]


class TrajectoryTracker:
    """Where on its ``motion`` a crane is sent: at ``clock_s`` of it, ``rate`` of its seconds in a second."""

    def __init__(self, profile: Profile, last_setpoint: Axes) -> None:
        self.motion: Trajectory = hold(last_setpoint)
        self.clock_s = 0.0
        self.rate = 1.0
        self._profile = profile

    def begin(self, motion: Trajectory) -> None:
        """Another motion, from its start."""
        self.motion, self.clock_s, self.rate = motion, 0.0, 1.0

    @property
    def sent(self) -> Axes:
        """Where the joints are sent, rad (EXT m)."""
        return self.motion.at(self.clock_s)[0]

    @property
    def left_s(self) -> float:
        """How much of the motion is left; below zero, how long it has been over."""
        return self.motion.duration_s - self.clock_s

    @property
    def is_stopped(self) -> bool:
        """Whether it has come to a stop."""
        return self.rate == 0.0

    def hold_here(self) -> None:
        """Stay here: there is no way on."""
        self.motion = hold(self.sent)

    def advance(self, dt_s: float, wanted: float, measured: Sequence[float]) -> None:
        """``wanted`` rate from now on, less when a joint falls behind."""
        wanted = min(wanted, self._following_rate(measured))
        self.clock_s += self.rate * dt_s  # as the last window foretold
        most = dt_s / BRAKE_S
        self.rate += min(max(wanted - self.rate, -most), most)

    def _following_rate(self, measured: Sequence[float]) -> float:
        """1 while the joints follow, less when one falls behind by more than ``_MAX_LAG_S``, 0 at twice that."""
        lags = [
            abs(q - p) / joint(self._profile, j).speed_limit
            for j, q, p in zip(JOINTS, self.sent, measured, strict=True)
        ]
        return min(max(2.0 - max(lags) / _MAX_LAG_S, 0.0), 1.0)

    def arrived(self, measured: Sequence[float], share: float) -> bool:
        """Whether every joint is near its goal; ``share`` of ``ARRIVAL_TOLERANCE`` is near."""
        return all(abs(p - g) <= share * near for p, g, near in zip(measured, self.motion.goal, ARRIVAL_TOLERANCE, strict=True))

    def worst_joint(self, measured: Sequence[float]) -> str:
        """The end of a sentence: which joint is farthest off; empty when all are near."""
        errors = [
            (abs(p - w) / near, j, p - w) for j, p, w, near in zip(JOINTS, measured, self.sent, ARRIVAL_TOLERANCE, strict=True)
        ]
        share, axis, error = max(errors)
        unit = "m" if axis is Joint.EXT else "rad"
        return f": the {axis.name.lower()} is {error:+.3f} {unit} off" if share > 1.0 else ""
