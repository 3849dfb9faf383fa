"""A joint law of one's own: a proportional term and an integral that leaks, so that it forgets an old load."""

from __future__ import annotations

from machine.profile import Law

LEAK_S = 2.0
"""Time constant of forgetting."""
INTEGRAL_SHARE = 0.05
"""Integral gain over the proportional gain squared: what a delayed valve bears."""


class LeakyPi:
    """kp e + w,  w' = ki e - w / LEAK_S  (the contract of `controller.laws.feedback.Feedback`).

    It is called 200 times a second in the controller's only thread: no waiting, no file, no thread, no randomness.
    """

    def __init__(self, law: Law) -> None:
        """Take the gain from ``law``, the table [joints.NAME.law] of the profile."""
        self._kp, self._ki = law.kp_1_s, INTEGRAL_SHARE * law.kp_1_s**2
        self._integral = 0.0

    def reset(self) -> None:
        """Forget the integral: the valve is at neutral."""
        self._integral = 0.0

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        """Compute the velocity to add to the feed-forward [rad/s, m/s], for an error [rad, m].

        ``frozen``: the command is at a limit, so an integral would wind up.
        """
        if not frozen:
            self._integral += (self._ki * error - self._integral / LEAK_S) * elapsed_s
        return self._kp * error + self._integral
