"""Trajectory tracking: a motion's clock that slows down smoothly to wait, to stop, and where joints fall behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.motion.trajectory import Trajectory, hold
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint

ARRIVAL_TOLERANCE: Final = (0.015, 0.015, 0.02, 0.02, 0.06)
"""Greatest distance of each joint from its goal before the next phase, rad (EXT m): a few cm at the pin."""
BRAKE_S: Final = 0.8
"""Time from full speed to a stop on the path."""
_MAX_LAG_S: Final = 0.4

Axes = tuple[float, ...]


class TrajectoryTracker:
    """The tracked ``motion``, the time on it ``clock_s``, and its next ``rate`` in seconds per second.

    The clock goes at the rate that was announced last: that is the one the controller follows, whatever the planner has
    decided since.
    """

    def __init__(self, profile: Profile, last_setpoint: Axes) -> None:
        self.motion: Trajectory = hold(last_setpoint)
        self.clock_s = 0.0
        self.rate = 1.0
        self._announced = 0.0
        self._profile = profile

    def begin(self, motion: Trajectory) -> None:
        """Track another motion from its start."""
        self.motion, self.clock_s, self.rate, self._announced = motion, 0.0, 1.0, 0.0

    def announce(self) -> float:
        """Return the rate that goes into a datagram now."""
        self._announced = self.rate
        return self.rate

    @property
    def setpoint(self) -> Axes:
        """The present joint setpoint, rad (EXT m)."""
        return self.motion.at(self.clock_s)[0]

    @property
    def left_s(self) -> float:
        """Time left of the motion, s; negative after its end."""
        return self.motion.duration_s - self.clock_s

    @property
    def is_stopped(self) -> bool:
        """Whether the clock stands still."""
        return self.rate == self._announced == 0.0

    def hold_here(self) -> None:
        """Replace the rest of the motion by a hold at the present setpoint."""
        self.motion = hold(self.setpoint)

    def advance(self, dt_s: float, wanted: float, measured: Sequence[float]) -> None:
        """Advance by ``dt_s`` and approach the ``wanted`` rate, or a lower one while a joint falls behind."""
        wanted = min(wanted, self._following_rate(measured))
        self.clock_s += self._announced * dt_s
        most = dt_s / BRAKE_S
        self.rate += min(max(wanted - self.rate, -most), most)

    def _following_rate(self, measured: Sequence[float]) -> float:
        """Return 1 while the joints follow, less while one lags by more than ``_MAX_LAG_S``, 0 at twice that."""
        lags = [
            abs(q - p) / joint(self._profile, j).speed_limit
            for j, q, p in zip(JOINTS, self.setpoint, measured, strict=True)
        ]
        return min(max(2.0 - max(lags) / _MAX_LAG_S, 0.0), 1.0)

    def arrived(self, measured: Sequence[float], tolerance_factor: float) -> bool:
        """Tell whether every joint is within ``tolerance_factor`` times ``ARRIVAL_TOLERANCE`` of its goal."""
        return all(
            abs(p - g) <= tolerance_factor * near
            for p, g, near in zip(measured, self.motion.goal, ARRIVAL_TOLERANCE, strict=True)
        )

    def worst_joint(self, measured: Sequence[float]) -> str:
        """Write the end of a sentence that names the joint farthest from its setpoint; empty when all are near."""
        errors = [
            (abs(p - w) / near, j, p - w)
            for j, p, w, near in zip(JOINTS, measured, self.setpoint, ARRIVAL_TOLERANCE, strict=True)
        ]
        share, axis, error = max(errors)
        unit = "m" if axis is Joint.EXT else "rad"
        return f": the {axis.name.lower()} is {error:+.3f} {unit} off" if share > 1.0 else ""
