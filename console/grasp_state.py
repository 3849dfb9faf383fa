"""The chosen grasp for the page, in the crane's base frame; pure, like `console.state`."""

from __future__ import annotations

from math import cos, sin
from typing import Any, Final

from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.grasp import ChosenGrasp, decode_grasp
from machine.geometry import grapple
from machine.profile import Profile

TIMEOUT_NS: Final = 1_500_000_000
"""A grasp that has not been repeated for this long is over; the planner repeats it twice a second."""


class GraspState:
    """Accepts the planner's grasps; those of another machine are refused."""

    def __init__(self, profile: Profile, profile_hash: int, key: bytes | None) -> None:
        self._hash, self._key = profile_hash, key
        jaws = profile.grapple.jaws
        self._half_gap_m, self._below_m = grapple.half_gap_m(jaws, 0.0), grapple.tip_below_pin_m(jaws, 0.0)
        self._grasp: ChosenGrasp | None = None
        self._received_ns = 0

    def on_grasp(self, datagram: bytes, now_ns: int) -> bool:
        """Accept a datagram; False when it is no grasp of this machine."""
        try:
            profile_hash, _, grasp = decode_grasp(datagram, self._key)
        except DatagramRefused:
            return False
        if self._hash and profile_hash != self._hash:
            return False
        self._grasp, self._received_ns = grasp, now_ns
        return True

    def shown(self, now_ns: int) -> dict[str, Any] | None:
        """Hanger pin and both tips of the open jaws [m], logs and reason; None when no grasp is chosen."""
        g = self._grasp
        if g is None or now_ns - self._received_ns > TIMEOUT_NS:
            return None
        x, y, z = g.pin_m
        across = (self._half_gap_m * cos(g.yaw_rad), self._half_gap_m * sin(g.yaw_rad))
        return {
            "pin": list(g.pin_m),
            "tips": [[round(x + s * across[0], 4), round(y + s * across[1], 4), round(z - self._below_m, 4)]
                     for s in (-1.0, 1.0)],
            "logs": list(g.logs),
            "reason": g.reason,
        }  # fmt: skip
